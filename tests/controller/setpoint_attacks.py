"""Planners that drive a crane as fast as setpoints allow, each of which the controller accepts.

An attack is a function of the controller's reference, the reference's velocity and the time since it began; it returns
the knots of the setpoint to send now: (after_ms, position, velocity).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final

from machine.joints import JOINTS, N_JOINTS
from machine.profile import Profile, joint

Axes = list[float]
Knots = list[tuple[float, Axes, Axes]]
JUMP_S: Final = 0.09
"""Just under the jump that is accepted, with a tick between the setpoint and its stamp."""
FAST_SHARE: Final = 1.04
ROOM_SHARE: Final = 0.25
_ZERO: Final = [0.0] * N_JOINTS


class Attacker:
    """Attacks some joints, away from the ends of their ranges."""

    def __init__(self, profile: Profile, joints: Sequence[int]) -> None:
        self.joints = joints
        self._specs = [joint(profile, j) for j in JOINTS]
        self._sides = [1.0] * N_JOINTS

    def knots(self, kind: str, reference: Axes, velocity: Axes, since_s: float) -> Knots:
        """The setpoint of the attack ``kind``, a name in `ATTACKS`."""
        for j in self.joints:
            spec = self._specs[j]
            room = ROOM_SHARE * (spec.upper - spec.lower)
            if reference[j] > spec.upper - room:
                self._sides[j] = -1.0
            if reference[j] < spec.lower + room:
                self._sides[j] = 1.0
        return ATTACKS[kind](self, reference, velocity, since_s)

    def ahead(self, reference: Axes, sign: float = 1.0) -> Axes:
        """As far from the reference as is accepted."""
        return self._with(reference, lambda j, q: q + sign * self._sides[j] * JUMP_S * self._specs[j].speed_limit)

    def faster(self, velocity: Axes) -> Axes:
        """As much faster as is accepted."""

        def more(j: int, v: float) -> float:
            most = FAST_SHARE * self._specs[j].speed_limit
            return max(-most, min(most, v + self._sides[j] * 0.2 * self._specs[j].acceleration_limit))

        return [v if j in self.joints else 0.0 for j, v in enumerate(self._with(velocity, more))]

    def _with(self, values: Axes, change: Callable[[int, float], float]) -> Axes:
        return [change(j, v) if j in self.joints else v for j, v in enumerate(values)]


def _after(position: Axes, velocity: Axes, seconds: float) -> Axes:
    return [p + v * seconds for p, v in zip(position, velocity, strict=True)]


def _rest_ahead(a: Attacker, q: Axes, v: Axes, t_s: float) -> Knots:
    goal = a.ahead(q)
    return [(0, goal, _ZERO), (400, goal, _ZERO)]


def _one_knot(a: Attacker, q: Axes, v: Axes, t_s: float) -> Knots:
    return [(0, a.ahead(q), _ZERO)]


def _to_and_fro(a: Attacker, q: Axes, v: Axes, t_s: float) -> Knots:
    goal = a.ahead(q, 1.0 if int(t_s / 0.6) % 2 == 0 else -1.0)
    return [(0, goal, _ZERO), (400, goal, _ZERO)]


def _field(a: Attacker, q: Axes, v: Axes, t_s: float) -> Knots:
    """Ahead of the reference in position and in velocity."""
    goal, speed = a.ahead(q), a.faster(v)
    return [(0, goal, speed), (400, _after(goal, speed, 0.4), speed)]


def _before_the_first(a: Attacker, q: Axes, v: Axes, t_s: float) -> Knots:
    """The first knot lies in the future: the curve is extended back to now."""
    speed = a.faster(v)
    first = _after(a.ahead(q), speed, 0.3)
    return [(300, first, speed), (700, _after(first, speed, 0.4), speed)]


def _rest_that_never_comes(a: Attacker, q: Axes, v: Axes, t_s: float) -> Knots:
    """As fast as is accepted now, and at rest before a command of now shows at the joint."""
    speed = a.faster(v)
    end = _after(q, speed, 0.015)
    return [(0, q, speed), (30, end, _ZERO), (400, end, _ZERO)]


def _lag_then_go(a: Attacker, q: Axes, v: Axes, t_s: float) -> Knots:
    """Lets the joint fall behind and then has it catch up."""
    if t_s % 3.0 < 1.5:
        return _rest_that_never_comes(a, q, v, t_s)
    speed = a.faster(v)
    return [(0, q, speed), (600, _after(q, speed, 0.6), speed)]


ATTACKS: Final[dict[str, Callable[[Attacker, Axes, Axes, float], Knots]]] = {
    "rest ahead": _rest_ahead,
    "one knot": _one_knot,
    "to and fro": _to_and_fro,
    "field": _field,
    "before the first": _before_the_first,
    "rest that never comes": _rest_that_never_comes,
    "lag, then go": _lag_then_go,
}
