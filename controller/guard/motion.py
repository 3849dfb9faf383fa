"""Motion that nobody commands: a spool that is open, or a joint that moves, in every mode and at every speed.

A spool counts as open beyond its dead-band, where oil begins to flow, on a side that was not commanded for as long as
it takes to close.  A joint whose command has been neutral for `REST_NS` may not leave its place by more than
`MOVED_UNITS`: about 40 times an encoder's noise (3.5e-4 to 5e-4 rad), and more than the oil's springiness under a
swinging load.  The place follows the joint by `CREEP_SHARE` of its speed limit, since cylinders leak.
"""

from __future__ import annotations

from typing import Final

from controller.guard.joints import MeasuredJoint
from controller.guard.layout import Field
from controller.guard.verdicts import FINE, ROTATOR_AXIS, Finding, Verdict

REST_NS: Final = 500_000_000
MOVED_UNITS: Final = 0.02
"""[rad, m]"""
ROTATOR_MOVED_RAD: Final = 0.2
"""Tongs that close about logs turn the rotator against its shut valve: 0.02 rad tripped in an ordinary grasp."""
CREEP_SHARE: Final = 0.05
MOVED_STEPS: Final = 3
"""Steps of the guard in a row for which a joint must be away: one sample that jumps is an encoder's fault."""


class MotionWatch:
    """One function: its spool's feedback ``field``, and its joint if an encoder measures it."""

    __slots__ = (
        "_away", "_closing_ns", "_creep_s", "_field", "_joint", "_moved", "_opened_ns", "_place", "_shut_pct", "number",
    )  # fmt: skip

    def __init__(
        self, number: int, field: Field, shut_pct: float, closing_ns: int, joint: MeasuredJoint | None = None
    ) -> None:
        self.number = number
        self._field, self._shut_pct, self._closing_ns, self._joint = field, shut_pct, closing_ns, joint
        self._creep_s = CREEP_SHARE * joint.axis.speed_limit if joint is not None else 0.0
        self._moved = ROTATOR_MOVED_RAD if number == ROTATOR_AXIS else MOVED_UNITS
        self._opened_ns = [0, 0]  # when it was last commanded to the minus and to the plus side
        self._place: float | None = None  # not known yet
        self._away = 0

    def share(self) -> float:
        """How far the joint has moved without a command, over what is too far."""
        joint, place = self._joint, self._place
        return 0.0 if joint is None or place is None else abs(joint.position - place) / self._moved

    def check(self, command: float, feedback_word: int | None, now_ns: int, elapsed_s: float) -> Finding:
        """One step; ``command`` is what the valve node may follow now, ``feedback_word`` None when it is not known."""
        opened_ns = self._opened_ns
        if command != 0.0:
            opened_ns[command > 0.0] = now_ns
        if feedback_word is not None:
            raw = self._field.raw(feedback_word)
            spool_pct = raw * self._field.scale
            uncommanded = now_ns - opened_ns[spool_pct > 0.0] > self._closing_ns
            if uncommanded and abs(spool_pct) > self._shut_pct and self._field.inside(raw):
                return Verdict.SPOOL, self.number
        joint = self._joint
        if joint is None:
            return FINE
        if self._place is None or now_ns - max(opened_ns) <= REST_NS or joint.silent(now_ns):
            self._place, self._away = None if joint.silent(now_ns) else joint.position, 0
            return FINE
        creep = self._creep_s * elapsed_s
        self._place += min(max(joint.position - self._place, -creep), creep)
        self._away = self._away + 1 if abs(joint.position - self._place) > self._moved else 0
        if self._away < MOVED_STEPS:
            return FINE
        self._place, self._away = joint.position, 0  # found; where it stands now is its place, so that a reset can work
        return Verdict.MOVING, self.number
