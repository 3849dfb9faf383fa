"""Opening a bus, choosing an address, error frames, and a kernel queue without room."""

from __future__ import annotations

import errno
from collections.abc import Sequence
from pathlib import Path

import pytest

from can_dbc.bus import factory, python_can_bus, socketcan
from can_dbc.bus.base import (
    CRTL_ACTIVE,
    CRTL_PASSIVE,
    CRTL_RX_OVERFLOW,
    CRTL_WARNING,
    ERR_BUSOFF,
    ERR_CNT,
    ERR_CRTL,
    ERR_LOSTARB,
    ERR_RESTARTED,
    ERR_TX_TIMEOUT,
    BaseBus,
    BusState,
    BusStats,
)
from can_dbc.bus.factory import default_address, open_bus
from can_dbc.bus.socketcan import SocketCanBus
from can_dbc.frame import ERROR, Frame
from runtime.errors import LinkError
from tests.codes import coded


@pytest.mark.parametrize(
    ("address", "code"),
    [
        *((address, "bus.address") for address in ("", "crane0", "wire:", ":crane0")),
        *((f"python-can:{rest}", "bus.address") for rest in ("", "socketcan", "socketcan:")),
        ("wire:crane0", "wire.no-daemon"),
        ("socketcan:nocan9", "bus.interface" if factory.kernel_has_can() else "bus.no-can"),
        ("nosuch:1", "bus.adapter"),
    ],
)
def test_a_bus_that_cannot_be_opened_is_reported(
    address: str, code: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TIMBERHAND_WIRE_DIR", str(tmp_path))
    with pytest.raises(LinkError, check=coded(code)):
        open_bus(address)


def test_too_many_filters_for_the_kernel_are_reported() -> None:
    with pytest.raises(LinkError, check=coded("bus.too-many-filters")):
        open_bus("socketcan:can0", filters=range(513))


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
    monkeypatch.setattr(factory, "kernel_has_can", lambda: has_can)
    monkeypatch.setattr("socket.if_nameindex", lambda: list(enumerate(interfaces)))
    assert default_address("crane0") == expected


def test_default_address_follows_the_environment_and_the_argument(monkeypatch) -> None:
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
    assert stats.recoveries == (state is BusState.OFF)


@pytest.mark.parametrize("error_class", [ERR_TX_TIMEOUT, ERR_LOSTARB])
@pytest.mark.parametrize("state", [BusState.ACTIVE, BusState.PASSIVE, BusState.OFF])
def test_lost_arbitration_and_a_transmit_time_out_are_only_counted(error_class: int, state: BusState) -> None:
    stats = BusStats(state)
    assert not stats.note_error(ERROR | error_class, bytes(8))
    assert (stats.state, stats.error_frames, stats.recoveries) == (state, 1, 0)


@pytest.mark.parametrize("lost", [BusState.OFF, BusState.DOWN])
@pytest.mark.parametrize("back", [BusState.ACTIVE, BusState.WARNING, BusState.PASSIVE])
def test_only_the_return_from_off_or_down_is_a_recovery(lost: BusState, back: BusState) -> None:
    stats = BusStats()
    ways = [stats.enter(state) for state in (BusState.PASSIVE, lost, lost, back, BusState.ACTIVE, lost)]
    assert ways == [False, False, False, True, False, False]
    assert stats.recoveries == 1 and stats.state is lost


def test_a_receiver_overflow_in_the_adapter_counts_as_dropped() -> None:
    stats = BusStats()
    stats.note_error(ERROR | ERR_CRTL, bytes((0, CRTL_RX_OVERFLOW, 0, 0, 0, 0, 0, 0)))
    assert (stats.dropped, stats.state) == (1, BusState.ACTIVE)


class FullLink:
    """A raw socket whose interface answers every frame with one error."""

    def __init__(self, number: int) -> None:
        self.number = number

    def send(self, _: Sequence[tuple[int, bytes]]) -> int:
        raise OSError(self.number, "refused")


@pytest.mark.parametrize(
    ("number", "state"),
    [(errno.ENOBUFS, BusState.ACTIVE), (errno.EAGAIN, BusState.ACTIVE), (errno.ENETDOWN, BusState.DOWN)],
)
def test_a_kernel_queue_without_room_refuses(number: int, state: BusState) -> None:
    bus = SocketCanBus.__new__(SocketCanBus)
    bus.stats = BusStats()
    bus._link = FullLink(number)
    assert not bus.send(0x210, bytes(8))
    assert bus.send_all([(0x210, bytes(8)), (0x310, bytes(8))]) == 0
    assert (bus.stats.refused, bus.stats.sent, bus.stats.state) == (3, 0, state)


class Waiting(BaseBus):
    """A bus with groups of waiting frames, one for each drain."""

    def __init__(self) -> None:
        super().__init__("test")
        self.bunches: list[list[Frame]] = []

    def _receive(self, frames: list[Frame]) -> None:
        if self.bunches:
            frames += self.bunches.pop(0)


def test_a_flush_reads_until_no_frame_waits_for_any_stamps() -> None:
    """With an adapter that stamps in its own time, every frame gets the time of the drain."""
    bus, far = Waiting(), 1 << 62
    bus.bunches = [[Frame(far, key, b"old")] for key in range(3)]
    bus.flush()
    bus.bunches.append([Frame(far, 9, b"new")])
    frames: list[Frame] = []
    assert bus.drain(frames) == 1 and frames[0].data == b"new"
    assert bus.stats.received == 1


@pytest.mark.parametrize(
    ("address", "opened"),
    [
        ("socketcan:can0", ("SocketCanBus", "can0")),
        ("python-can:socketcan:can0", ("PythonCanBus", "socketcan", "can0")),
        ("kvaser:0", ("PythonCanBus", "kvaser", "0")),
        ("python-can:kvaser:0", ("PythonCanBus", "kvaser", "0")),
    ],
)
def test_an_address_chooses_our_socket_or_python_cans(
    monkeypatch: pytest.MonkeyPatch, address: str, opened: tuple[str, ...]
) -> None:
    for module, name in ((socketcan, "SocketCanBus"), (python_can_bus, "PythonCanBus")):
        monkeypatch.setattr(module, name, lambda *given, name=name: (name, *(g for g in given if isinstance(g, str))))
    assert open_bus(address) == opened
