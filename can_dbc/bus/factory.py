"""Opens a CAN bus by its address; `can_dbc.bus.base` has the contract of every `Bus`.

Address: ``wire:crane0`` (the user-space bus of ``hil.wire``), ``socketcan:vcan0`` (a kernel interface) or
``<python-can interface>:<channel>``.  ``python-can:`` before an address of the kernel has python-can's socket instead
of ours: ``python-can:socketcan:can0``.  `default_address` chooses one for a logical name.
"""

from __future__ import annotations

import os
import socket
from collections.abc import Iterable
from typing import Final

from can_dbc.bus.base import Bus, FilterItem, filter_of
from runtime.errors import LinkError

PYTHON_CAN: Final = "python-can:"
VCAN_NAMES: Final = {"crane0": "vcan0", "mach0": "vcan1"}


def open_bus(
    address: str,
    *,
    filters: Iterable[FilterItem] | None = None,
    receive_own: bool = False,
    tx_queue: int = 10,
    participant: str | None = None,
) -> Bus:
    """Open the bus at `address`.

    Args:
        address: See the module docstring.
        filters: Exact keys and (key, mask) pairs to receive (`can_dbc.bus.base`); None for all.  Error frames always
            arrive.  The kernel accepts at most 512; a few dozen cost nothing.
        receive_own: Also returns own frames after they were on the bus.
        tx_queue: Limit of the own frames waiting on the wire, like ``txqueuelen`` in the kernel; a process that
            emulates many nodes needs more than 10.
        participant: The name of this process for faults on the wire (default: the program's name).

    Raises:
        LinkError: The bus cannot be opened.
    """
    backend, _, channel = address.removeprefix(PYTHON_CAN).partition(":")
    bus_filter = filter_of(filters)
    if not backend or not channel:
        raise LinkError(
            "bus.address",
            f"'{address}' is not a bus address; write wire:crane0, socketcan:can0 or another python-can "
            "interface and its channel, for example virtual:test.",
        )
    # Backends are imported on demand: the guard must not import python-can.
    own_backend = not address.startswith(PYTHON_CAN)
    if own_backend and backend == "wire":
        from can_dbc.bus.wire_client import WireClient

        return WireClient(channel, bus_filter, receive_own, tx_queue, participant)
    if own_backend and backend == "socketcan":
        from can_dbc.bus.socketcan import SocketCanBus

        return SocketCanBus(channel, bus_filter, receive_own)
    from can_dbc.bus.python_can_bus import PythonCanBus

    return PythonCanBus(backend, channel, bus_filter, receive_own)


def default_address(logical_name: str, explicit: str | None = None) -> str:
    """Choose the address for ``crane0`` or ``mach0``.

    It is the explicit one, else ``TIMBERHAND_<NAME>`` from the environment, else a SocketCAN interface of that name or
    its vcan stand-in where the kernel has one, else the wire.
    """
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
    """Return True when this kernel offers raw CAN sockets."""
    try:
        socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()
    except OSError:
        return False
    return True
