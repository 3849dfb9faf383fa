"""How near ordinary work comes to a false stop: what each monitor measures, over what it calls a fault.

Once a tick every monitor tells its share: its statistic over its threshold, so 1 is a fault.  A second of work counts
by its greatest share, as a histogram for each monitor; the greatest of all is kept with the joint and the moment.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterable, Mapping
from typing import Any, Final

from controller.guard.guard import Guard
from controller.step import Controller
from controller.tick import Outputs
from controller.transitions import OPERATING
from machine.joints import JOINTS

EDGES: Final = (0.25, 0.5, 0.7, 0.8, 0.9, 1.0)
"""Between the bins of the histograms."""
SECOND_NS: Final = 1_000_000_000

Shares = dict[str, dict[str, Any]]
"""By monitor: ``bins`` (seconds of work in each), ``most``, and ``where`` and ``at_s`` of that."""


class Separation:
    """The hook of one run: `outputs` for every tick; ``shares`` is the result."""

    def __init__(self, controller: Controller, guard: Guard, start_ns: int) -> None:
        self._controller, self._guard, self._start_ns = controller, guard, start_ns
        self._second: dict[str, float] = {}
        self._ends_ns = 0
        self.shares: Shares = {}

    def outputs(self, outputs: Outputs, now_ns: int) -> None:
        """Evaluate the outputs of a tick: only what an armed machine measures can stop its work."""
        if outputs.mode not in OPERATING:
            return
        controller = self._controller
        for j in JOINTS:
            self._take(controller.joint_watch.shares(j), j.name.lower(), now_ns)
            self._take(controller.valve_watch.shares(j), j.name.lower(), now_ns)
            self._take({"encoder noisy": controller.estimators[j].noise_share()}, j.name.lower(), now_ns)
        if controller.vehicle is not None:
            self._take(controller.vehicle.monitor.shares(now_ns), "carrier", now_ns)
        guard = self._guard
        self._take(
            {
                "guard: joint moves with its valve shut": max(watch.share() for _, watch in guard.motion),
                "guard: joint too fast": max((joint.share() for joint in guard.joints.values()), default=0.0),
            },
            "guard",
            now_ns,
        )
        if now_ns >= self._ends_ns:
            self._ends_ns = now_ns + SECOND_NS
            for name, share in self._second.items():
                self.shares[name]["bins"][bisect_right(EDGES, share)] += 1
            self._second.clear()

    def _take(self, shares: Mapping[str, float], where: str, now_ns: int) -> None:
        second = self._second
        for name, share in shares.items():
            if share > second.get(name, -1.0):
                second[name] = share
                known = self.shares.setdefault(name, {"bins": [0] * (len(EDGES) + 1), "most": 0.0})
                if share > known["most"]:
                    known |= {"most": share, "where": where, "at_s": (now_ns - self._start_ns) * 1e-9}


def merged(outcomes: Iterable[Mapping[str, Any]]) -> Shares:
    """Merge the shares of several runs, each with its ``scene``, ``seed`` and ``shares``."""
    total: Shares = {}
    for outcome in outcomes:
        for name, one in outcome["shares"].items():
            known = total.setdefault(name, {"bins": [0] * (len(EDGES) + 1), "most": 0.0, "where": "", "run": ""})
            known["bins"] = [a + b for a, b in zip(known["bins"], one["bins"], strict=True)]
            if one["most"] > known["most"]:
                run = f"{outcome['scene']}, seed {outcome['seed']}, after {one['at_s']:.0f} s"
                known |= {"most": one["most"], "where": one["where"], "run": run}
    return total
