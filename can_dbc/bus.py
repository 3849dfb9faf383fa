"""Opens any CAN bus behind one small interface made for a real-time loop.

Address: ``wire:crane0`` (the user-space bus of ``hil.wire``), ``socketcan:vcan0`` (a kernel interface) or
``<python-can interface>:<channel>``.  `default_address` chooses one for a logical name.

Contract of every `Bus`: `drain` and `send` never block.  `drain` gives data and remote frames in the order
of the bus; error frames become `BusStats.state` and never reach a codec.  `send` returns False when the
frame was not taken (queue full, bus off, link or daemon gone); such a frame is counted in `refused` and is
never sent later.  Only opening raises: `BusError`, one sentence that says what to do.

This module and the wire and SocketCAN backends need the standard library alone (the guard imports them).
"""

from __future__ import annotations

import os
import socket
from collections.abc import Iterable
from dataclasses import dataclass
from enum import IntEnum
from typing import Final, Protocol, Self

from can_dbc.frame import Frame

DRAIN_LIMIT: Final = 1024
"""Most reads one `Bus.drain` makes, so that a flooded bus cannot hold the tick."""

VCAN_NAMES: Final = {"crane0": "vcan0", "mach0": "vcan1"}

# Error classes and controller flags of linux/can/error.h.
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


class BusError(Exception):
    """A bus cannot be opened; the message says what is wrong, where, and what to do."""


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
    sent: int = 0
    """Frames taken for sending."""
    refused: int = 0
    """Frames `Bus.send` did not take."""
    dropped: int = 0
    """Received frames lost because this reader was too slow."""
    error_frames: int = 0
    tx_errors: int = 0
    """Transmit error counter of the node, where the backend tells it."""
    rx_errors: int = 0

    def note_error(self, key: int, data: bytes) -> None:
        """Takes one error frame (linux/can/error.h: class in the key, 8 data bytes) into the state."""
        self.error_frames += 1
        flags = data[1] if key & ERR_CRTL else 0
        if key & ERR_CNT:
            self.tx_errors, self.rx_errors = data[6], data[7]
        if flags & CRTL_RX_OVERFLOW:
            self.dropped += 1
        if key & ERR_BUSOFF:
            self.state = BusState.OFF
        elif key & ERR_RESTARTED:
            self.state = BusState.ACTIVE
        elif flags & CRTL_PASSIVE:
            self.state = BusState.PASSIVE
        elif flags & CRTL_WARNING:
            self.state = BusState.WARNING
        elif flags & CRTL_ACTIVE:
            self.state = BusState.ACTIVE


class Bus(Protocol):
    """One participant on one CAN bus (module docstring: contract)."""

    name: str
    stats: BusStats

    def fileno(self) -> int:
        """Descriptor that becomes readable when frames wait; -1 where the backend has none."""

    def drain(self, frames: list[Frame]) -> int:
        """Appends every waiting frame, at most `DRAIN_LIMIT` reads; returns how many were appended."""

    def send(self, key: int, data: bytes) -> bool:
        """Hands over one frame of 0 to 8 bytes; False when it was not taken."""

    def close(self) -> None:
        """Leaves the bus; closing twice is fine."""

    def __enter__(self) -> Self: ...

    def __exit__(self, *exc: object) -> None: ...


class BaseBus:
    """What every backend shares: name, counters and the context manager."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.stats = BusStats()

    def close(self) -> None:
        """Leaves the bus; closing twice is fine."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()


def open_bus(
    address: str,
    *,
    filters: Iterable[int] | None = None,
    receive_own: bool = False,
    tx_queue: int = 10,
    participant: str | None = None,
) -> Bus:
    """Opens the bus at `address`; raises `BusError`.

    `filters` are the exact keys to receive (None: all; error frames always arrive).  `receive_own` also
    gives back own frames once they were on the bus.  `tx_queue` bounds the own frames that wait on the
    wire, like ``txqueuelen`` does in the kernel; a process that plays many nodes needs more than 10.
    `participant` is the name by which faults on the wire find this process (default: the program's name).
    """
    backend, _, channel = address.partition(":")
    keys = None if filters is None else frozenset(filters)
    if not backend or not channel:
        raise BusError(
            f"'{address}' is not a bus address; write wire:crane0, socketcan:can0 or another python-can "
            "interface and its channel, as in virtual:test."
        )
    # Backends load on demand: the guard must not pull in python-can.
    if backend == "wire":
        from can_dbc.wire_client import WireClient

        return WireClient(channel, keys, receive_own, tx_queue, participant)
    if backend == "socketcan":
        from can_dbc.socketcan import SocketCanBus

        return SocketCanBus(channel, keys, receive_own)
    from can_dbc.adapter import PythonCanBus

    return PythonCanBus(backend, channel, keys, receive_own)


def default_address(logical_name: str, explicit: str | None = None) -> str:
    """The address for ``crane0`` or ``mach0``: an explicit one, ``TIMBERHAND_<NAME>`` from the environment,
    a SocketCAN interface of that name or its vcan stand-in where the kernel has one, else the wire."""
    chosen = explicit or os.environ.get(f"TIMBERHAND_{logical_name.upper()}")
    if chosen:
        return chosen
    if kernel_has_can():
        present = {name for _, name in socket.if_nameindex()}
        for interface in (logical_name, VCAN_NAMES.get(logical_name)):
            if interface in present:
                return f"socketcan:{interface}"
    return f"wire:{logical_name}"


def kernel_has_can() -> bool:
    """True when this kernel offers raw CAN sockets."""
    try:
        socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()
    except OSError:
        return False
    return True
