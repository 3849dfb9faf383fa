"""The guard's checks: pure ``step(now_ns, frames) -> frames``, no allocation that lasts.

It watches the valve commands, whoever sends them, and everything that they depend on, by its own rules and its own
decoding.  GuardStat goes out every 10 ms, and at once when the verdict changes; ``Enable`` is 0xA only while no rule is
broken.  It returns when the rules hold and the commands have been neutral for 200 ms.  A broken rule of `LATCHING`
needs a person before that: the reset button of the safety module, pressed after the cause is gone, and nothing else.
Neutral commands are always allowed.  The guard never commands: silent or dead, it stops the machine by absence.
"""

from __future__ import annotations

from enum import IntEnum
from typing import Final

from can_dbc.frame import Frame
from controller.guard.envelope import Axis
from controller.guard.layout import Field, GuardConfigError, Layout

GUARD_NODE: Final = 0x7D
HEARTBEAT_KEY: Final = 0x700 + GUARD_NODE
ENABLE, ARM_KEY = 0xA, 0xA
STATUS_NS: Final = 10_000_000
HEARTBEAT_NS: Final = 100_000_000
CALM_NS: Final = 200_000_000
ENCODER_TIMEOUT_NS: Final = 90_000_000
"""The controller stops on a lost encoder within 100 ms; the guard enforces it."""
RANGE_MARGIN_UNITS: Final = 0.08
"""How far outside its range [rad, m] a joint may still be driven outward."""
RATE_CREDIT_S: Final = 0.04
RATE_SLACK_PCT: Final = 3.0
NO_AXIS: Final = 15
GRAPPLE_AXIS, AUX_AXIS = 5, 6
_NEUTRAL, _SPOOL = 0, 2
_GRAPPLE_OPENS, _GRAPPLE_CLOSES = 1, 2
_RELEASED, _PRESSED = 1, 1
_MIN_GOOD_COUNT, _MAX_COUNTER_STEP = 2, 2
_SHORT_WINDOW, _MAX_BAD_IN_SHORT = (1 << 5) - 1, 1
_LONG_WINDOW, _MAX_BAD_IN_LONG = (1 << 100) - 1, 2
"""Frames with a wrong checksum that are tolerated among the last 5 and among the last 100."""
MAX_DELAY_NS: Final = 40_000_000
"""A command is refused when it comes this much later than its counter and the period say."""
DELAY_FORGIVEN_PER_S: Final = 0.02
"""How fast a lasting delay is forgiven: clocks differ, and a controller may skip a tick."""
MESSAGES: Final = ("ValveCmdA", "ValveCmdB", "EstopStat", "GuardStat")


class Verdict(IntEnum):
    """The broken rule; the number of ``GuardStat.Verdict``."""

    GOOD = 0
    NO_COMMAND = 1  # a valve command is missing or too old
    CORRUPT = 2  # too many commands with a wrong checksum or length
    OTHER_GUARD = 3  # another node sends the guard's frames
    RANGE = 4  # a command out of its range, of an unknown mode, or for a function that does not exist
    RATE = 5  # a command that grows faster than the machine may
    NOT_ARMED = 6  # a motion is commanded without the arm key
    ESTOP = 7  # the emergency stop is pressed, or its channels differ
    ENCODER = 8  # a motion is commanded for a joint whose encoder is silent
    OUTSIDE = 9  # a motion further out is commanded for a joint outside its range
    CALMING = 10  # no rule is broken, but not for long enough
    STALE = 11  # commands come late, or some are missing in between
    ESTOP_LOST = 12  # the emergency stop is not received
    LATCHED = 13  # no rule is broken, but nobody has pressed reset since one of `LATCHING` was


LATCHING: Final = frozenset(
    (Verdict.CORRUPT, Verdict.OTHER_GUARD, Verdict.RANGE, Verdict.RATE, Verdict.NOT_ARMED, Verdict.ESTOP)
) | {Verdict.OUTSIDE}
"""Rules whose violation is something heard, not silence: only a person allows motion again."""


