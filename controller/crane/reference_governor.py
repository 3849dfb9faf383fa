"""The reference governor: what the joints are to do now, at a rate of time that the machine can follow.

Inputs: accepted setpoints and the tick's time.  Outputs: ``position`` and ``velocity`` of every joint's reference now,
and ``lead_velocity``, its velocity at the moment at which a command given now shows at the joint (for the
feed-forward).  Without a trajectory the reference is the joints' position.  The trajectory's time runs at the rate of
`controller.laws.time_scaling`; while it is behind the planner's clock, a new setpoint is joined to the end of what is
still to be done.

Whatever the setpoints say, no joint's reference is faster than its speed limit, and its speed grows by no more than
`GROWTH_FACTOR` times its acceleration limit: each setpoint may begin a little off the last one's path, and a planner
that goes on so would drive the reference as fast as it likes.  A reference that is off its trajectory goes there as
fast as these limits let it; one that is on it is the trajectory to the last bit.  It may stop at once, so that it
never goes beyond its trajectory.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

from controller.crane.trajectory import Trajectory
from controller.laws.time_scaling import TimeScaling
from controller.laws.valve_map import ValveMap
from machine.joints import JOINTS, N_JOINTS
from machine.profile import Profile, joint

GROWTH_FACTOR: Final = 4.0
"""A joint's command may change this many times faster than the planner's acceleration limit (`controller.laws.joint`);
a reference that is faster still would only run ahead of it."""
_SAME_PLACE: Final = 1e-9


class ReferenceGovernor:
    """Trajectory with time scaling.

    Load a setpoint into ``candidate``, check it against `planned` or the present reference, then `accept` it.
    """

    __slots__ = (
        "_before", "_before_speed", "_elapsed_s", "_growth", "_last_ns", "_leads", "_off", "_plan", "_plan_velocity",
        "_scaling", "_speed", "_unscaled_lead", "_valves", "candidate", "lead_velocity", "position", "trajectory",
        "velocity",
    )  # fmt: skip

    def __init__(self, profile: Profile, valves: Sequence[ValveMap], leads_ns: Sequence[int]) -> None:
        self._valves = valves
        self._leads = tuple((ns, tuple(j for j in JOINTS if leads_ns[j] == ns)) for ns in sorted(set(leads_ns)))
        self._scaling = TimeScaling(profile)
        specs = [joint(profile, j) for j in JOINTS]
        self._speed = tuple(s.speed_limit for s in specs)
        self._growth = tuple(GROWTH_FACTOR * s.acceleration_limit for s in specs)
        self._last_ns = 0
        self._elapsed_s = 0.0
        """Time from the tick before to this one."""
        self._before, self._before_speed = [0.0] * N_JOINTS, [0.0] * N_JOINTS
        """Reference of the tick before and its mean speed on the way there; NaN before the first."""
        self._off = False
        """Whether a joint's reference has yet to come to its trajectory."""
        self.trajectory, self.candidate = Trajectory(), Trajectory()
        self.position = [float("nan")] * N_JOINTS
        self.velocity = [0.0] * N_JOINTS
        self.lead_velocity = [0.0] * N_JOINTS
        self._unscaled_lead = [0.0] * N_JOINTS
        """``lead_velocity`` at rate 1."""
        self._plan, self._plan_velocity = [0.0] * N_JOINTS, [0.0] * N_JOINTS

    @property
    def rate(self) -> float:
        """Seconds of trajectory time per second."""
        return self._scaling.rate

    @property
    def behind_ns(self) -> int:
        """How far the trajectory's time is behind the planner's."""
        return self._scaling.behind_ns

    def hold(self, j: int, position: float, now_ns: int) -> None:
        """Keep a joint that follows no trajectory at ``position``."""
        self.position[j] = self._before[j] = position
        self.velocity[j] = self.lead_velocity[j] = self._unscaled_lead[j] = 0.0
        self._scaling.reset()
        self._last_ns = now_ns
        self._elapsed_s = 0.0
        self._off = False

    def planned(self, now_ns: int) -> tuple[Sequence[float], Sequence[float]]:
        """Position and velocity that the planner gave for now; a new setpoint continues them."""
        self.trajectory.fill(JOINTS, now_ns, self._plan, self._plan_velocity)
        return self._plan, self._plan_velocity

    def accept(self, now_ns: int, continues: bool) -> None:
        """Follow the candidate; when it ``continues`` the plan, what is still to be done comes first."""
        if continues and self._scaling.behind_ns:
            self.trajectory.extend(self.candidate, now_ns - self._scaling.behind_ns)
        else:
            self.trajectory, self.candidate = self.candidate, self.trajectory
            self._scaling.reset()

    def follow(self, now_ns: int, cap: float) -> None:
        """Compute the reference of this tick, again after every setpoint accepted in it; ``cap`` scales the speed
        limits.
        """
        scaling, trajectory = self._scaling, self.trajectory
        elapsed_ns, self._last_ns = now_ns - self._last_ns, now_ns
        if elapsed_ns:
            scaling.step(self._unscaled_lead, self._valves, cap, elapsed_ns)
            self._leave_tick(elapsed_ns * 1e-9)
        rate, time_ns = scaling.rate, now_ns - scaling.behind_ns
        trajectory.fill(JOINTS, time_ns, self.position, self.velocity)
        for lead_ns, joints in self._leads:
            trajectory.fill(joints, time_ns + int(rate * lead_ns), self._plan, self._unscaled_lead)
        self._off = False
        for j in range(N_JOINTS):
            self._bound(j, rate)
        if scaling.behind_ns and self._caught_up(now_ns):
            scaling.reset()

    def _leave_tick(self, elapsed_s: float) -> None:
        """The present reference becomes that of the tick before, ``elapsed_s`` ago."""
        before_s, self._elapsed_s = self._elapsed_s, elapsed_s
        for j in range(N_JOINTS):
            travel = self.position[j] - self._before[j]
            if travel != travel:  # it has just begun, where the trajectory is
                self._before_speed[j] = self.velocity[j]
            else:
                self._before_speed[j] = travel / before_s if before_s > 0.0 else 0.0
            self._before[j] = self.position[j]

    def _bound(self, j: int, rate: float) -> None:
        """Scale a joint's velocities, and keep its reference within its limits of speed and growth."""
        before, limit, elapsed_s = self._before[j], self._speed[j], self._elapsed_s
        step, was = self.position[j] - before, self._before_speed[j]
        velocity, lead = rate * self.velocity[j], rate * self._unscaled_lead[j]
        fastest = min(limit, max(was if step > 0.0 else -was, 0.0) + self._growth[j] * elapsed_s)
        if abs(step) > fastest * elapsed_s:
            self._off = True
            self.position[j] = before + math.copysign(fastest * elapsed_s, step)
        self.velocity[j] = min(max(velocity, -limit), limit)
        self.lead_velocity[j] = min(max(lead, -limit), limit)

    def _caught_up(self, now_ns: int) -> bool:
        """Whether reference and plan rest at the same place, so that nothing is left to catch up with."""
        plan, velocity = self.planned(now_ns)
        return (
            not any(self.velocity)
            and not any(velocity)
            and all(abs(p - r) < _SAME_PLACE for p, r in zip(plan, self.position, strict=True))
        )

    def at_rest(self, now_ns: int) -> bool:
        """Whether the trajectory's last knot is reached, or nothing moves."""
        return not self._off and (now_ns - self._scaling.behind_ns >= self.trajectory.end_ns or not any(self.velocity))

    def ended_moving(self, now_ns: int) -> bool:
        """Whether the trajectory ended with a velocity."""
        return now_ns - self._scaling.behind_ns > self.trajectory.end_ns and not self.trajectory.ends_at_rest
