"""Opening a bus, choosing an address, reading error frames, and what a kernel without room answers."""

from __future__ import annotations

import errno
import subprocess
import sys

import pytest

from can_dbc import bus as bus_module
from can_dbc.bus import (
    CRTL_ACTIVE,
    CRTL_PASSIVE,
    CRTL_RX_OVERFLOW,
    CRTL_WARNING,
    ERR_BUSOFF,
    ERR_CNT,
    ERR_CRTL,
    ERR_RESTARTED,
    BusError,
    BusState,
    BusStats,
    default_address,
    open_bus,
)
from can_dbc.frame import ERROR
from can_dbc.socketcan import SocketCanBus


@pytest.mark.parametrize("address", ["", "crane0", "wire:", ":crane0"])
def test_an_address_names_backend_and_channel(address: str) -> None:
    with pytest.raises(BusError, match="is not a bus address; write wire:crane0"):
        open_bus(address)


def test_a_missing_daemon_is_told_with_the_remedy(tmp_path, monkeypatch) -> None:
    monkeypatch.setenv("TIMBERHAND_WIRE_DIR", str(tmp_path))
    with pytest.raises(BusError, match=r"start one with `python -m hil\.wire\.daemon --bus crane0"):
        open_bus("wire:crane0")


def test_a_missing_interface_is_told_with_the_remedy() -> None:
    expected = "ip link" if bus_module.kernel_has_can() else "has no raw CAN sockets"
    with pytest.raises(BusError, match=expected):
        open_bus("socketcan:nocan9")


def test_an_unknown_python_can_interface_is_told() -> None:
    with pytest.raises(BusError, match="python-can cannot open nosuch:1"):
        open_bus("nosuch:1")


@pytest.mark.parametrize(
    ("has_can", "interfaces", "expected"),
    [
        (True, ["lo", "crane0", "vcan0"], "socketcan:crane0"),
        (True, ["lo", "vcan0"], "socketcan:vcan0"),
        (True, ["lo", "vcan1"], "wire:crane0"),
        (False, ["lo", "vcan0"], "wire:crane0"),
    ],
)
def test_default_address_prefers_the_kernel(has_can, interfaces, expected, monkeypatch) -> None:
    monkeypatch.delenv("TIMBERHAND_CRANE0", raising=False)
    monkeypatch.setattr(bus_module, "kernel_has_can", lambda: has_can)
    monkeypatch.setattr("socket.if_nameindex", lambda: list(enumerate(interfaces)))
    assert default_address("crane0") == expected


def test_default_address_obeys_the_user(monkeypatch) -> None:
    monkeypatch.setenv("TIMBERHAND_CRANE0", "socketcan:can3")
    assert default_address("crane0") == "socketcan:can3"
    assert default_address("crane0", "pcan:PCAN_USBBUS1") == "pcan:PCAN_USBBUS1"


@pytest.mark.parametrize(
    ("classes", "flags", "state"),
    [
        (ERR_BUSOFF, 0, BusState.OFF),
        (ERR_CRTL, CRTL_WARNING & 0x08, BusState.WARNING),
        (ERR_CRTL, CRTL_WARNING & 0x04, BusState.WARNING),
        (ERR_CRTL, CRTL_PASSIVE | CRTL_WARNING, BusState.PASSIVE),
        (ERR_CRTL | ERR_BUSOFF, CRTL_PASSIVE, BusState.OFF),
    ],
)
def test_error_frames_set_the_state_and_recovery_clears_it(classes: int, flags: int, state: BusState) -> None:
    stats = BusStats()
    stats.note_error(ERROR | ERR_CNT | classes, bytes((0, flags, 0, 0, 0, 0, 130, 7)))
    assert (stats.state, stats.tx_errors, stats.rx_errors, stats.error_frames) == (state, 130, 7, 1)
    if state is BusState.OFF:
        stats.note_error(ERROR | ERR_RESTARTED, bytes(8))
    else:
        stats.note_error(ERROR | ERR_CRTL, bytes((0, CRTL_ACTIVE, 0, 0, 0, 0, 0, 0)))
    assert stats.state is BusState.ACTIVE


def test_a_receiver_overflow_in_the_adapter_counts_as_dropped() -> None:
    stats = BusStats()
    stats.note_error(ERROR | ERR_CRTL, bytes((0, CRTL_RX_OVERFLOW, 0, 0, 0, 0, 0, 0)))
    assert (stats.dropped, stats.state) == (1, BusState.ACTIVE)


class FullSocket:
    """A raw socket whose interface answers every frame with one error."""

    def __init__(self, number: int) -> None:
        self.number = number

    def send(self, _: bytes) -> int:
        raise OSError(self.number, "refused")


@pytest.mark.parametrize(
    ("number", "state"),
    [(errno.ENOBUFS, BusState.ACTIVE), (errno.EAGAIN, BusState.ACTIVE), (errno.ENETDOWN, BusState.DOWN)],
)
def test_a_kernel_queue_without_room_refuses(number: int, state: BusState) -> None:
    bus = SocketCanBus.__new__(SocketCanBus)
    bus.stats = BusStats()
    bus._sock = FullSocket(number)
    assert not bus.send(0x210, bytes(8))
    assert (bus.stats.refused, bus.stats.sent, bus.stats.state) == (1, 0, state)


def test_the_guard_can_open_wire_and_socketcan_with_the_standard_library_alone() -> None:
    code = (
        "import sys; import can_dbc.bus, can_dbc.socketcan, can_dbc.wire_client;"
        "own = {'can_dbc'}; names = {name.partition('.')[0] for name in sys.modules};"
        "print(sorted(n for n in names - own - sys.stdlib_module_names if n in ('can', 'msgspec', 'numpy')))"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "[]"