def _crc_table() -> bytes:
    table = bytearray(256)
    for i in range(256):
        crc = i
        for _ in range(8):
            crc = (crc << 1 & 0xFF) ^ (0x2F if crc & 0x80 else 0)
        table[i] = crc
    return bytes(table)


_CRC: Final = _crc_table()


def checksum(data: bytes, data_id: int) -> int:
    """CRC-8H2F of a frame from byte 1 on and its Data ID (AUTOSAR E2E Profile 2)."""
    crc = 0xFF
    for i in range(1, len(data)):
        crc = _CRC[crc ^ data[i]]
    return _CRC[crc ^ data_id] ^ 0xFF


class FrameEffect(IntEnum):
    """Effect of a received frame on its stream; the greater ones break trust."""

    NONE = 0
    NEW_WORD = 1
    GAP = 2
    CORRUPT = 3


class WatchedMessage:
    """One protected message: its newest good word, its time, and whether its stream is trusted."""

    __slots__ = ("_bad", "_good", "counter", "layout", "stamp_ns", "steps", "trusted", "word")

    def __init__(self, layout: Layout) -> None:
        if not layout.data_ids or not layout.timeout_ns:
            raise GuardConfigError("guard.message-unprotected", "crane.dbc: a message lacks Data IDs or a time-out.")
        self.layout = layout
        self.word = self.stamp_ns = self.steps = 0
        self.counter = -1
        self.trusted = False
        self._good = self._bad = 0  # good frames in a row; bad ones among the last hundred, as bits

    def receive(self, frame: Frame, now_ns: int) -> FrameEffect:
        """Check a frame, and keep its word when the stream is trusted."""
        data, layout = frame.data, self.layout
        self.old(frame.stamp_ns)  # after a silence the stream begins anew: that is no corruption
        if len(data) != layout.length or checksum(data, layout.data_ids[data[1] & 0xF]) != data[0]:
            bad = self._bad = (self._bad << 1 | 1) & _LONG_WINDOW
            self._good = 0
            if (bad & _SHORT_WINDOW).bit_count() <= _MAX_BAD_IN_SHORT and bad.bit_count() <= _MAX_BAD_IN_LONG:
                return FrameEffect.NONE
            self.trusted = False
            return FrameEffect.CORRUPT
        counter = data[1] & 0xF
        self.steps = (counter - self.counter) & 0xF if self.counter >= 0 else 1
        self.counter = counter
        if self.steps == 0:  # a repeated frame only grows older
            return FrameEffect.NONE
        self._bad = self._bad << 1 & _LONG_WINDOW
        broken = self.steps > _MAX_COUNTER_STEP and self.trusted
        self._good = 1 if self.steps > _MAX_COUNTER_STEP else self._good + 1
        self.trusted = not broken and (self.trusted or self._good >= _MIN_GOOD_COUNT)
        if not self.trusted:
            return FrameEffect.GAP if broken else FrameEffect.NONE
        self.word = int.from_bytes(data, "little")
        self.stamp_ns = min(frame.stamp_ns, now_ns)
        return FrameEffect.NEW_WORD

    def old(self, now_ns: int) -> bool:
        """Whether no trusted frame came within the time-out; then the stream must qualify again."""
        if self.trusted and now_ns - self.stamp_ns <= self.layout.timeout_ns:
            return False
        if self.trusted:
            self.trusted, self._good, self.counter = False, 0, -1
        return True

    def raw(self, name: str) -> int:
        """Raw value of a signal in the newest good frame."""
        return self.layout.fields[name].raw(self.word)


