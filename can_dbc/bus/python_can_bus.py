"""Any python-can interface as a `Bus`: for adapters without a SocketCAN driver, and for tests.

python-can stamps in wall-clock seconds or in the adapter's own time.  The former are converted as those of the kernel
(`can_dbc.bus.receive_clock`); a stamp that is more than a second away from now, in either direction, is assumed to be
of the adapter and is replaced by the time of the drain.
"""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Sequence
from typing import Final

import can

from can_dbc.bus.base import DRAIN_LIMIT, BaseBus, BusState, Filter
from can_dbc.bus.receive_clock import ReceiveClock
from can_dbc.frame import ERROR, EXTENDED, REMOTE, Frame, identifier
from runtime.errors import LinkError

_PLAUSIBLE_NS: Final = 1_000_000_000
_FAILURES: Final = (can.CanError, OSError, ValueError, ImportError)


class PythonCanBus(BaseBus):
    """One python-can bus (contract: `can_dbc.bus.base.Bus`).  `reopen` takes as long as the adapter's driver."""

    def __init__(self, interface: str, channel: str, wanted: Filter | None = None, receive_own: bool = False) -> None:
        super().__init__(channel)
        self._interface, self._wanted, self._receive_own = interface, wanted, receive_own
        self._clock = ReceiveClock(time.monotonic_ns())
        try:
            self._can = self._open()
        except _FAILURES as error:
            raise LinkError(
                "bus.adapter",
                f"python-can cannot open {interface}:{channel} ({error}); check the interface name, the "
                "channel and that the adapter's driver is installed.",
            ) from error

    def fileno(self) -> int:
        try:
            return self._can.fileno()
        except NotImplementedError:
            return -1

    def send_all(self, frames: Sequence[tuple[int, bytes]]) -> int:
        stats, sent = self.stats, 0
        if stats.state < BusState.OFF:
            with contextlib.suppress(can.CanError, OSError):  # no room: this frame and the rest are refused
                for key, data in frames:
                    if len(data) > 8:
                        break
                    self._can.send(message_of(key, data), timeout=0)
                    sent += 1
        stats.sent += sent
        stats.refused += len(frames) - sent
        return sent

    def discard(self) -> int:
        with contextlib.suppress(can.CanError, OSError, NotImplementedError):  # not every adapter can
            self._can.flush_tx_buffer()
        return 0  # it does not say how many

    def flush(self) -> None:
        self.discard()
        super().flush()

    def _receive(self, frames: list[Frame]) -> None:
        stats, receive_filter, start_index = self.stats, self._wanted, len(frames)
        clock = self._clock
        for _ in range(DRAIN_LIMIT):
            try:
                message = self._can.recv(timeout=0)
            except (can.CanError, OSError):
                stats.enter(BusState.DOWN)
                return
            if message is None:
                clock.begin(time.monotonic_ns(), time.time_ns())
                clock.emptied()
                return
            if message.is_error_frame:
                if stats.note_error(message.arbitration_id, bytes(message.data).ljust(8, b"\0")):
                    del frames[start_index:]
                continue
            key = key_of(message)
            if receive_filter is None or key in receive_filter:
                frames.append(Frame(self._stamp_ns(message.timestamp), key, payload_of(message)))

    def _stamp_ns(self, stamp_s: float) -> int:
        clock = self._clock
        clock.begin(time.monotonic_ns(), time.time_ns())
        if not math.isfinite(stamp_s):
            return clock.now_ns
        wall_ns = int(stamp_s * 1e9)
        stamp_ns = wall_ns + clock.offset_ns
        if clock.since_ns <= stamp_ns <= clock.now_ns:
            return stamp_ns
        return clock.doubtful_ns(wall_ns) if abs(stamp_ns - clock.now_ns) <= _PLAUSIBLE_NS else clock.now_ns

    def _open(self) -> can.BusABC:
        return can.Bus(interface=self._interface, channel=self.name, receive_own_messages=self._receive_own)

    def _reopen_link(self) -> bool:
        self._release()
        try:
            self._can = self._open()
        except _FAILURES:
            return False
        return True

    def _release(self) -> None:
        with contextlib.suppress(can.CanError, OSError):
            self._can.shutdown()


def message_of(key: int, data: bytes, timestamp_s: float = 0.0) -> can.Message:
    """Make the python-can message of a key and payload."""
    return can.Message(
        timestamp=timestamp_s,
        arbitration_id=key & 0x1FFF_FFFF if key & ERROR else identifier(key),
        is_extended_id=bool(key & EXTENDED),
        is_remote_frame=bool(key & REMOTE),
        is_error_frame=bool(key & ERROR),
        dlc=len(data),
        data=data,
    )


def key_of(message: can.Message) -> int:
    """Return the key of a python-can data or remote message."""
    return (
        message.arbitration_id
        | (EXTENDED if message.is_extended_id else 0)
        | (REMOTE if message.is_remote_frame else 0)
    )


def payload_of(message: can.Message) -> bytes:
    """Return the payload of a message; for a remote frame as many zeros as it requests bytes."""
    return bytes(message.dlc) if message.is_remote_frame else bytes(message.data)
