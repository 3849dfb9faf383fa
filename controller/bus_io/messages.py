"""Messages to send: E2E-protected frames, the period at which they go out, and the safety state that they carry."""

from __future__ import annotations

from typing import Final

from can_dbc.dbc.codec import MessageCodec
from can_dbc.frame import RawFrame
from can_dbc.protocols.e2e import Sender
from machine.status.faults import FAULTS
from machine.status.modes import Mode
from machine.status.reasons import Reaction, Reason

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
        """True at the first call and once per period."""
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
    """The safety state in `CtrlStatus` and `CtrlAlive`."""
    if mode is _STOP:
        return _CONTROLLED_STOP
    if mode is _FAULT:
        return _SAFE_STOP if FAULTS[reason].reaction is Reaction.CUT else _CONTROLLED_STOP
    return _DEGRADED if half_speed else _RUN
