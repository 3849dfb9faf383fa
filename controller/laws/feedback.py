"""Feedback laws that turn a joint's error into a velocity correction, behind one interface: six own, and foreign ones.

All are of the velocity type (docs/reference/machines.md section 4) and share one budget: ``kp_1_s`` is the greatest
small-signal gain inside the ``layer``, which `timberhand bench loop-design` bounds; how a law uses it is written here
and nowhere else.  A joint that is commanded by velocity has relative degree one: its sliding surface is the error, and
its velocity enters by the estimate of the perturbation (``sliding_mode_pe``, `controller.laws.response.ValveGain`).
Sliding mode and super-twisting are reconstructions: paper B names the first and cites La Hera and Ortiz Morales
2015, whose equations were not available.  Any other ``kind`` is an entry point of the group ``timberhand.joint_laws``,
a factory that takes the `Law` and returns a `Feedback` (docs/how-to/extend.md).
"""

from __future__ import annotations

import math
from typing import Final, Protocol

from machine.profile import JOINT_LAWS, Law
from runtime.errors import ConfigError
from runtime.plugins import load_plugin

REACHING_SHARE: Final = 0.5
"""Share of the budget in the switching term; the rest is the proportional term lambda e."""
ESTIMATING: Final = "sliding_mode_pe"
"""Sliding mode with perturbation estimation (Elmali and Olgac 1992)."""
ESTIMATING_SHARE: Final = 0.25
"""Share of the budget in its switching term: with the whole rest it would chatter more than a PD law."""
INTEGRAL_SHARE: Final = 0.05
"""Integral gain of the three laws that have one, inside the layer, over the budget squared [-].  More would take the
gain margin of the slew, whose load swings at its crossover.
"""
PLAIN_SHARE: Final = 0.25
"""Share of the budget that the plain PD uses.  It has no delay compensation and no pressure feedback; more would take
its margins when a load swings under the slew.
"""
PLAIN_PERIOD_S: Final = 0.02
"""Period of paper A's PLC, which holds the command in between."""


class Feedback(Protocol):
    """Interface of a feedback law."""

    def reset(self) -> None:
        """Clear the integrals."""

    def step(self, error: float, error_rate: float, elapsed_s: float, frozen: bool) -> float:
        """Return the correction [unit/s] of an error [unit]; ``frozen``: the command is limited, so integrals stop."""


class Pd:
    """Kp e + Kd e', with everything that `controller.laws.joint` adds."""

    __slots__ = ("_kd", "_kp")

    def __init__(self, law: Law) -> None:
        self._kp, self._kd = law.kp_1_s, law.kd

    def reset(self) -> None:
        """Do nothing: a PD law has no state."""

    def step(self, error: float, error_rate: float, elapsed_s: float, frozen: bool) -> float:
        return self._kp * error + self._kd * error_rate


class PlainPd:
    """Paper A's law as its PLC runs it: Kp e + Kd e' at 50 Hz, without lead of the feed-forward, delay compensation and
    damping (docs/reference/machines.md section 4).
    """

    __slots__ = ("_held", "_kd", "_kp", "_left_s")

    def __init__(self, law: Law) -> None:
        self._kp, self._kd = PLAIN_SHARE * law.kp_1_s, law.kd
        self.reset()

    def reset(self) -> None:
        """Make the next step compute."""
        self._held = self._left_s = 0.0

    def step(self, error: float, error_rate: float, elapsed_s: float, frozen: bool) -> float:
        if self._left_s <= 0.5 * elapsed_s:
            self._left_s += PLAIN_PERIOD_S
            self._held = self._kp * error + self._kd * error_rate
        self._left_s -= elapsed_s
        return self._held


class Pid:
    """PD with an integral, with everything that `controller.laws.joint` adds; tuned by the same margins."""

    __slots__ = ("_integral", "_kd", "_ki", "_kp")

    def __init__(self, law: Law) -> None:
        self._kp, self._kd = law.kp_1_s, law.kd
        self._ki = INTEGRAL_SHARE * self._kp**2
        self._integral = 0.0

    def reset(self) -> None:
        self._integral = 0.0

    def step(self, error: float, error_rate: float, elapsed_s: float, frozen: bool) -> float:
        if not frozen:
            self._integral += self._ki * error * elapsed_s
        return self._kp * error + self._kd * error_rate + self._integral


