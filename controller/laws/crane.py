"""All joints together: what they want, slowed by one factor so that the path is kept.

When one joint wants more than its limit, or all together more than the pump gives, every joint gets the same share: the
crane goes on along its path, later.  The pump's flow and what a joint's speed costs come from the profile.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

from controller.estimator import JointEstimator
from controller.laws.joint import JointLaw
from controller.laws.sway import Sway
from controller.valve import ValveMap
from machine.joints import JOINTS, N_JOINTS
from machine.profile import Profile, joint

FLOW_SHARE: Final = 0.97
"""Share of the pump's flow that the joints may ask for."""
LOADS: Final = (("SlewA", "SlewB"), ("LiftA", "LiftB"), ("TiltA", "TiltB"), ("ExtA", "ExtB"), None)
"""Chamber pressures of each joint in PressA and PressB, the one that pushes in its direction first."""


class CraneLaw:
    """One law and one valve map per joint; ``commands`` are the joint velocities of this tick."""

    __slots__ = ("_areas", "_flow", "_flow_minus", "_flow_plus", "commands", "laws", "valves")

    def __init__(self, profile: Profile, period_s: float) -> None:
        specs = [joint(profile, j) for j in JOINTS]
        self.valves = [ValveMap(spec.valve) for spec in specs]
        self.laws = [JointLaw(spec, valve, period_s) for spec, valve in zip(specs, self.valves, strict=True)]
        self._flow = FLOW_SHARE * profile.hydraulics.pump_flow_m3_s
        self._flow_plus = tuple(spec.valve.flow_plus for spec in specs)
        self._flow_minus = tuple(spec.valve.flow_minus for spec in specs)
        self._areas = tuple(spec.valve.flow_minus / spec.valve.flow_plus for spec in specs)
        self.commands = [0.0] * N_JOINTS

    def reset(self) -> None:
        """All valves are at neutral."""
        for j, law in enumerate(self.laws):
            law.reset()
            self.commands[j] = 0.0

    def load_bar(self, j: int, push_bar: float | None, against_bar: float | None) -> float:
        """Pressure [bar] in the pushing chamber that would carry the load alone; NaN where one is unknown."""
        if push_bar is None or against_bar is None:
            return math.nan
        return push_bar - against_bar * self._areas[j]

    def step(
        self,
        reference: Sequence[float],
        velocity: Sequence[float],
        ahead: Sequence[float],
        estimators: Sequence[JointEstimator],
        loads_bar: Sequence[float],
        cap: float,
        elapsed_s: float,
        sway: Sway | None = None,
    ) -> None:
        """One tick, all sequences in ``Joint`` order: reference and its velocity now, its velocity ``lead_ns`` of each
        law ahead, estimates, load pressures; ``cap`` scales the speed limits (1, or 0.5 when degraded);
        ``sway`` moves the joints on top of the reference while it is active.
        """
        share, flow = 1.0, 0.0
        for j, law in enumerate(self.laws):
            e, valve = estimators[j], self.valves[j]
            valve.place(e.position)
            moved = (0.0, 0.0) if sway is None else (sway.velocity[j], sway.displacement[j])
            wanted = law.wanted(
                reference[j], velocity[j], ahead[j], e.position, e.velocity, loads_bar[j], elapsed_s, *moved
            )
            share = min(share, law.room(cap))
            flow += valve.arm * (wanted * self._flow_plus[j] if wanted >= 0.0 else -wanted * self._flow_minus[j])
        if flow > self._flow:
            share = min(share, self._flow / flow)
        for j, law in enumerate(self.laws):
            self.commands[j] = law.finish(share, elapsed_s)

    def fade(self, share: float) -> None:
        """The last commands, fading while a stop's ramp runs."""
        for j, law in enumerate(self.laws):
            self.commands[j] = law.velocity_command * share