class Punctuality:
    """How late commands come, from their number: one for each period, and the most punctual one sets the scale.

    A transmit queue that a busy bus holds up delivers commands in order, complete, with good checksums, and old.
    """

    __slots__ = ("_due_ns", "_last_ns", "_period_ns")

    def __init__(self, period_ns: int) -> None:
        self._period_ns = period_ns
        self._due_ns = self._last_ns = 0

    def late(self, stamp_ns: int, steps: int, silence_ns: int) -> bool:
        """Whether a command is too late that came at ``stamp_ns``, ``steps`` after the one before."""
        gap_ns = stamp_ns - self._last_ns
        self._last_ns = stamp_ns
        due_ns = self._due_ns + steps * self._period_ns + int(gap_ns * DELAY_FORGIVEN_PER_S)
        self._due_ns = stamp_ns if gap_ns > silence_ns else min(due_ns, stamp_ns)
        return stamp_ns - self._due_ns > MAX_DELAY_NS


class CommandedAxis:
    """One commanded axis: its field, the last opening past the dead-band, and its rate credit."""

    __slots__ = ("_credit", "_deadband", "_field", "_last", "_max_credit", "_rate", "axis", "percent")

    def __init__(self, axis: Axis, field: Field) -> None:
        self.axis = axis
        self._field = field
        self._deadband = axis.deadband_pct
        self._rate = axis.rate_pct_s
        self._max_credit = self._credit = axis.rate_pct_s * RATE_CREDIT_S + RATE_SLACK_PCT
        self._last = 0.0
        self.percent = 0.0

    def receive(self, word: int, elapsed_s: float) -> Verdict:
        """Check the value in a new command frame that came ``elapsed_s`` after the last one."""
        raw = self._field.raw(word)
        if not self._field.inside(raw):
            return Verdict.RANGE
        self.percent = raw * self._field.scale
        size = max(0.0, abs(self.percent) - self._deadband) * 100.0 / (100.0 - self._deadband)
        opening = size if self.percent > 0.0 else -size
        # Closing costs nothing; growth on the side of the command uses credit.
        growth = size if opening * self._last <= 0.0 else max(0.0, size - abs(self._last))
        self._last = opening
        self._credit = min(self._max_credit, self._credit + self._rate * elapsed_s) - growth
        if self._credit < 0.0:
            self._credit = 0.0
            return Verdict.RATE
        return Verdict.GOOD


class MeasuredJoint:
    """The measured position of one joint."""

    __slots__ = ("_alive", "_at", "axis", "layout", "position", "stamp_ns")

    def __init__(self, axis: Axis, layout: Layout) -> None:
        self.axis, self.layout = axis, layout
        self.position = 0.0
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
        self.stamp_ns = min(frame.stamp_ns, now_ns)


