"""One small interface to any CAN bus, made for a real-time loop; `can_dbc.bus.factory` opens one.

Contract of every `Bus`: only opening raises (`LinkError`).  `drain`, `send` and `send_all` never block.  `drain` gives
data and remote frames in the order of the bus; error frames update `BusStats.state` and never reach a codec.  Own
frames come back only on request, so a frame with an own identifier comes from another sender; on SocketCAN that may be
another process on this machine.

A frame that is not accepted (queue full, bus off, link or daemon lost) is counted in `BusStats.refused` and never sent
later.  Bus-off ends by itself (restart-ms of the interface; restart time of the wire).  A lost link stays DOWN until
`reopen` finds it again.  Both recoveries count in `BusStats.recoveries`, and no frame from before is delivered after
them.

This module and the wire and SocketCAN backends need only the standard library (the guard imports them).
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Final, Protocol, Self

from can_dbc.frame import EXTENDED, EXTENDED_MASK, REMOTE, Frame

DRAIN_LIMIT: Final = 1024
"""Most frames of one `Bus.drain` (a few more if they arrive in packets): a flooded bus must not delay the tick."""
_FLUSH_DRAINS: Final = 16
"""Most drains of one `Bus.flush`; frames that remain are recognized by their stamp."""

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


class BusState(IntEnum):
    """Fault confinement state of the own node (ISO 11898-1), ordered from good to bad."""

    ACTIVE = 0
    WARNING = 1
    PASSIVE = 2
    OFF = 3
    DOWN = 4
    """The link is down or unplugged, or the wire daemon has ended."""


_DOWN: Final = BusState.DOWN
"""A module's constant is found faster than an enumeration's member, and `BaseBus.drain` runs in every tick."""


@dataclass(slots=True)
class BusStats:
    """Counters since opening, and the state of the own node; one object per bus, updated in place."""

    state: BusState = BusState.ACTIVE
    received: int = 0
    """Data and remote frames returned by `Bus.drain`."""
    sent: int = 0
    """Frames accepted for sending."""
    refused: int = 0
    """Frames that `Bus.send` and `Bus.send_all` did not accept, and those that `Bus.discard` cancelled."""
    dropped: int = 0
    """Received frames lost because the reader was too slow."""
    error_frames: int = 0
    recoveries: int = 0
    """Number of recoveries from OFF or DOWN."""
    tx_errors: int = 0
    """Transmit error counter of the node, if the backend reports it."""
    rx_errors: int = 0

    def enter(self, state: BusState) -> bool:
        """Change the state; True if this is a recovery."""
        recovered = state < BusState.OFF <= self.state
        self.recoveries += recovered
        self.state = state
        return recovered

    def note_error(self, key: int, data: bytes) -> bool:
        """Update the state with one error frame (linux/can/error.h: class in the key, 8 data bytes).

        True if the node has recovered; frames received before are then out of date.  Lost arbitration and time-outs of
        the driver's transmitter are counted and change no state: the former is normal, and the latter shows as frames
        that are not accepted.
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
        """Return the descriptor that is readable when frames wait; -1 if the backend has none.  `reopen` changes it."""

    def drain(self, frames: list[Frame]) -> int:
        """Append every waiting frame, at most `DRAIN_LIMIT`; returns how many."""

    def send(self, key: int, data: bytes) -> bool:
        """Send one frame of 0 to 8 bytes; False if it was not accepted."""

    def send_all(self, frames: Sequence[tuple[int, bytes]]) -> int:
        """Send (key, data) frames in order, with one system call if the backend can; returns how many were accepted.

        The first frame that is not accepted and all frames behind it are refused.
        """

    def discard(self) -> int:
        """Cancel own frames whose transmission has not begun, if the backend can; they count in `BusStats.refused`.

        Returns how many it cancelled, a few more while the backend does not know yet which have gone out; 0 if it
        cannot: SocketCAN has no way to empty the queue of an interface.
        """

    def flush(self) -> None:
        """Discard the frames received so far (error frames still change the state) and, if the backend can, own frames
        that are not on the bus yet.
        """

    def reopen(self) -> bool:
        """Make one attempt to restore a lost link, a few milliseconds at most; True if the bus is usable.

        Has an effect only in state DOWN: does nothing to a working bus (True) or to one that is bus-off or closed
        (False).  A restored link is a new one and holds no frames from before.  Cheap enough for every cycle.
        """

    def close(self) -> None:
        """Leave the bus; may be called twice."""

    def __enter__(self) -> Self: ...

    def __exit__(self, *exc: object) -> None: ...


