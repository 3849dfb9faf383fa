"""The trajectory's own time: it runs at a rate of at most 1, so that the crane can keep its path.

A planner's motion may ask for more oil than the pump gives, and a degraded machine may only go half as fast.  Slowing
single joints would leave the path; slowing the trajectory's time slows all of them together.  The rate follows what the
reference wants a valve's delay ahead and changes smoothly.  How far the trajectory is behind the planner's clock is
bounded; beyond that the laws' own limits act (`controller.laws.crane`).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from controller.laws.joint import HEADROOM
from controller.valve import ValveMap
from machine.joints import JOINTS
from machine.profile import Profile, joint

FLOW_SHARE: Final = 0.96
"""Share of the pump's flow that a reference may ask for; corrections need the rest."""
SPEED_SHARE: Final = 0.9
"""Share of the speed that a law may command."""
RATE_CHANGE_1_S: Final = 2.0
BEHIND_LIMIT_NS: Final = 800_000_000


class Pace:
    """``behind_ns``: how far the trajectory's time is behind the tick's; ``rate``: its seconds per second."""

    __slots__ = ("_flow", "_flow_minus", "_flow_plus", "_speed", "behind_ns", "rate")

    def __init__(self, profile: Profile) -> None:
        specs = [joint(profile, j) for j in JOINTS]
        self._flow = FLOW_SHARE * profile.hydraulics.pump_flow_m3_s
        self._flow_plus = tuple(s.valve.flow_plus for s in specs)
        self._flow_minus = tuple(s.valve.flow_minus for s in specs)
        self._speed = tuple(SPEED_SHARE * HEADROOM * s.speed_limit for s in specs)
        self.reset()

    def reset(self) -> None:
        """On time."""
        self.rate = 1.0
        self.behind_ns = 0

    def step(self, ahead: Sequence[float], valves: Sequence[ValveMap], cap: float, elapsed_ns: int) -> None:
        """One tick: the reference's velocities at rate 1, a delay ahead; ``cap`` scales the speed limits."""
        wanted, flow = 1.0, 0.0
        for j, velocity in enumerate(ahead):
            if velocity >= 0.0:
                speed = velocity
                flow += speed * self._flow_plus[j] * valves[j].arm
            else:
                speed = -velocity
                flow += speed * self._flow_minus[j] * valves[j].arm
            limit = cap * self._speed[j]
            if speed * wanted > limit:
                wanted = limit / speed
        if flow * wanted > self._flow:
            wanted = self._flow / flow
        if self.behind_ns >= BEHIND_LIMIT_NS:
            wanted = 1.0
        change = RATE_CHANGE_1_S * elapsed_ns * 1e-9
        self.rate = min(max(wanted, self.rate - change), self.rate + change, 1.0)
        self.behind_ns += int((1.0 - self.rate) * elapsed_ns)
