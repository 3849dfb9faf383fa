"""One bus of the machine: the messages received from it, the messages sent on it, and whether it can be trusted.

`MessageState` keeps the newest good frame of a received message, `ProtectedMessage` makes the frames of one that is
sent, at the period of a `PeriodicTimer`, and `BusMonitor` judges what the bus itself reports.
"""

from __future__ import annotations

import math
from typing import Any, Final

from can_dbc.bus.base import BusState
from can_dbc.dbc.codec import FrameRefused, MessageCodec
from can_dbc.frame import Frame, RawFrame
from can_dbc.messages.tick_record import BusReading
from can_dbc.protocols.e2e import Checker, Sender
from machine.status.faults import FAULTS
from machine.status.modes import Mode
from machine.status.reasons import Reaction, Reason
from runtime.errors import ConfigError

NEUTRAL_WITHIN_NS: Final = 100_000_000
"""Within this time after a needed input is lost every function is at neutral (docs/reference/safety.md section 2)."""
_MAX_TIMEOUT_NS: Final = NEUTRAL_WITHIN_NS - 10_000_000


class Signal:
    """One signal of a message, found once: a name costs a tick more than its value."""

    __slots__ = ("_index", "_state")

    def __init__(self, state: MessageState, name: str) -> None:
        """Find the signal in its message; raises KeyError if the message has no such signal."""
        self._state, self._index = state, state.codec.index[name]

    def value(self) -> Any:
        """Return the value now; None when the message is unknown or stale, or the signal not available."""
        values = self._state.values
        return None if values is None else values[self._index]


class MessageState:
    """The newest good frame of one message: its values with their age.

    Every value starts as unknown: ``values`` is None before the first good frame.  A frame is refused whole when its
    length, checksum, counter or a value is wrong; the old values then only grow older until they are stale by the DBC's
    time-out (None again), and the message must qualify again (two good frames).  A rotary encoder, which has no
    counter, is alive while its time stamp changes.
    """

    __slots__ = (
        "_alive",
        "_checker",
        "_index",
        "_last_alive",
        "_receive",
        "bit",
        "codec",
        "fresh",
        "machine",
        "refused",
        "repeats",
        "stamp_ns",
        "timeout_ns",
        "values",
    )

    def __init__(
        self, codec: MessageCodec, bit: int, *, watched: bool = True, machine: bool = False, timeout_ns: int = 0
    ) -> None:
        """``bit`` is its place in the mask of stale inputs; the time-out of a ``watched`` message is bounded by
        `NEUTRAL_WITHIN_NS`; ``machine``: it comes on mach0, not on crane0; ``timeout_ns``: instead of the DBC's, for a
        source with another period.

        Raises:
            ConfigError: the DBC gives no time-out for it.
        """
        if not codec.timeout_ns:
            raise ConfigError(
                "config.no-timeout", f"The DBC gives no TimeoutMs for {codec.name}; add the attribute to the DBC."
            )
        self.codec = codec
        self.machine = machine
        self._receive = codec.receive
        self._index = dict(codec.index)
        self._checker = Checker(codec.data_ids) if codec.data_ids else None
        self._alive = codec.index.get("TimeStamp", -1)
        self.bit = bit
        timeout_ns = timeout_ns or codec.timeout_ns
        self.timeout_ns = min(timeout_ns, _MAX_TIMEOUT_NS) if watched else timeout_ns
        self._last_alive: Any = None
        self.stamp_ns = 0
        self.refused = 0
        self.repeats = False
        """The newest frame carried the time stamp of the one before: the device answers, but measures no more."""
        self.forget()

    def forget(self) -> None:
        """Make the values unknown again; the next frames must qualify the message."""
        self.values: tuple[Any, ...] | None = None
        self.fresh = False
        """A good frame came in this tick."""
        if self._checker is not None:
            self._checker.reset()

    def get(self, signal: str) -> Any:
        """Return a signal's value; None when the message is unknown or stale, or the signal not available."""
        return None if self.values is None else self.values[self._index[signal]]

    def receive(self, frame: Frame, now_ns: int) -> None:
        """Check a frame and keep its values when they are good."""
        stamp_ns, _, data = frame
        checker = self._checker
        if checker is not None and not checker.accepts(data):
            self.refused += 1
            if not checker.trusted:
                self.values = None
            return
        try:
            values = self._receive(data)
        except FrameRefused:
            self.refused += 1
            return
        if self._alive >= 0:
            last, self._last_alive = self._last_alive, values[self._alive]
            self.repeats = last == self._last_alive
            if self.repeats:
                self.refused += 1
                return
        self.values = values
        self.stamp_ns = stamp_ns if stamp_ns < now_ns else now_ns
        self.fresh = True


def or_nan(value: float | None) -> float:
    """Return a received value, NaN when there is none."""
    return math.nan if value is None else value


def age_out(states: tuple[MessageState, ...], now_ns: int) -> int:
    """Forget values past their time-out; returns the mask of the messages without values."""
    mask = 0
    for state in states:
        if state.values is None:
            mask |= 1 << state.bit
        elif now_ns - state.stamp_ns > state.timeout_ns:
            state.forget()
            mask |= 1 << state.bit
    return mask


ARM_KEY: Final = 0xA
_STOP: Final = Mode.STOP
_FAULT: Final = Mode.FAULT
_RUN: Final = 0
_DEGRADED: Final = 1
_CONTROLLED_STOP: Final = 2
_SAFE_STOP: Final = 3