class BaseBus:
    """Base class of every backend, which implements `_receive`, `send_all`, `_reopen_link` and `_release`."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.stats = BusStats()
        self._flushed_ns = 0
        """Frames stamped before this are discarded; 0 after a newer one has come."""
        self._closed = False

    def _receive(self, frames: list[Frame]) -> None:
        """Append the waiting frames, without blocking."""
        raise NotImplementedError

    def _reopen_link(self) -> bool:
        """Release the lost link and opens it again; True if it is usable."""
        return False

    def _release(self) -> None:
        """Release the backend's resources; never fails."""

    def drain(self, frames: list[Frame]) -> int:
        stats = self.stats
        if stats.state is _DOWN:
            return 0
        before = len(frames)
        self._receive(frames)
        if self._flushed_ns and len(frames) > before:
            frames[before:] = [frame for frame in frames[before:] if frame.stamp_ns >= self._flushed_ns]
            if len(frames) > before:
                self._flushed_ns = 0  # in the order of the bus nothing older follows
        count = len(frames) - before
        stats.received += count
        return count

    def send(self, key: int, data: bytes) -> bool:
        return self.send_all(((key, data),)) == 1

    def send_all(self, frames: Sequence[tuple[int, bytes]]) -> int:
        raise NotImplementedError

    def discard(self) -> int:
        return 0

    def flush(self) -> None:
        self._flushed_ns = time.monotonic_ns()
        for _ in range(_FLUSH_DRAINS):
            discarded: list[Frame] = []
            if self.stats.state is not BusState.DOWN:
                self._receive(discarded)
            if not discarded:
                return

    def reopen(self) -> bool:
        stats = self.stats
        if stats.state is BusState.DOWN and not self._closed and self._reopen_link():
            stats.enter(BusState.ACTIVE)
            self.flush()
        return stats.state < BusState.OFF

    def close(self) -> None:
        if not self._closed:
            self._closed = True
            self._release()
            self.stats.enter(BusState.DOWN)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()


# -- The bit rates of the machine's two buses.

CRANE_BITRATE: Final = 1_000_000
MACHINE_BITRATE: Final = 250_000
BITRATES: Final = {"crane0": CRANE_BITRATE, "mach0": MACHINE_BITRATE}
"""Logical bus -> bit/s."""


# -- The frames that a participant receives: exact keys, and (key, mask) pairs for messages matched by PGN.
#
# A pair ``(key, mask)`` matches a frame whose key equals ``key`` in the bits of ``mask``.  The kind bits (extended,
# remote) always count: no mask matches a remote frame or an 11-bit identifier by accident.

FilterItem = int | tuple[int, int]
_KIND: Final = EXTENDED | REMOTE


class Filter:
    """``key in filter`` is True for a frame to receive; ``pairs`` is the same as (key, mask), with kind bits."""

    __slots__ = ("_keys", "_masked", "pairs")

    def __init__(self, wanted: Iterable[int | Sequence[int]]) -> None:
        """Sort the items into keys and masks; TypeError or ValueError for one that is neither a key nor a pair."""
        pairs: set[tuple[int, int]] = set()
        for item in wanted:
            key, mask = (item, EXTENDED_MASK) if isinstance(item, int) else item
            mask = (mask & EXTENDED_MASK) | _KIND
            pairs.add((key & mask, mask))
        self.pairs = tuple(sorted(pairs))
        self._keys = frozenset(key for key, mask in self.pairs if mask == EXTENDED_MASK | _KIND)
        self._masked = tuple((key, mask) for key, mask in self.pairs if mask != EXTENDED_MASK | _KIND)

    def __contains__(self, key: object) -> bool:
        return key in self._keys or (
            isinstance(key, int) and any(key & mask == filter_key for filter_key, mask in self._masked)
        )


def filter_of(wanted: Iterable[FilterItem] | None) -> Filter | None:
    """Return the filter of a participant's items; None, which passes everything, for None."""
    return None if wanted is None else Filter(wanted)
