"""Time scaling: the trajectory's time runs at a rate of at most 1, so that the crane can stay on its path.

A planner's motion may need more oil than the pump gives, and a degraded machine may only move at half speed.  Slowing
single joints would leave the path; slowing the trajectory's time slows all of them together.  The rate follows the
reference's velocity one valve delay ahead and changes smoothly.  The time behind the planner's clock is bounded; beyond
the bound the laws' own limits act (`controller.laws.crane`).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from controller.laws.valve_map import ValveMap
from machine.joints import JOINTS
from machine.motion_limits import SPEED_HEADROOM_SHARE
from machine.profile import Profile, joint

FLOW_SHARE: Final = 0.96
"""Share of the pump's flow that a reference may use; corrections need the rest."""
SPEED_SHARE: Final = 0.9
"""Share of a law's greatest speed that a reference may use."""
RATE_CHANGE_1_S: Final = 2.0
MAX_BEHIND_NS: Final = 800_000_000


class TimeScaling:
    """``rate``: seconds of trajectory time per second; ``behind_ns``: how far it is behind the tick's time."""

    __slots__ = ("_fastest", "_flow", "_flow_minus", "_flow_plus", "_speed", "behind_ns", "rate")

    def __init__(self, profile: Profile) -> None:
        specs = [joint(profile, j) for j in JOINTS]
        self._flow = FLOW_SHARE * profile.hydraulics.pump_flow_m3_s
        self._flow_plus = tuple(s.valve.flow_plus for s in specs)
        self._flow_minus = tuple(s.valve.flow_minus for s in specs)
        self._fastest = tuple(s.speed_limit for s in specs)
        self._speed = tuple(SPEED_SHARE * SPEED_HEADROOM_SHARE * s.speed_limit for s in specs)
        self.reset()

    def reset(self) -> None:
        """The trajectory is on time."""
        self.rate = 1.0
        self.behind_ns = 0

    def step(self, lead_velocity: Sequence[float], valves: Sequence[ValveMap], cap: float, elapsed_ns: int) -> None:
        """One tick with the reference's velocities at rate 1, one delay ahead; ``cap`` scales the speed limits."""
        wanted, flow = 1.0, 0.0
        for j, velocity in enumerate(lead_velocity):
            if velocity >= 0.0:
                speed = velocity
                flow += speed * self._flow_plus[j] * valves[j].arm
            else:
                speed = -velocity
                flow += speed * self._flow_minus[j] * valves[j].arm
            limit = min(cap * self._speed[j], self._fastest[j])
            if speed * wanted > limit:
                wanted = limit / speed
        if flow * wanted > self._flow:
            wanted = self._flow / flow
        if self.behind_ns >= MAX_BEHIND_NS:
            wanted = 1.0
        change = RATE_CHANGE_1_S * elapsed_ns * 1e-9
        self.rate = min(max(wanted, self.rate - change), self.rate + change, 1.0)
        self.behind_ns += int((1.0 - self.rate) * elapsed_ns)