class PeriodicTimer:
    """A period at the nominal time of the ticks, without drift.

    It is due at the first call and then every ``period_ns``; ``offset_ns`` shifts it once after the first call, so that
    messages of the same period do not all fall into one tick.
    """

    __slots__ = ("_next_ns", "_offset_ns", "_period_ns")

    def __init__(self, period_ns: int, offset_ns: int = 0) -> None:
        self._period_ns = period_ns
        self._offset_ns = offset_ns
        self._next_ns = 0

    def due(self, now_ns: int) -> bool:
        """Return True at the first call and once per period."""
        if now_ns < self._next_ns:
            return False
        if self._next_ns:
            self._next_ns = max(self._next_ns + self._period_ns, now_ns + self._period_ns // 2)
        else:
            self._next_ns = now_ns + self._period_ns + self._offset_ns
        return True


class ProtectedMessage:
    """An E2E-protected message with its value list, reused for every frame."""

    __slots__ = ("_encode", "_sender", "key", "values")

    def __init__(self, codec: MessageCodec) -> None:
        self.key = codec.key
        self.values: list[float | None] = [0.0] * len(codec.signals)
        self._encode = codec.encode
        self._sender = Sender(codec.data_ids or bytes(16))

    def frame(self) -> RawFrame:
        """Encode the next frame from ``values``."""
        return self.key, self._sender.protect(self._encode(*self.values))

    def frame_with(self, *values: float | None) -> RawFrame:
        """Encode the next frame from all values that follow the E2E header; None is not available."""
        self.values[2:] = values
        return self.frame()


def safe_state(mode: Mode, reason: Reason, half_speed: bool) -> int:
    """Give the safety state for `CtrlStatus` and `CtrlAlive`."""
    if mode is _STOP:
        return _CONTROLLED_STOP
    if mode is _FAULT:
        return _SAFE_STOP if FAULTS[reason].reaction is Reaction.CUT else _CONTROLLED_STOP
    return _DEGRADED if half_speed else _RUN


SEND_REFUSAL_LIMIT_TICKS: Final = 3
SEND_REFUSAL_LIMIT_NS: Final = 10_000_000
"""A bus that refuses frames in this many ticks in a row, over this time or longer, is not usable."""
RECOVERY_LIMIT_COUNT: Final = 3
RECOVERY_WINDOW_NS: Final = 60_000_000_000
_OFF: Final = int(BusState.OFF)
_PASSIVE: Final = int(BusState.PASSIVE)
_NONE: Final = Reason.NONE


class BusMonitor:
    """The health of one bus for the supervisor: lost frames, recoveries, refused sends, and the bus state.

    `update` once per tick; ``number`` is 0 for crane0 and 1 for mach0.  A node that came back from bus-off must not
    continue as if nothing had happened (docs/reference/can-bus.md sections 9 and 12): waiting frames are discarded, all
    values are unknown, and a human arms again.  A bus that recovers three times within a minute is not usable for
    arming during the next minute.
    """

    __slots__ = (
        "_dropped",
        "_recovered_ns",
        "_recoveries",
        "_recovery_count",
        "_refused",
        "_refusing_since_ns",
        "_refusing_ticks",
        "_unusable_until_ns",
        "frames_lost",
        "number",
        "reason",
        "recovered",
    )

    def __init__(self, number: int) -> None:
        self.number = number
        self.reason = Reason.NONE
        """The finding of this tick."""
        self.frames_lost = False
        """Frames of this tick were lost, or are older than a recovery: none may be used."""
        self.recovered = False
        """The bus came back from OFF or DOWN since the last tick."""
        self._dropped = self._refused = self._refusing_ticks = self._recoveries = self._recovery_count = 0
        self._refusing_since_ns = 0
        self._recovered_ns = [-RECOVERY_WINDOW_NS] * RECOVERY_LIMIT_COUNT
        self._unusable_until_ns = 0

    def update(self, reading: BusReading, sent: bool, now_ns: int) -> None:
        """Update from the reading of a tick; ``sent``: the previous tick had frames to send."""
        self.recovered = reading.recoveries != self._recoveries
        self.frames_lost = self.recovered or reading.dropped != self._dropped
        self._dropped = reading.dropped
        if reading.refused > self._refused:
            if not self._refusing_ticks:
                self._refusing_since_ns = now_ns
            self._refusing_ticks += 1
        elif sent:
            self._refusing_ticks = 0
        self._refused = reading.refused
        if self.recovered:
            self._note_recoveries(reading.recoveries, now_ns)
        state = reading.state
        if state > _OFF:
            self.reason = Reason.BUS_DOWN
        elif state == _OFF or self.recovered:  # it may come and go between two ticks
            self.reason = Reason.BUS_OFF
        elif (
            self._refusing_ticks >= SEND_REFUSAL_LIMIT_TICKS
            and now_ns - self._refusing_since_ns >= SEND_REFUSAL_LIMIT_NS
        ):
            self.reason = Reason.SEND_REFUSED
        else:
            self.reason = Reason.BUS_PASSIVE if state == _PASSIVE else _NONE

    def usable(self, now_ns: int) -> bool:
        """Tell whether the machine may be armed on this bus."""
        return now_ns >= self._unusable_until_ns

    def _note_recoveries(self, recoveries: int, now_ns: int) -> None:
        stamps = self._recovered_ns
        for _ in range(min(abs(recoveries - self._recoveries), RECOVERY_LIMIT_COUNT)):
            stamps[self._recovery_count % RECOVERY_LIMIT_COUNT] = now_ns
            self._recovery_count += 1
        self._recoveries = recoveries
        if now_ns - min(stamps) < RECOVERY_WINDOW_NS:
            self._unusable_until_ns = now_ns + RECOVERY_WINDOW_NS
