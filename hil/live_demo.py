"""The first job live: one log from the ground into the bunk, in the planner's process."""

from __future__ import annotations

import time
from typing import Final

from hil.live import LiveRun
from hil.summary import Summary, verdict_sentence

SETTLE_S: Final = 3.0


class OneLogRun(LiveRun[Summary]):
    """Lays the log that the seed has chosen."""

    def _summary(self, sim_port: int) -> Summary:
        self._display.event("waiting for the plant's verdict")
        limit = time.monotonic() + SETTLE_S
        verdict = self._ask(sim_port, "verdict")
        while not verdict["success"] and time.monotonic() < limit:
            time.sleep(0.2)
            verdict = self._ask(sim_port, "verdict")
        last = self._report
        return Summary(
            in_bunk=bool(verdict["success"]),
            verdict=verdict_sentence(verdict),
            failure=self._failure,
            seconds=self._seconds,
            stops=self._operator.stops,
            ticks=round(self._seconds * self._options.profile.rate_hz) - (last.missed_ticks if last else 0),
            missed_ticks=last.missed_ticks if last else 0,
            frames=last.frames_received if last else 0,
            refused_setpoints=last.refused if last else 0,
            grasp=self._grasp,
            directory=str(self._options.directory),
        )