class Guard:
    """All state of the guard; `step` is its whole behaviour."""

    __slots__ = (
        "_a", "_b", "_calm_ns", "_changed", "_commands", "_commands_a", "_commands_b", "_counter", "_estop",
        "_grapple_field", "_heartbeat_ns", "_joints", "_latched", "_layout", "_punctuality", "_reset_seen",
        "_status_ns", "_watches", "axis", "events", "verdict",
    )  # fmt: skip

    def __init__(self, axes: tuple[Axis, ...], layouts: dict[str, Layout], period_ns: int) -> None:
        self._a, self._b, self._estop = (WatchedMessage(layouts[name]) for name in MESSAGES[:3])
        self._layout = layouts["GuardStat"]
        self._watches = {watch.layout.key: watch for watch in (self._a, self._b, self._estop)}
        sensed = [MeasuredJoint(axis, layouts[axis.message]) for axis in axes if axis.message]
        self._joints = {joint.layout.key: joint for joint in sensed}
        fields_a, fields_b = layouts["ValveCmdA"].fields, layouts["ValveCmdB"].fields
        missing = [axis.signal for axis in axes if axis.signal not in fields_a and axis.signal not in fields_b]
        if missing:
            raise GuardConfigError("guard.no-command-signal", f"crane.dbc: no valve command is called {missing[0]}.")
        self._commands = [CommandedAxis(axis, (fields_a | fields_b)[axis.signal]) for axis in axes]
        self._commands_a = [c for c in self._commands if c.axis.signal in fields_a]
        self._commands_b = [c for c in self._commands if c.axis.signal in fields_b]
        self._grapple_field = fields_b["Grapple"]
        self.verdict, self.axis = Verdict.NO_COMMAND, NO_AXIS
        self.events = 0
        self._changed = True
        self._counter = 0
        self._calm_ns = self._status_ns = self._heartbeat_ns = 0
        self._latched, self._reset_seen = False, True  # a button that is down already is no edge
        self._punctuality = {watch: Punctuality(period_ns) for watch in (self._a, self._b)}

    def step(self, now_ns: int, frames: list[Frame]) -> list[tuple[int, bytes]]:
        """Check the frames since the last call (any period up to 10 ms); returns the frames to send."""
        verdict, axis = Verdict.GOOD, NO_AXIS
        pressed = False
        for frame in frames:
            found, where = self._receive(frame, now_ns)
            if verdict is Verdict.GOOD or (found in LATCHING and verdict not in LATCHING):
                verdict, axis = found, where
            pressed = self._reset_pressed() or pressed
        if verdict is Verdict.GOOD:
            verdict, axis = self._check_state(now_ns)
        self._settle(verdict, axis, pressed, now_ns)
        out: list[tuple[int, bytes]] = []
        if self._changed or now_ns >= self._status_ns:
            late = now_ns - self._status_ns >= STATUS_NS
            self._status_ns = now_ns + STATUS_NS if late or self._changed else self._status_ns + STATUS_NS
            self._changed = False
            out.append((self._layout.key, self._status()))
        if now_ns >= self._heartbeat_ns:
            out.append((HEARTBEAT_KEY, b"\x05" if self._heartbeat_ns else b"\x00"))
            self._heartbeat_ns = now_ns + HEARTBEAT_NS
        return out

    @property
    def keys(self) -> tuple[int, ...]:
        """Keys of the frames to receive: the watched ones, and the guard's own, which no other node may send."""
        return (*self._watches, *self._joints, self._layout.key, HEARTBEAT_KEY)

    @property
    def enabled(self) -> bool:
        """Whether the machine may move."""
        return self.verdict is Verdict.GOOD

    def _receive(self, frame: Frame, now_ns: int) -> tuple[Verdict, int]:
        watch = self._watches.get(frame.key)
        if watch is None:
            joint = self._joints.get(frame.key)
            if joint is not None:
                joint.receive(frame, now_ns)
            elif frame.key in (self._layout.key, HEARTBEAT_KEY):
                return Verdict.OTHER_GUARD, NO_AXIS
            return Verdict.GOOD, NO_AXIS
        before_ns = watch.stamp_ns
        effect = watch.receive(frame, now_ns)
        if effect is FrameEffect.GAP:
            return (Verdict.ESTOP_LOST if watch is self._estop else Verdict.STALE), NO_AXIS
        if effect is FrameEffect.CORRUPT:
            return (Verdict.ESTOP_LOST if watch is self._estop else Verdict.CORRUPT), NO_AXIS
        if watch is self._estop or effect is FrameEffect.NONE:
            return Verdict.GOOD, NO_AXIS
        late = self._punctuality[watch].late(watch.stamp_ns, watch.steps, watch.layout.timeout_ns)
        elapsed_s = (watch.stamp_ns - before_ns) * 1e-9
        for command in self._commands_a if watch is self._a else self._commands_b:
            verdict = command.receive(watch.word, elapsed_s)
            if verdict is not Verdict.GOOD:
                return verdict, command.axis.number
        return (Verdict.STALE if late else Verdict.GOOD), NO_AXIS

    def _reset_pressed(self) -> bool:
        """Whether the reset button went down, as the safety module itself reports it."""
        before = self._reset_seen
        self._reset_seen = not self._estop.trusted or self._estop.raw("ResetReq") == _PRESSED
        return self._reset_seen and not before and self._estop.trusted

    def _check_state(self, now_ns: int) -> tuple[Verdict, int]:
        """Check the rules on the present state; only a command that moves something can break those on joints."""
        estop_old = self._estop.old(now_ns)
        a_old, b_old = self._a.old(now_ns), self._b.old(now_ns)
        if estop_old:
            self._reset_seen = True
            return Verdict.ESTOP_LOST, NO_AXIS
        if self._estop.raw("ChannelA") != _RELEASED or self._estop.raw("ChannelB") != _RELEASED:
            return Verdict.ESTOP, NO_AXIS
        if a_old or b_old:
            return Verdict.NO_COMMAND, NO_AXIS
        if self._a.raw("Mode") not in (_NEUTRAL, _SPOOL):
            return Verdict.RANGE, NO_AXIS
        if self._b.raw("Aux") != 0:
            return Verdict.RANGE, AUX_AXIS
        if not self._grapple_field.inside(self._b.raw("Grapple")):
            return Verdict.RANGE, GRAPPLE_AXIS
        if self._neutral():
            return Verdict.GOOD, NO_AXIS
        if self._b.raw("ArmKey") != ARM_KEY:
            return Verdict.NOT_ARMED, NO_AXIS
        return self._check_joints(now_ns)

    def _check_joints(self, now_ns: int) -> tuple[Verdict, int]:
        for joint in self._joints.values():
            number = joint.axis.number
            if now_ns - joint.stamp_ns > ENCODER_TIMEOUT_NS:
                return Verdict.ENCODER, number
            outward = self._commands[number].percent * joint.axis.sign
            above = joint.position > joint.axis.upper + RANGE_MARGIN_UNITS and outward > 0.0
            below = joint.position < joint.axis.lower - RANGE_MARGIN_UNITS and outward < 0.0
            if above or below:
                return Verdict.OUTSIDE, number
        return Verdict.GOOD, NO_AXIS

    def _neutral(self) -> bool:
        if self._b.raw("GrappleMode") in (_GRAPPLE_OPENS, _GRAPPLE_CLOSES):  # these move at full flow by themselves
            return False
        return self._b.raw("Grapple") == 0 and all(command.percent == 0.0 for command in self._commands)

    def _settle(self, verdict: Verdict, axis: int, pressed: bool, now_ns: int) -> None:
        """A broken rule counts at once; the return needs a while of neutral commands, and a person if it latches."""
        if verdict is not Verdict.GOOD:
            self._calm_ns = now_ns + CALM_NS
            self._latched = self._latched or verdict in LATCHING
        elif self.verdict is not Verdict.GOOD:
            neutral = self._neutral()
            if not neutral:
                self._calm_ns = now_ns + CALM_NS
            if self._latched:
                self._latched = not (pressed and neutral)
            if self._latched or now_ns < self._calm_ns:
                verdict = Verdict.LATCHED if self._latched else Verdict.CALMING
        if verdict is not self.verdict:
            self.events = (self.events + 1) & 0xFF
            self._changed = True
        self.verdict, self.axis = verdict, axis

    def _status(self) -> bytes:
        fields = self._layout.fields
        counter, self._counter = self._counter, (self._counter + 1) & 0xF
        word = fields["Counter"].put(counter) | fields["Verdict"].put(self.verdict)
        word |= fields["Enable"].put(ENABLE if self.enabled else 0)
        word |= fields["FaultAxis"].put(self.axis) | fields["SeenCounter"].put(max(self._a.counter, 0))
        word |= fields["EventCount"].put(self.events)
        data = word.to_bytes(self._layout.length, "little")
        return bytes((checksum(data, self._layout.data_ids[counter]),)) + data[1:]
