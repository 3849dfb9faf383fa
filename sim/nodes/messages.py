"""Shared by all emulated nodes: periods on virtual time, and the two ends of an E2E-protected message."""

from __future__ import annotations

from typing import Any

from can_dbc.dbc.codec import Database, FrameRefused
from can_dbc.protocols.e2e import Checker, Sender
from can_dbc.protocols.punctuality import Punctuality
from sim.errors import PlantError

MS = 1_000_000
ARM_KEY = 0xA


class PeriodicTimer:
    """A period on virtual time."""

    def __init__(self, period_ns: int, phase_ns: int = 0) -> None:
        self._period, self._next = period_ns, phase_ns

    def due(self, now_ns: int) -> bool:
        """Tell whether the period has elapsed since the last call; a late caller gets one, not a burst."""
        if now_ns < self._next:
            return False
        self._next += self._period * max(1, -(-(now_ns - self._next + 1) // self._period))
        return True


class ProtectedMessage:
    """Encodes one E2E message of the DBC; values in signal order without Crc and Counter, None: not available.

    Raises:
        PlantError: the message has no E2E Data IDs.
    """

    def __init__(self, database: Database, name: str) -> None:
        codec = database.message(name)
        if codec.data_ids is None:
            raise PlantError("plant.message-without-e2e", f"{name} in the DBC has no E2E Data IDs; add them")
        self.key, self._encode, self._sender = codec.key, codec.encode, Sender(codec.data_ids)

    def frame(self, *values: float | None) -> tuple[int, bytes]:
        """Make the next frame."""
        return self.key, self._sender.protect(self._encode(0, 0, *values))


class ProtectedInput:
    """The newest valid frame of one received E2E message of the DBC; ``counter`` is its counter.

    With ``punctuality`` it is a stream of commands: one that comes too late is not accepted, and sets ``late`` until a
    punctual one comes.

    Raises:
        PlantError: the message has no E2E Data IDs.
    """

    def __init__(self, database: Database, name: str, punctuality: Punctuality | None = None) -> None:
        codec = database.message(name)
        if codec.data_ids is None:
            raise PlantError("plant.message-without-e2e", f"{name} in the DBC has no E2E Data IDs; add them")
        self.key, self._receive, self._index = codec.key, codec.receive, codec.index
        self._checker = Checker(codec.data_ids)
        self._punctuality = punctuality
        self.reset()

    def reset(self) -> None:
        """Discard all state, as after a restart."""
        self._checker.reset()
        if self._punctuality is not None:
            self._punctuality.reset()
        self.values: tuple[Any, ...] | None = None
        self.stamp_ns = self.counter = 0
        self.late = False

    def accept(self, data: bytes, now_ns: int) -> bool:
        """Tell whether the frame was valid and accepted."""
        if not self._checker.check(data).usable:
            return False
        try:
            values = self._receive(data)
        except FrameRefused:
            return False
        counter = data[1] & 0x0F
        self.late = self._punctuality is not None and self._punctuality.late(counter, now_ns)
        if self.late:
            return False
        self.values, self.stamp_ns, self.counter = values, now_ns, counter
        return True

    def fresh(self, now_ns: int, limit_ns: int) -> bool:
        """Tell whether the newest valid frame is at most ``limit_ns`` old."""
        return self.values is not None and now_ns - self.stamp_ns <= limit_ns

    def last(self, count: int) -> tuple[Any, ...]:
        """Return the last ``count`` signals of the newest frame, None where not available."""
        return (None,) * count if self.values is None else self.values[-count:]

    def get(self, signal: str) -> float:
        """Return a signal of the newest frame, 0 when unknown or not available."""
        value = None if self.values is None else self.values[self._index[signal]]
        return 0.0 if value is None else value
