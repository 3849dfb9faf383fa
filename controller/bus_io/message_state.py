"""The newest good frame of one message: its values with their age, stale by the DBC's time-out.

Every value starts as unknown.  A frame is refused whole when its length, checksum, counter or a value is wrong; the old
values then only grow older until they are stale by the DBC's time-out, and the message must qualify again (two good
frames).  A rotary encoder, which has no counter, is alive while its time stamp changes.
"""

from __future__ import annotations

import math
from typing import Any, Final

from can_dbc.dbc.codec import FrameRefused, MessageCodec
from can_dbc.frame import Frame
from can_dbc.protocols.e2e import Checker
from runtime.errors import ConfigError

NEUTRAL_WITHIN_NS: Final = 100_000_000
"""Within this time after a needed input is lost every function is at neutral (docs/reference/safety.md section 2)."""
_MAX_TIMEOUT_NS: Final = NEUTRAL_WITHIN_NS - 10_000_000


class Signal:
    """One signal of a message, found once: a name costs a tick more than its value."""

    __slots__ = ("_place", "_state")

    def __init__(self, state: MessageState, name: str) -> None:
        """Raises KeyError if the message has no such signal."""
        self._state, self._place = state, state.codec.index[name]

    def value(self) -> Any:
        """The value now; None when the message is unknown or stale, or the signal not available."""
        values = self._state.values
        return None if values is None else values[self._place]


class MessageState:
    """One message; ``values`` is None before the first good frame and when they are stale."""

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
        """The values are unknown again; the next frames must qualify the message."""
        self.values: tuple[Any, ...] | None = None
        self.fresh = False
        """A good frame came in this tick."""
        if self._checker is not None:
            self._checker.reset()

    def get(self, signal: str) -> Any:
        """A signal's value; None when the message is unknown or stale, or the signal not available."""
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
    """A received value, NaN when there is none."""
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
