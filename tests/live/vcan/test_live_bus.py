"""The features of the kernel's CAN that timberhand relies on: frames, filters, python-can, processes on two buses."""

from __future__ import annotations

import os
import select
import socket
import struct
import subprocess
import sys
import time
from pathlib import Path

import can
import pytest

from can_dbc.bus.base import Bus
from can_dbc.bus.factory import default_address, open_bus
from can_dbc.frame import EXTENDED, Frame
from controller.guard.can_socket import GuardSocket

RAW = struct.Struct("=IB3x8s")
TIMEOUT_S = 10.0
CYCLE_NS = 5_000_000


def wait_for(bus: Bus, count: int) -> list[Frame]:
    frames: list[Frame] = []
    while len(frames) < count:
        assert select.select([bus.fileno()], [], [], TIMEOUT_S)[0], f"{len(frames)} of {count} frames arrived"
        bus.drain(frames)
    return frames


def test_logical_buses_map_to_their_interfaces(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("TIMBERHAND_CRANE0", "TIMBERHAND_MACH0"):
        monkeypatch.delenv(name, raising=False)
    present = {name for _, name in socket.if_nameindex()}
    for logical, stand_in in (("crane0", "vcan0"), ("mach0", "vcan1")):
        assert default_address(logical) == f"socketcan:{logical if logical in present else stand_in}"


def test_the_two_interfaces_are_two_buses() -> None:
    with open_bus("socketcan:vcan0") as crane, open_bus("socketcan:vcan1") as mach:
        with open_bus("socketcan:vcan0") as sender:
            assert sender.send(0x181, b"crane")
        with open_bus("socketcan:vcan1") as sender:
            assert sender.send(0x18F00400 | EXTENDED, b"mach")
        assert [(f.key, f.data) for f in wait_for(crane, 1)] == [(0x181, b"crane")]
        assert [(f.key, f.data) for f in wait_for(mach, 1)] == [(0x18F00400 | EXTENDED, b"mach")]


@pytest.mark.parametrize("extended", [False, True])
def test_python_can_and_our_bus_read_each_other(extended: bool) -> None:
    key = 0x123 | EXTENDED if extended else 0x123
    with can.Bus(interface="socketcan", channel="vcan0") as theirs, open_bus("socketcan:vcan0") as ours:
        theirs.send(can.Message(arbitration_id=0x123, is_extended_id=extended, data=b"to us"))
        assert [(f.key, f.data) for f in wait_for(ours, 1)] == [(key, b"to us")]
        assert ours.send(key, b"to them")
        message = theirs.recv(TIMEOUT_S)
        assert message is not None
        assert (message.arbitration_id, message.is_extended_id, bytes(message.data)) == (0x123, extended, b"to them")


def test_the_guards_own_socket_hears_what_it_watches_and_not_itself() -> None:
    watched = (0x181, 0x18F00400 | EXTENDED)
    with GuardSocket("vcan0", watched) as guard, open_bus("socketcan:vcan0") as ours:
        before_ns = time.monotonic_ns()
        for key in (0x182, 0x181, 0x0CF00400 | EXTENDED, 0x18F00400 | EXTENDED):
            assert ours.send(key, b"12345")
        after_ns = time.monotonic_ns()
        assert guard.send_all([(0x181, b"own"), (0x77D, b"\x05")]) == 2
        frames = wait_for(guard, 2)
        assert [(f.key, f.data) for f in frames] == [(key, b"12345") for key in watched]
        assert all(before_ns - CYCLE_NS <= f.stamp_ns <= after_ns + 4 * CYCLE_NS for f in frames)
        assert [(f.key, f.data) for f in wait_for(ours, 2)] == [(0x181, b"own"), (0x77D, b"\x05")]
        assert guard.drain([]) == 0


def test_the_kernel_sends_a_cyclic_frame_by_itself() -> None:
    """BCM (linux/can/bcm.h): TX_SETUP with SETTIMER, STARTTIMER; one frame every cycle without a process."""
    with socket.socket(socket.AF_CAN, socket.SOCK_DGRAM, socket.CAN_BCM) as bcm, open_bus("socketcan:vcan0") as bus:
        bcm.connect(("vcan0",))
        head = struct.pack("@IIIllllII0q", socket.CAN_BCM_TX_SETUP, 3, 0, 0, 0, 0, CYCLE_NS // 1000, 0x77, 1)
        bcm.send(head + RAW.pack(0x77, 2, b"hb"))
        frames = wait_for(bus, 20)
    assert {(f.key, f.data) for f in frames} == {(0x77, b"hb")}
    assert frames[19].stamp_ns - frames[0].stamp_ns > 15 * CYCLE_NS


def test_an_ordinary_user_gets_fifo_and_locked_memory() -> None:
    """The controller asks for both."""
    if os.environ["TIMBERHAND_LAB"] != "uml":
        pytest.skip("only the lab's own kernel grants it to everybody")
    script = (
        "import ctypes, os; os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(80));"
        "raise SystemExit(ctypes.CDLL(None).mlockall(3))"
    )
    user = {"user": 65534, "group": 65534, "extra_groups": []} if os.geteuid() == 0 else {}
    python = "/usr/bin/python3"
    if not Path(python).exists():
        pytest.skip("no Python that every user may run")
    subprocess.run([python, "-ISB", "-c", script], check=True, cwd="/", **user)


ANSWERER = """
import sys
from can_dbc.bus.factory import open_bus
import select
with open_bus("socketcan:vcan0", filters=[0x80, 0x7FF]) as bus:
    print("ready", flush=True)
    while True:
        select.select([bus.fileno()], [], [])
        frames = []
        bus.drain(frames)
        for frame in frames:
            if frame.key == 0x7FF:
                sys.exit(0)
            for node in range(6):
                bus.send(0x181 + node, frame.data)
"""


def test_every_sync_is_answered_by_another_process() -> None:
    """200 SYNCs of a 200 Hz loop, six answers each: none lost, none twice, in order."""
    cycles = 200
    answerer = subprocess.Popen([sys.executable, "-c", ANSWERER], stdout=subprocess.PIPE)
    assert answerer.stdout and answerer.stdout.readline() == b"ready\n"
    frames: list[Frame] = []
    with open_bus("socketcan:vcan0") as bus:
        deadline_ns = time.monotonic_ns()
        for cycle in range(cycles):
            deadline_ns += CYCLE_NS
            time.sleep(max(0, deadline_ns - time.monotonic_ns()) / 1e9)
            bus.drain(frames)
            assert bus.send(0x80, struct.pack("<I", cycle))
        while len(frames) < 6 * cycles:
            frames += wait_for(bus, 1)
        bus.send(0x7FF, b"")
    assert answerer.wait(TIMEOUT_S) == 0
    expected = [(0x181 + node, struct.pack("<I", cycle)) for cycle in range(cycles) for node in range(6)]
    assert [(f.key, f.data) for f in frames] == expected


@pytest.mark.parametrize("tool", ["candump", "cansend"])
def test_can_utils_exchange_frames_with_our_bus(tool: str) -> None:
    try:
        with open_bus("socketcan:vcan0") as bus:
            if tool == "cansend":
                subprocess.run(["cansend", "vcan0", "1FD#0011"], check=True)
                assert [(f.key, f.data) for f in wait_for(bus, 1)] == [(0x1FD, b"\x00\x11")]
            else:
                dump = subprocess.Popen(["candump", "-L", "-n", "1", "vcan0"], stdout=subprocess.PIPE)
                while dump.poll() is None:
                    bus.send(0x1FD, b"\x00\x11")
                assert dump.stdout and dump.stdout.read().split()[1:] == [b"vcan0", b"1FD#0011"]
    except FileNotFoundError:
        pytest.skip(f"{tool} is missing (apt-get install can-utils)")


def test_soft_interrupts_outrank_every_process() -> None:
    """Frames that wait for ksoftirqd at ordinary priority come late whenever something else is busy."""
    if os.environ.get("TIMBERHAND_LAB") != "uml":
        pytest.skip("the kernel is not the lab's own")
    threads = [p for p in Path("/proc").glob("[0-9]*/comm") if p.read_text().startswith("ksoftirqd")]
    assert threads
    assert all(os.sched_getscheduler(int(p.parent.name)) == os.SCHED_FIFO for p in threads)
