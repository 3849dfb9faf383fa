"""Motion that nobody commands: a spool that is open, or a joint that moves, in every mode and at every speed.

A spool counts as open beyond its dead-band, where oil begins to flow, on a side that was not commanded for as long as
it takes to close.  A joint whose command has been neutral for `REST_NS` may not leave its place by more than
`MOVED_UNITS`: about 40 times an encoder's noise (3.5e-4 to 5e-4 rad), and more than the oil's springiness under a
swinging load.  The place follows the joint by `CREEP_SHARE` of its speed limit, since cylinders leak.
"""

from __future__ import annotations

from typing import Final

from controller.guard.joints import ROTATOR_MOVED_RAD, MeasuredJoint
from controller.guard.layout import Field
from controller.guard.verdicts import FINE, ROTATOR_AXIS, Finding, Verdict

REST_NS: Final = 500_000_000
MOVED_UNITS: Final = 0.02
"""[rad, m]"""
PRESSED_FACTOR: Final = 2.0
"""Jaws that work or hold press logs against other logs, ground and stakes, and move the joints on their oil by more: a
slew by 18 mrad in a mission, a rotator by 0.22 rad."""
CREEP_SHARE: Final = 0.05
MOVED_STEPS: Final = 3
"""Steps of the guard in a row for which a joint must be away: one sample that jumps is an encoder's fault."""


class MotionWatch:
    """One function: its spool's feedback ``field``, and its joint if an encoder measures it."""

    __slots__ = (
        "_away", "_closing_ns", "_far", "_field", "_joint", "_moved", "_opened_ns", "_place", "_shut_pct", "number",
    )  # fmt: skip

    def __init__(
        self, number: int, field: Field, shut_pct: float, closing_ns: int, joint: MeasuredJoint | None = None
    ) -> None:
        self.number = number
        self._field, self._shut_pct, self._closing_ns, self._joint = field, shut_pct, closing_ns, joint
        self._moved = self._far = ROTATOR_MOVED_RAD if number == ROTATOR_AXIS else MOVED_UNITS
        self._opened_ns = [0, 0]  # when it was last commanded to the minus and to the plus side
        self._place: float | None = None  # not known yet
        self._away = 0

    def share(self) -> float:
        """How far the joint has moved without a command, over what is too far."""
        joint, place = self._joint, self._place
        return 0.0 if joint is None or place is None else abs(joint.position - place) / self._far

    def check(self, command: float, word: int | None, now_ns: int, elapsed_s: float, pressed: bool = False) -> Finding:
        """One step; ``command``: what the valve node may follow now; ``word``: its feedback, or None.
        ``pressed``: the jaws work or hold, or did a moment ago; where the joint is at the end of that is its place."""
        opened_ns = self._opened_ns
        if command != 0.0:
            opened_ns[command > 0.0] = now_ns
        if word is not None:
            raw = self._field.raw(word)
            spool_pct = raw * self._field.scale
            uncommanded = now_ns - opened_ns[spool_pct > 0.0] > self._closing_ns
            if uncommanded and abs(spool_pct) > self._shut_pct and self._field.inside(raw):
                return Verdict.SPOOL, self.number
        joint = self._joint
        if joint is None:
            return FINE
        released = self._far > self._moved and not pressed
        self._far = self._moved * PRESSED_FACTOR if pressed else self._moved
        if self._place is None or now_ns - max(opened_ns) <= REST_NS or released or joint.silent(now_ns):
            self._place, self._away = None if joint.silent(now_ns) else joint.position, 0
            return FINE
        creep = CREEP_SHARE * joint.axis.speed_limit * elapsed_s
        self._place += min(max(joint.position - self._place, -creep), creep)
        self._away = self._away + 1 if abs(joint.position - self._place) > self._far else 0
        if self._away < MOVED_STEPS:
            return FINE
        self._place, self._away = joint.position, 0  # found; where it stands now is its place, so that a reset can work
        return Verdict.MOVING, self.number
