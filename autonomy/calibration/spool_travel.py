"""Travel by spools: a motion to a pose on a machine whose valves the controller's profile does not describe.

An ordinary trajectory is followed by the controller's laws through the profile's valve map.  Where the searches have
found another valve, one joint after the other goes to its place as a spool test, at half its speed limit at most, and
shuts ahead of it by what its dead time and oil still move.  What is left is done again, more slowly.  The order of the
joints is the one that keeps the pin highest and farthest from the column on the way.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import permutations
from math import hypot
from typing import Final

from autonomy.calibration.spool_program import Allowed, allowed_by, command_for, deadband_pct, side_limit, steady
from autonomy.calibration.spool_run import SpoolRun
from machine.geometry.kinematics import pin_position
from machine.joints import Joint
from machine.profile import JointSpec, Kinematics
from runtime.errors import Problem

CRUISE_SHARES: Final = (0.3, 0.5, 0.5, 0.5, 0.5)
CREEP_SHARE: Final = 0.08
"""Greatest speeds and the least, shares of the speed limit."""
APPROACH_S: Final = (2.6, 1.6, 1.6, 1.6, 1.6)
"""A way is begun at a speed that would take this long for it."""
MAX_HOLD_S: Final = 14.0
"""The controller lets no test hold a valve open for over 20 s; what is left is another leg."""
CLOSE_S: Final = (2.4, 0.8, 0.8, 0.8, 0.8)
"""A travelling joint opens and closes so gently.  A crane far out swings on the oil of its slew with a period of up to
2.5 s: shut within 0.6 s from 0.4 of its speed limit it swings back by 2 degrees for a second (measured), which no
monitor takes for rest; a ramp as long as the period, from less speed, leaves half a degree."""
MIN_OPENING_PCT, PLAY_PCT = 1.0, 2.0
"""Least opening that a ramp is planned for; the usual play of a spool, which a valve that closes takes up first."""
EDGE_PCT: Final = 2.0
"""A gentle ramp ends this far below the known edge of the dead-band, as the search may be wrong by so much; the rest is
a step."""
AFTER_S: Final = 0.15
"""What a joint still moves, besides dead time and half of the closing: oil, samples and the planner's period."""
TOLERANCES: Final = (0.02, 0.02, 0.025, 0.025, 0.06)
"""A joint this near has arrived [rad, m]."""
NEAR_ENOUGH: Final = 3.0
"""A valve with a long dead time moves its joint by more than the tolerance however briefly it opens: after `MAX_LEGS`,
so many tolerances will do.  The tests begin where the joint is, and the plan keeps clear of obstacles by more."""
MAX_LEGS: Final = 8
"""Legs of one joint to one pose."""
HARDLY: Final = 0.25
STEEPER: Final = 0.35
"""A leg that has moved the joint by less than the first share of its way is followed by one that is faster by the
second."""
_SAMPLES: Final = 6


class Leg(SpoolRun):
    """One joint on its way to ``goal`` by its spool."""

    def __init__(
        self, which: Joint, spec: JointSpec, allowed: Allowed, start: float, goal: float, stalled: int
    ) -> None:
        """Plan the leg; ``stalled``: legs to the same goal that hardly moved the joint."""
        self.joint, self.goal, self.start = which, goal, start
        self.side = 1 if goal > start else -1
        far = abs(goal - start)
        least = CREEP_SHARE * (1.0 + STEEPER * stalled)
        limit = side_limit(spec, self.side)
        share = min(CRUISE_SHARES[which], max(far / APPROACH_S[which] / limit, least))
        deadband = deadband_pct(spec, self.side)
        self._edge_pct = max(0.0, deadband - EDGE_PCT)
        opening_pct = max(command_for(spec, self.side, share * limit) - deadband, MIN_OPENING_PCT)
        rate_pct_s = opening_pct / CLOSE_S[which]
        self._close_s = (opening_pct + deadband - self._edge_pct) / rate_pct_s
        self._after_s = spec.valve.delay_s + PLAY_PCT / rate_pct_s + 0.5 * CLOSE_S[which] + AFTER_S
        self.closed = False
        gentle = min(1.0, rate_pct_s / min(allowed.rate_pct_s, allowed_by(spec).rate_pct_s))
        super().__init__(steady(spec, self.side, (share,), MAX_HOLD_S, allowed, gentle))

    def follow(self, run_s: float, position: float, velocity: float) -> Problem | None:
        """Shut the valve ahead of the goal."""
        remaining = self.side * (self.goal - position)
        if not self.closed and remaining <= max(0.0, self.side * velocity) * self._after_s:
            self.finish(run_s, self._close_s, self._edge_pct)
            self.closed = True
        return None


class SpoolTravel:
    """The way to one pose: `next_leg` until it is None."""

    def __init__(self, goal: Sequence[float], order: Sequence[Joint]) -> None:
        self.goal, self._order = goal, list(order)
        self._tries = self._stalled = 0
        self._from = 0.0
        """Where the leg before began."""
        self.stuck: Joint | None = None
        """The joint that does not reach its place."""

    def next_leg(self, position: Sequence[float], specs: Sequence[JointSpec], allowed: Sequence[Allowed]) -> Leg | None:
        """Choose the next leg from the present joints (all in ``Joint`` order); None at the goal, or when a joint does
        not reach it (`stuck`).
        """
        while self._order:
            j = self._order[0]
            remaining, over = abs(self.goal[j] - position[j]), self._tries >= MAX_LEGS
            if remaining <= TOLERANCES[j] * (NEAR_ENOUGH if over else 1.0):
                self._order.pop(0)
                self._tries = self._stalled = 0
                continue
            if over:
                self.stuck = j
                return None
            if self._tries and abs(position[j] - self._from) < HARDLY * abs(self.goal[j] - self._from):
                self._stalled += 1
            self._tries, self._from = self._tries + 1, position[j]
            return Leg(j, specs[j], allowed[j], position[j], self.goal[j], self._stalled)
        return None


def best_order(
    kinematics: Kinematics,
    start: Sequence[float],
    goal: Sequence[float],
    joints: Sequence[Joint],
    clear_z_m: float,
    least_reach_m: float,
) -> list[Joint]:
    """Find the order of ``joints`` in which the pin comes least under ``clear_z_m`` or within ``least_reach_m``."""
    orders = [list(order) for order in permutations(joints)]
    return min(orders, key=lambda order: _depth_m(kinematics, start, goal, order, clear_z_m, least_reach_m))


def _depth_m(
    kinematics: Kinematics,
    start: Sequence[float],
    goal: Sequence[float],
    order: Sequence[Joint],
    clear_z_m: float,
    least_reach_m: float,
) -> float:
    """Compute how far the pin comes into what it should stay clear of, summed over the way, m."""
    at, depth = list(start), 0.0
    for j in order:
        for i in range(1, _SAMPLES + 1):
            q = [*at]
            q[j] = at[j] + (goal[j] - at[j]) * i / _SAMPLES
            x, y, z = pin_position(kinematics, q)
            depth += max(0.0, clear_z_m - z) + max(0.0, least_reach_m - hypot(x, y))
        at[j] = goal[j]
    return depth
