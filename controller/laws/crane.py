"""The laws of all joints together, scaled by one factor so that the crane stays on its path.

When one joint exceeds its limit, or all together the pump's flow, every joint gets the same share of its desired
velocity: the crane stays on its path and is later.  The pump's flow and the flow per joint speed come from the profile.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

from controller.estimation.joint_estimator import JointEstimator
from controller.laws.joint import JointLaw
from controller.laws.sway import SwayDamping
from controller.laws.valve_map import ValveMap
from machine.joints import JOINTS, N_JOINTS
from machine.profile import Profile, joint

FLOW_SHARE: Final = 0.97
"""Share of the pump's flow that the joints may use."""
LOADS: Final = (("SlewA", "SlewB"), ("LiftA", "LiftB"), ("TiltA", "TiltB"), ("ExtA", "ExtB"), None)
"""Chamber pressures of each joint in PressA and PressB; the chamber that pushes in the positive direction first."""


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
        """Reset for valves at neutral."""
        for j, law in enumerate(self.laws):
            law.reset()
            self.commands[j] = 0.0

    def load_pressure_bar(self, j: int, push_bar: float | None, against_bar: float | None) -> float:
        """Compute the pressure [bar] in the pushing chamber that alone carries the load; NaN where one is unknown."""
        if push_bar is None or against_bar is None:
            return math.nan
        return push_bar - against_bar * self._areas[j]

    def step(
        self,
        reference: Sequence[float],
        velocity: Sequence[float],
        lead_velocity: Sequence[float],
        estimators: Sequence[JointEstimator],
        loads_bar: Sequence[float],
        cap: float,
        elapsed_s: float,
        sway: SwayDamping | None = None,
    ) -> None:
        """Run one tick; all sequences are in ``Joint`` order.

        Reference, its velocity now and ``lead_ns`` of each law ahead, estimates, and load pressures.  ``cap`` scales
        the speed limits (1, or 0.5 when degraded); ``sway`` adds a motion to the reference while it is active.
        """
        share, flow = 1.0, 0.0
        for j, law in enumerate(self.laws):
            e, valve = estimators[j], self.valves[j]
            valve.set_position(e.position)
            added = (0.0, 0.0) if sway is None else (sway.velocity[j], sway.displacement[j])
            v = law.desired_velocity(
                reference[j], velocity[j], lead_velocity[j], e.position, e.velocity, loads_bar[j], elapsed_s, *added
            )
            share = min(share, law.feasible_share(cap))
            flow += valve.arm * (v * self._flow_plus[j] if v >= 0.0 else -v * self._flow_minus[j])
        if flow > self._flow:
            share = min(share, self._flow / flow)
        for j, law in enumerate(self.laws):
            self.commands[j] = law.command(share, elapsed_s)

    def fade(self, share: float) -> None:
        """Scale the last commands during a stop's ramp."""
        for j, law in enumerate(self.laws):
            self.commands[j] = law.velocity_command * share
