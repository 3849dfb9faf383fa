"""Our bus on a device of the kernel's CAN framework that has a transmit queue, error states and a carrier.

The kernel's serial-line driver (slcan) plays the adapter, and this test the adapter's firmware at the far end of a
pseudo-terminal: it reads what goes out on the line, and reports states as linux/drivers/net/can/slcan expects them.
"""

from __future__ import annotations

import ctypes
import fcntl
import os
import pty
import struct
import subprocess
import time
import tty
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from can_dbc.bus.base import Bus, BusState
from can_dbc.bus.factory import open_bus
from can_dbc.frame import Frame

SYS_FINIT_MODULE = 313  # x86-64
TIOCSETD, SIOCGIFNAME, N_SLCAN = 0x5423, 0x8910, 17
QUEUE = 10
PATIENCE = 2000


class Adapter:
    """The far end of the serial line."""

    def __init__(self, link: str, line: int) -> None:
        self.link = link
        self._line = line
        self._out = b""

    def report(self, state: str, rx_errors: int = 0, tx_errors: int = 0) -> None:
        """Tells the driver of a state: a(ctive), w(arning), p(assive), b(us-off)."""
        os.write(self._line, f"s{state}{rx_errors:03d}{tx_errors:03d}\r".encode())

    def hear(self, text: str) -> None:
        """A frame from the bus, as the serial line writes it: ``t`` and three digits, length, bytes in hexadecimal."""
        os.write(self._line, f"{text}\r".encode())

    def said(self) -> list[str]:
        """The frames that went out on the line since the last call."""
        while True:
            try:
                self._out += os.read(self._line, 1 << 16)
            except BlockingIOError:
                break
        *lines, self._out = self._out.split(b"\r")
        return [line.decode() for line in lines if line[:1] in b"tT"]


@pytest.fixture
def adapter() -> Iterator[Adapter]:
    load_slcan()
    near, far = pty.openpty()
    for end in (near, far):
        tty.setraw(end)
    os.set_blocking(near, False)
    fcntl.ioctl(far, TIOCSETD, struct.pack("i", N_SLCAN))
    link = fcntl.ioctl(far, SIOCGIFNAME, bytes(40))[:16].rstrip(b"\0").decode()
    ip("link", "set", link, "txqueuelen", str(QUEUE))
    ip("link", "set", link, "up")
    adapter = Adapter(link, near)
    adapter.said()
    yield adapter
    os.close(near)
    os.close(far)


def load_slcan() -> None:
    if os.environ["TIMBERHAND_LAB"] != "uml":
        pytest.skip("loading a driver into this machine's own kernel is not for tests")
    module = Path(f"/usr/lib/uml/modules/{os.uname().release}/kernel/drivers/net/can/slcan/slcan.ko")
    if not module.exists():
        pytest.skip("the lab's own kernel has no slcan")
    if os.geteuid() != 0:
        pytest.skip("loading a driver needs root: timberhand hil vcan --root -- pytest tests/live/vcan")
    with module.open("rb") as file:
        ctypes.CDLL(None).syscall(SYS_FINIT_MODULE, file.fileno(), b"", 0)  # a second time it is there already


def ip(*arguments: str) -> None:
    subprocess.run(["ip", *arguments], check=True)


def wait(what: str, happened: Callable[[], object]) -> None:
    for _ in range(PATIENCE):
        if happened():
            return
        time.sleep(0.001)
    raise AssertionError(f"never: {what}")