class SlidingMode:
    """lambda e + Kd e' + k1 tanh(sigma / phi),  sigma = e + mu integral e."""

    __slots__ = ("_integral", "_k1", "_kd", "_lambda", "_layer", "_mu")

    def __init__(self, law: Law) -> None:
        self._kd, self._layer = law.kd, law.layer
        share = ESTIMATING_SHARE if law.kind == ESTIMATING else REACHING_SHARE
        self._k1 = share * law.kp_1_s * law.layer
        self._lambda = (1.0 - REACHING_SHARE) * law.kp_1_s
        self._mu = INTEGRAL_SHARE / share * law.kp_1_s
        self._integral = 0.0

    def reset(self) -> None:
        self._integral = 0.0

    def step(self, error: float, error_rate: float, elapsed_s: float, frozen: bool) -> float:
        if not frozen:
            self._integral = _within(self._integral + self._mu * error * elapsed_s, 2.0 * self._layer)
        reaching = self._k1 * math.tanh((error + self._integral) / self._layer)
        return self._lambda * error + self._kd * error_rate + reaching


class SuperTwisting:
    """lambda e + Kd e' + k1 |e|^1/2 sat(e / phi) + w,  w' = k2 sat(e / phi).

    The surface is the error itself: with a second integral beside w the loop would be only conditionally stable.
    """

    __slots__ = ("_k1", "_k2", "_kd", "_lambda", "_layer", "_twist", "_twist_limit")

    def __init__(self, law: Law) -> None:
        kp = law.kp_1_s
        self._kd, self._layer = law.kd, law.layer
        self._k1 = REACHING_SHARE * kp * math.sqrt(law.layer)
        self._k2 = INTEGRAL_SHARE * kp * kp * law.layer
        self._lambda = (1.0 - REACHING_SHARE) * kp
        self._twist_limit = kp * law.layer
        self._twist = 0.0

    def reset(self) -> None:
        self._twist = 0.0

    def step(self, error: float, error_rate: float, elapsed_s: float, frozen: bool) -> float:
        side = _within(error / self._layer, 1.0)
        if not frozen:
            self._twist = _within(self._twist + self._k2 * side * elapsed_s, self._twist_limit)
        reaching = self._k1 * math.sqrt(abs(error)) * side + self._twist
        return self._lambda * error + self._kd * error_rate + reaching


class Foreign:
    """The law of another package.

    It raises what that law raises, and ArithmeticError where it returns no finite number: the controller then ends, and
    the valves are neutral when the next command is missing.
    """

    __slots__ = ("_kind", "_law")

    def __init__(self, law: Law) -> None:
        self._kind = law.kind
        try:
            self._law: Feedback = load_plugin(JOINT_LAWS, law.kind, law)
        except ConfigError as error:
            raise ConfigError(error.code, str(error)) from error

    def reset(self) -> None:
        self._law.reset()

    def step(self, error: float, error_rate: float, elapsed_s: float, frozen: bool) -> float:
        velocity = float(self._law.step(error, error_rate, elapsed_s, frozen))
        if not math.isfinite(velocity):
            raise ArithmeticError(f"the joint law {self._kind!r} returned {velocity}, not a velocity; correct the law")
        return velocity


LAWS: Final[dict[str, type[Pd] | type[PlainPd] | type[Pid] | type[SlidingMode] | type[SuperTwisting]]] = {
    "pd": Pd,
    "pd_plain": PlainPd,
    "pid": Pid,
    "sliding_mode": SlidingMode,
    "sliding_mode_pe": SlidingMode,
    "super_twisting": SuperTwisting,
}
"""The laws named in `machine.profile.OWN_LAWS`."""


def law_of(law: Law) -> Pd | PlainPd | Pid | SlidingMode | SuperTwisting | Foreign:
    """Make the law that a profile names.

    Raises:
        ConfigError: no installed package has such a law, or it cannot be loaded.
    """
    own = LAWS.get(law.kind)
    return own(law) if own is not None else Foreign(law)


def _within(value: float, limit: float) -> float:
    return min(max(value, -limit), limit)
