"""The guard may wake between any two frames: what it finds does not depend on how they are dealt out to its steps."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

import hil.missions.lockstep as lockstep
from can_dbc.frame import Frame, RawFrame
from controller.guard.guard import Guard
from controller.guard.verdicts import Verdict
from tests.hil.short_missions import mission_file
from timberhand.cli import app

build = lockstep.build_guard


class FrameByFrame:
    """The guard of a run, one step for each frame; ``refused`` are the verdicts after it first was GOOD."""

    def __init__(self, guard: Guard) -> None:
        self.keys_of_buses = guard.keys_of_buses
        self.refused: list[tuple[Verdict, int]] = []
        self._guard, self._ready = guard, False
        self.hear = guard.hear

    def step(self, now_ns: int, frames: list[Frame]) -> list[RawFrame]:
        sent: list[RawFrame] = []
        for dealt in (*([frame] for frame in frames), []):
            sent += self._guard.step(now_ns, dealt)
            self._ready = self._ready or self._guard.enabled
            if self._ready and not self._guard.enabled:
                self.refused.append((self._guard.verdict, self._guard.axis))
        return sent


@pytest.mark.long
@pytest.mark.timeout(600)
def test_a_mission_with_a_step_of_the_guard_for_every_frame(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Driving, swing arms and crane: the keys and the motions of a tick are in several frames."""
    guards: list[FrameByFrame] = []

    def built(profile: Path) -> FrameByFrame:
        guards.append(FrameByFrame(build(profile)))
        return guards[-1]

    monkeypatch.setattr(lockstep, "build_guard", built)
    path = mission_file(tmp_path / "mission.geojson", (8.0, 3.6, 80.0))
    result = CliRunner().invoke(app, ["mission", "run", str(path), "--lockstep", "--out", str(tmp_path / "run")])
    assert [guard.refused for guard in guards] == [[]], result.output[-2000:]
    told = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert result.exit_code == 0 and told["loaded"] == 1 and told["stops"] == 0
