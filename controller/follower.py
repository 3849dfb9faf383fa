"""What the joints are to do now: the accepted trajectory at its own time, or the place where they are.

Inputs: accepted setpoints, the tick's time. Outputs: ``reference`` and ``velocity`` of every joint now, and ``ahead``,
its velocity when a command given now shows at the joint. The trajectory's time runs at the rate of
`controller.laws.pace`; while it is behind the planner's clock, a new setpoint is joined to the end of what is still to
be done.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from controller.laws.pace import Pace
from controller.trajectory import Trajectory
from controller.valve import ValveMap
from machine.joints import JOINTS, N_JOINTS
from machine.profile import Profile

_SAME: Final = 1e-9


class Follower:
    """Trajectory and pace; `load` a setpoint into ``candidate``, judge it against `planned`, then `take` it."""

    __slots__ = (
        "_last_ns", "_leads", "_pace", "_plan", "_plan_velocity", "_valves", "_wanted", "ahead", "candidate",
        "reference", "trajectory", "velocity",
    )  # fmt: skip

    def __init__(self, profile: Profile, valves: Sequence[ValveMap], leads_ns: Sequence[int]) -> None:
        self._valves = valves
        self._leads = tuple((ns, tuple(j for j in JOINTS if leads_ns[j] == ns)) for ns in sorted(set(leads_ns)))
        self._pace = Pace(profile)
        self._last_ns = 0
        self.trajectory, self.candidate = Trajectory(), Trajectory()
        self.reference = [float("nan")] * N_JOINTS
        self.velocity = [0.0] * N_JOINTS
        self.ahead = [0.0] * N_JOINTS
        self._wanted = [0.0] * N_JOINTS
        """``ahead`` at rate 1."""
        self._plan, self._plan_velocity = [0.0] * N_JOINTS, [0.0] * N_JOINTS

    @property
    def rate(self) -> float:
        """Seconds of the trajectory per second."""
        return self._pace.rate

    @property
    def behind_ns(self) -> int:
        """How far the trajectory's time is behind the planner's."""
        return self._pace.behind_ns

    def hold(self, j: int, position: float, now_ns: int) -> None:
        """A joint that does not follow a trajectory is to stay."""
        self.reference[j] = position
        self.velocity[j] = self.ahead[j] = self._wanted[j] = 0.0
        self._pace.reset()
        self._last_ns = now_ns

    def planned(self, now_ns: int) -> tuple[Sequence[float], Sequence[float]]:
        """Position and velocity that the planner gave for now; a new setpoint continues them."""
        self.trajectory.fill(JOINTS, now_ns, self._plan, self._plan_velocity)
        return self._plan, self._plan_velocity

    def take(self, now_ns: int, joins: bool) -> None:
        """Follows the candidate; ``joins``: it continues the plan, so what is still to be done comes first."""
        if joins and self._pace.behind_ns:
            self.trajectory.extend(self.candidate, now_ns - self._pace.behind_ns)
        else:
            self.trajectory, self.candidate = self.candidate, self.trajectory
            self._pace.reset()

    def follow(self, now_ns: int, cap: float) -> None:
        """The reference of this tick; ``cap`` scales the speed limits."""
        pace, trajectory = self._pace, self.trajectory
        elapsed_ns, self._last_ns = now_ns - self._last_ns, now_ns
        if elapsed_ns:
            pace.step(self._wanted, self._valves, cap, elapsed_ns)
        rate, time_ns = pace.rate, now_ns - pace.behind_ns
        trajectory.fill(JOINTS, time_ns, self.reference, self.velocity)
        for lead_ns, joints in self._leads:
            trajectory.fill(joints, time_ns + int(rate * lead_ns), self._plan, self._wanted)
        if pace.behind_ns and self._done(now_ns):
            pace.reset()
        for j in range(N_JOINTS):
            self.velocity[j] *= rate
            self.ahead[j] = rate * self._wanted[j]

    def _done(self, now_ns: int) -> bool:
        """Whether nothing is left to catch up with: reference and plan rest at the same place."""
        plan, velocity = self.planned(now_ns)
        return (
            not any(self.velocity)
            and not any(velocity)
            and all(abs(p - r) < _SAME for p, r in zip(plan, self.reference, strict=True))
        )

    def at_rest(self, now_ns: int) -> bool:
        """Whether the trajectory's last knot is reached, or nothing moves."""
        return now_ns - self._pace.behind_ns >= self.trajectory.end_ns or not any(self.velocity)

    def over(self, now_ns: int) -> bool:
        """Whether the trajectory ended while it still moved."""
        return now_ns - self._pace.behind_ns > self.trajectory.end_ns and not self.trajectory.ends_at_rest