def test_a_full_queue_refuses_at_once_and_nothing_is_sent_later(adapter: Adapter) -> None:
    """The line stands still, so the kernel's queue fills and the next frame meets ENOBUFS."""
    with open_bus(f"socketcan:{adapter.link}") as bus:
        frames = [(0x100 + i, b"") for i in range(3 * QUEUE)]
        taken = bus.send_all(frames)
        assert QUEUE <= taken < 2 * QUEUE
        assert not bus.send(0x200, b"")
        assert (bus.stats.sent, bus.stats.refused) == (taken, 3 * QUEUE - taken + 1)
        assert bus.stats.state is BusState.ACTIVE
        said: list[str] = []
        wait("the queue empties", lambda: said.extend(adapter.said()) or len(said) >= taken)
        assert bus.send(0x300, b"")
        wait("the last frame goes out", lambda: said.extend(adapter.said()) or len(said) > taken)
        assert said == [f"t{key:03X}0" for key, _ in [*frames[:taken], (0x300, b"")]]


def state_becomes(bus: Bus, state: BusState) -> None:
    wait(f"the state becomes {state.name}", lambda: bus.drain([]) or bus.stats.state is state)


def test_states_of_the_can_controller_are_reported_with_their_counters(adapter: Adapter) -> None:
    with open_bus(f"socketcan:{adapter.link}") as bus:
        for state, wanted, errors in (
            ("w", BusState.WARNING, 100),
            ("p", BusState.PASSIVE, 130),
            ("a", BusState.ACTIVE, 5),
        ):
            adapter.report(state, tx_errors=errors)
            state_becomes(bus, wanted)
            assert bus.stats.tx_errors == errors
        assert (bus.stats.error_frames, bus.stats.recoveries) == (3, 0)


def test_bus_off_refuses_frames_and_drops_the_queue(adapter: Adapter) -> None:
    """Without restart-ms the link has to be set down and up; the kernel empties its queue, we read anew."""
    with open_bus(f"socketcan:{adapter.link}") as bus, open_bus(f"socketcan:{adapter.link}") as other:
        bus.send_all([(0x100 + i, b"") for i in range(QUEUE)])
        adapter.hear("t1812AABB")
        wait("a frame comes in", lambda: other.drain([]))
        adapter.report("b")
        state_becomes(other, BusState.OFF)
        bus.drain([])
        assert bus.stats.state is BusState.OFF
        assert not bus.send(0x200, b"") and not bus.reopen()
        adapter.hear("t1812CCDD")
        ip("link", "set", adapter.link, "down")
        state_becomes(bus, BusState.DOWN)
        assert len(adapter.said()) < QUEUE  # the rest waited in the kernel
        ip("link", "set", adapter.link, "up")
        wait("the link comes back", bus.reopen)
        assert (bus.stats.state, bus.stats.recoveries) == (BusState.ACTIVE, 1)
        adapter.hear("t1812EEFF")
        frames: list[Frame] = []
        wait("a frame comes in", lambda: bus.drain(frames))
        assert [(frame.key, frame.data) for frame in frames] == [(0x181, b"\xee\xff")]
        assert bus.send(0x300, b"")
        said: list[str] = []
        wait("a frame goes out", lambda: said.extend(adapter.said()) or said)
        assert said == ["t3000"]


def test_a_link_that_is_up_but_bus_off_is_not_back(adapter: Adapter) -> None:
    """It takes frames and loses them in silence."""
    with open_bus(f"socketcan:{adapter.link}") as early, open_bus(f"socketcan:{adapter.link}") as late:
        ip("link", "set", adapter.link, "down")
        for bus in (early, late):
            state_becomes(bus, BusState.DOWN)
        ip("link", "set", adapter.link, "up")
        wait("the link comes back", early.reopen)
        adapter.report("b")
        state_becomes(early, BusState.OFF)
        operation = Path("/sys/class/net", adapter.link, "operstate")
        wait("the kernel says that it does not run", lambda: operation.read_text() == "down\n")
        assert not late.reopen() and late.stats.state is BusState.DOWN


def test_the_automatic_recovery_of_an_adapter_is_recognized(adapter: Adapter) -> None:
    with open_bus(f"socketcan:{adapter.link}") as bus:
        adapter.report("b")
        state_becomes(bus, BusState.OFF)
        adapter.report("a")
        state_becomes(bus, BusState.ACTIVE)
        assert bus.stats.recoveries == 1
