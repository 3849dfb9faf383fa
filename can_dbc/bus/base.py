"""One small interface to any CAN bus, made for a real-time loop; `can_dbc.bus.factory` opens one.

Contract of every `Bus`: nothing but opening raises, `BusError`, one sentence that says what to do.  `drain`, `send` and
`send_all` never block.  `drain` gives data and remote frames in the order of the bus; error frames become
`BusStats.state` and never reach a codec.  Own frames do not come back unless asked for, so a frame with an own
identifier is somebody else's; on SocketCAN that may be another process on this machine.

A frame that is not taken (queue full, bus off, link or daemon gone) is counted in `BusStats.refused` and is never
sent later.  Bus-off ends by itself (restart-ms of the interface; the restart time of the wire).  A lost link stays DOWN
until `reopen` finds it again.  Both ways back count in `BusStats.recoveries`, and no frame from before is delivered
after them.

This module and the wire and SocketCAN backends need the standard library alone (the guard imports them).
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Final, Protocol, Self

from can_dbc.frame import Frame
from runtime.errors import CodedError

DRAIN_LIMIT: Final = 1024
"""Most frames one `Bus.drain` takes (a few more where they arrive in packets): a flooded bus cannot hold the tick."""
_FLUSH_DRAINS: Final = 16
"""Most drains of one `Bus.flush`; what they leave is recognised by its stamp."""

# Error classes and controller flags of linux/can/error.h.
ERR_TX_TIMEOUT: Final = 0x001
ERR_LOSTARB: Final = 0x002
ERR_CRTL: Final = 0x004
ERR_PROT: Final = 0x008
ERR_ACK: Final = 0x020
ERR_BUSOFF: Final = 0x040
ERR_BUSERROR: Final = 0x080
ERR_RESTARTED: Final = 0x100
ERR_CNT: Final = 0x200
CRTL_RX_OVERFLOW: Final = 0x01
CRTL_WARNING: Final = 0x0C  # receive 04, transmit 08
CRTL_PASSIVE: Final = 0x30  # receive 10, transmit 20
CRTL_ACTIVE: Final = 0x40


class BusError(CodedError):
    """A bus cannot be opened; the sentence says what is wrong, where, and what to do."""


class BusState(IntEnum):
    """Fault confinement state of the own node (ISO 11898-1), ordered from good to bad."""

    ACTIVE = 0
    WARNING = 1
    PASSIVE = 2
    OFF = 3
    DOWN = 4
    """The link is down, unplugged, or the wire daemon has gone."""


@dataclass(slots=True)
class BusStats:
    """Counters since opening, and the state of the own node; one object per bus, updated in place."""

    state: BusState = BusState.ACTIVE
    received: int = 0
    """Data and remote frames that `Bus.drain` gave."""
    sent: int = 0
    """Frames taken for sending."""
    refused: int = 0
    """Frames that `Bus.send` and `Bus.send_all` did not take."""
    dropped: int = 0
    """Received frames lost because this reader was too slow."""
    error_frames: int = 0
    recoveries: int = 0
    """How often the state came back from OFF or DOWN."""
    tx_errors: int = 0
    """Transmit error counter of the node, where the backend tells it."""
    rx_errors: int = 0

    def enter(self, state: BusState) -> bool:
        """Changes the state; True when that is a recovery."""
        recovered = state < BusState.OFF <= self.state
        self.recoveries += recovered
        self.state = state
        return recovered

    def note_error(self, key: int, data: bytes) -> bool:
        """Takes one error frame (linux/can/error.h: class in the key, 8 data bytes) into the state.

        True when the node has recovered: what was received before is out of date.  Lost arbitration and the time-out
        of the driver's transmitter are counted and change no state: the one is everyday life on a bus, and the other
        shows as frames that find no room.
        """
        self.error_frames += 1
        flags = data[1] if key & ERR_CRTL else 0
        if key & ERR_CNT:
            self.tx_errors, self.rx_errors = data[6], data[7]
        if flags & CRTL_RX_OVERFLOW:
            self.dropped += 1
        if key & ERR_BUSOFF:
            return self.enter(BusState.OFF)
        if key & ERR_RESTARTED:
            return self.enter(BusState.ACTIVE)
        if flags & CRTL_PASSIVE:
            return self.enter(BusState.PASSIVE)
        if flags & CRTL_WARNING:
            return self.enter(BusState.WARNING)
        if flags & CRTL_ACTIVE:
            return self.enter(BusState.ACTIVE)
        return False


class Bus(Protocol):
    """One participant on one CAN bus (module docstring: contract)."""

    name: str
    stats: BusStats

    def fileno(self) -> int:
        """Descriptor that becomes readable when frames wait; -1 where the backend has none.  `reopen` changes it."""

    def drain(self, frames: list[Frame]) -> int:
        """Appends every waiting frame, at most `DRAIN_LIMIT`; returns how many were appended."""

    def send(self, key: int, data: bytes) -> bool:
        """Hands over one frame of 0 to 8 bytes; False when it was not taken."""

    def send_all(self, frames: Sequence[tuple[int, bytes]]) -> int:
        """Hands over (key, data) frames in order, in one system call where the backend can; returns how many were
        taken.  The first frame that is not taken and all behind it are refused."""

    def flush(self) -> None:
        """Discards what was received up to now (error frames still change the state) and, where the backend can, own
        frames that are not on the bus yet."""

    def reopen(self) -> bool:
        """One try to get a lost link back, never longer than a few milliseconds; True when the bus is usable.

        Only DOWN asks for it: a bus that works is left alone (True), so is one that is bus-off or closed (False).  A
        link that comes back is opened anew and holds no frames from before.  Cheap enough for every cycle.
        """

    def close(self) -> None:
        """Leaves the bus; closing twice is fine."""

    def __enter__(self) -> Self: ...

    def __exit__(self, *exc: object) -> None: ...


class BaseBus:
    """What every backend shares.  A backend gives `_take`, `send_all`, `_open_again` and `_leave`."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.stats = BusStats()
        self._flushed_ns = 0
        """Frames stamped before this are thrown away; 0 once a newer one came."""
        self._closed = False

    def _take(self, frames: list[Frame]) -> None:
        """Appends what waits, without blocking."""
        raise NotImplementedError

    def _open_again(self) -> bool:
        """Leaves the lost link and opens it anew; True when it is usable."""
        return False

    def _leave(self) -> None:
        """Gives back what the backend holds; never fails."""

    def drain(self, frames: list[Frame]) -> int:
        stats = self.stats
        if stats.state is BusState.DOWN:
            return 0
        before = len(frames)
        self._take(frames)
        if self._flushed_ns and len(frames) > before:
            frames[before:] = [frame for frame in frames[before:] if frame.stamp_ns >= self._flushed_ns]
            if len(frames) > before:
                self._flushed_ns = 0  # in the order of the bus nothing older follows
        taken = len(frames) - before
        stats.received += taken
        return taken

    def send(self, key: int, data: bytes) -> bool:
        return self.send_all(((key, data),)) == 1

    def send_all(self, frames: Sequence[tuple[int, bytes]]) -> int:
        raise NotImplementedError

    def flush(self) -> None:
        self._flushed_ns = time.monotonic_ns()
        for _ in range(_FLUSH_DRAINS):
            scrap: list[Frame] = []
            if self.stats.state is not BusState.DOWN:
                self._take(scrap)
            if not scrap:
                return

    def reopen(self) -> bool:
        stats = self.stats
        if stats.state is BusState.DOWN and not self._closed and self._open_again():
            stats.enter(BusState.ACTIVE)
            self.flush()
        return stats.state < BusState.OFF

    def close(self) -> None:
        if not self._closed:
            self._closed = True
            self._leave()
            self.stats.enter(BusState.DOWN)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()
