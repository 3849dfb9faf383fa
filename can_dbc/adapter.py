"""Any python-can interface behind our `Bus`: for adapters that have no SocketCAN driver, and for tests.

python-can stamps in wall-clock seconds or in the adapter's own time; a stamp more than a second away from
now is of the second sort and is replaced by the time of the drain.
"""

from __future__ import annotations

import time
from typing import Final

import can

from can_dbc.bus import DRAIN_LIMIT, BaseBus, BusError, BusState
from can_dbc.frame import ERROR, EXTENDED, REMOTE, Frame, identifier

_PLAUSIBLE_AGE_NS: Final = 1_000_000_000


class PythonCanBus(BaseBus):
    """One python-can bus (contract: `can_dbc.bus.Bus`)."""

    def __init__(
        self, interface: str, channel: str, keys: frozenset[int] | None = None, receive_own: bool = False
    ) -> None:
        super().__init__(channel)
        try:
            self._can = can.Bus(interface=interface, channel=channel, receive_own_messages=receive_own)
        except (can.CanError, OSError, ValueError, ImportError) as error:
            raise BusError(
                f"python-can cannot open {interface}:{channel} ({error}); check the interface name, the "
                "channel and that the adapter's driver is installed."
            ) from error
        self._keys = keys

    def fileno(self) -> int:
        try:
            return self._can.fileno()
        except NotImplementedError:
            return -1

    def drain(self, frames: list[Frame]) -> int:
        if self.stats.state is BusState.DOWN:
            return 0
        before = len(frames)
        offset_ns = time.monotonic_ns() - time.time_ns()
        for _ in range(DRAIN_LIMIT):
            try:
                message = self._can.recv(timeout=0)
            except (can.CanError, OSError):
                self.stats.state = BusState.DOWN
                break
            if message is None:
                break
            if message.is_error_frame:
                self.stats.note_error(message.arbitration_id, bytes(message.data).ljust(8, b"\0"))
                continue
            key = key_of(message)
            if self._keys is None or key in self._keys:
                now_ns = time.monotonic_ns()
                stamp_ns = min(int(message.timestamp * 1e9) + offset_ns, now_ns)
                if now_ns - stamp_ns > _PLAUSIBLE_AGE_NS:
                    stamp_ns = now_ns
                frames.append(Frame(stamp_ns, key, payload_of(message)))
        taken = len(frames) - before
        self.stats.received += taken
        return taken

    def send(self, key: int, data: bytes) -> bool:
        if self.stats.state < BusState.OFF and len(data) <= 8:
            try:
                self._can.send(message_of(key, data), timeout=0)
                self.stats.sent += 1
                return True
            except (can.CanError, OSError):
                pass  # refused below
        self.stats.refused += 1
        return False

    def close(self) -> None:
        self._can.shutdown()
        self.stats.state = BusState.DOWN


def message_of(key: int, data: bytes, timestamp_s: float = 0.0) -> can.Message:
    """The python-can message of a key and payload."""
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
    """The key of a python-can data or remote message."""
    return (
        message.arbitration_id
        | (EXTENDED if message.is_extended_id else 0)
        | (REMOTE if message.is_remote_frame else 0)
    )


def payload_of(message: can.Message) -> bytes:
    """The payload of a message; that of a remote frame is as many zeros as it asks for bytes."""
    return bytes(message.dlc) if message.is_remote_frame else bytes(message.data)
