"""The crane's functions as the guard sees them: what is commanded, where the joint is, and what moves uncommanded."""

from __future__ import annotations

from typing import Final

from can_dbc.frame import Frame
from controller.guard.envelope import Axis
from controller.guard.layout import Field, Layout
from controller.guard.verdicts import FINE, ROTATOR_AXIS, Finding, Verdict

ENCODER_TIMEOUT_NS: Final = 90_000_000
"""The controller stops on a lost encoder within 100 ms; the guard enforces it."""
SPEED_FACTOR: Final = 1.1
"""A joint may swing and ring, and lasts nowhere above this share of its speed limit, ..."""
SPEED_SLACK_S: Final = 0.02
"""... by more than the way of this time at its limit: 5 times what ordinary work needs (docs/how-to/guard.md)."""
ROTATOR_MOVED_RAD: Final = 0.2
"""Logs turn the rotator against its shut valve: 0.02 rad tripped in an ordinary grasp, and one that caught at a stake
turned it back by 1.4 rad/s when it came free, 0.06 rad more than its speed limit allows."""
ASKED_SHARE: Final = 0.5
"""A rotator that its valve is asked to turn by less than this share of its speed limit is turned by a log."""
FAST_FRAMES: Final = 3
"""Frames in a row: one sample that jumps is an encoder's fault."""
RATE_CREDIT_S: Final = 0.04
RATE_SLACK_PCT: Final = 3.0


class RateCredit:
    """Limits how fast the size of a command grows [%, %/s]; closing costs nothing."""

    __slots__ = ("_credit", "_last", "_most", "_rate")

    def __init__(self, rate_pct_s: float) -> None:
        self._rate = rate_pct_s
        self._most = self._credit = rate_pct_s * RATE_CREDIT_S + RATE_SLACK_PCT
        self._last = 0.0

    def spent(self, percent: float, elapsed_s: float) -> bool:
        """Tell whether a command that came ``elapsed_s`` after the last one has grown faster than allowed."""
        size, last = abs(percent), self._last
        growth = size if percent * last <= 0.0 else max(0.0, size - abs(last))
        self._last = percent
        credit = min(self._most, self._credit + self._rate * elapsed_s) - growth
        self._credit = max(0.0, credit)
        return credit < 0.0


class CommandedAxis:
    """One commanded axis: ``percent`` of the spool, and ``opening``, the part of it past the dead-band."""

    __slots__ = ("_credit", "_deadbands", "_field", "axis", "opening", "percent")

    def __init__(self, axis: Axis, field: Field) -> None:
        self.axis = axis
        self._field = field
        self._deadbands = axis.deadbands_pct
        self._credit = RateCredit(axis.rate_pct_s)
        self.percent = self.opening = 0.0

    def receive(self, word: int, elapsed_s: float) -> Verdict:
        """Check the value in a new command frame that came ``elapsed_s`` after the last one."""
        raw = self._field.raw(word)
        if not self._field.inside(raw):
            return Verdict.RANGE
        self.percent = raw * self._field.scale
        size = max(0.0, abs(self.percent) - (shut := self._deadbands[self.percent > 0.0])) * 100.0 / (100.0 - shut)
        self.opening = size if self.percent > 0.0 else -size
        return Verdict.RATE if self._credit.spent(self.opening, elapsed_s) else Verdict.GOOD

    @property
    def speed(self) -> float:
        """The speed that the command asks of the joint [rad/s, m/s]."""
        return self.opening * 0.01 * self.axis.full_speeds[self.opening > 0.0] * self.axis.sign


class MeasuredJoint:
    """The measured position of one joint, and a place that follows it no faster than the joint may move."""

    __slots__ = ("_alive", "_at", "_fast", "_place", "_slack", "_speed", "axis", "layout", "position", "stamp_ns")

    def __init__(self, axis: Axis, layout: Layout) -> None:
        self.axis, self.layout = axis, layout
        self.position = self._place = 0.0
        self._speed, self._slack, self._fast = SPEED_FACTOR * axis.speed_limit, SPEED_SLACK_S * axis.speed_limit, 0
        self.stamp_ns = -ENCODER_TIMEOUT_NS
        self._at = layout.fields.get("TimeStamp")
        self._alive = -1

    def receive(self, frame: Frame, now_ns: int) -> None:
        """Use an encoder frame; one of a rotary encoder counts only when its time stamp has changed."""
        if len(frame.data) != self.layout.length:
            return
        word = int.from_bytes(frame.data, "little")
        if self._at is not None:
            before, self._alive = self._alive, self._at.raw(word)
            if before == self._alive:
                return
        axis = self.axis
        offset = self.layout.fields["Position"].raw(word) - axis.zero_counts
        if axis.total_counts:
            offset = (offset + axis.total_counts // 2) % axis.total_counts - axis.total_counts // 2
        self.position = offset * axis.unit
        before_ns, self.stamp_ns = self.stamp_ns, min(frame.stamp_ns, now_ns)
        if self.stamp_ns - before_ns >= ENCODER_TIMEOUT_NS:
            self._place = self.position
        travel = self._speed * (self.stamp_ns - before_ns) * 1e-9
        self._place += min(max(self.position - self._place, -travel), travel)
        self._fast = self._fast + 1 if abs(self.position - self._place) > self._slack else 0

    def expect(self, speed: float) -> None:
        """Set the speed asked of the valve [rad/s, m/s]; a rotator that goes on without it follows a log."""
        follows = self.axis.number == ROTATOR_AXIS and abs(speed) <= ASKED_SHARE * self.axis.speed_limit
        self._slack = ROTATOR_MOVED_RAD if follows else SPEED_SLACK_S * self.axis.speed_limit

    def share(self) -> float:
        """Tell how far it was too fast, over what is too far."""
        return abs(self.position - self._place) / self._slack

    def too_fast(self) -> bool:
        """Tell whether it has moved faster than it may; told once, and its place is then where it is."""
        if self._fast < FAST_FRAMES:
            return False
        self._place, self._fast = self.position, 0
        return True

    def silent(self, now_ns: int) -> bool:
        """Tell whether its encoder has been silent for too long to move the joint."""
        return now_ns - self.stamp_ns > ENCODER_TIMEOUT_NS


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
    """One function: its spool's feedback ``field``, and its joint if an encoder measures it.

    Watched in every mode and at every speed.  A spool counts as open beyond its dead-band, where oil begins to flow, on
    a side that was not commanded for as long as it takes to close.  A joint whose command has been neutral for
    `REST_NS` may not leave its place by more than `MOVED_UNITS`: about 40 times an encoder's noise (3.5e-4 to 5e-4
    rad), and more than the oil's springiness under a swinging load.  The place follows the joint by `CREEP_SHARE` of
    its speed limit, since cylinders leak.
    """

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
        """Tell how far the joint has moved without a command, over what is too far."""
        joint, place = self._joint, self._place
        return 0.0 if joint is None or place is None else abs(joint.position - place) / self._far

    def check(self, command: float, word: int | None, now_ns: int, elapsed_s: float, pressed: bool = False) -> Finding:
        """Check one step; ``command``: what the valve node may follow now; ``word``: its feedback, or None.
        ``pressed``: the jaws work or hold, or did a moment ago; where the joint is at the end of that is its place.
        """
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
