"""What systemd is told by the control processes, over a real socket of the kind that systemd gives."""

from __future__ import annotations

import gc
import itertools
import os
import socket
import tracemalloc
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from pathlib import Path

import pytest

from can_dbc.bus.base import BusState
from controller.config import load
from controller.guard.__main__ import build, profile_path
from controller.guard.__main__ import run as run_guard
from controller.guard.latch_file import LatchFile
from controller.guard.operator import OperatorActions
from controller.process.loop import Loop
from controller.process.timing import LoopTiming
from controller.process.warm_up import NullBus, warm_up
from controller.step import Controller
from machine.status.modes import Mode
from runtime.notifier import Notifier
from tests.codes import numbers_in
from tests.operator_end import udp_end

MS = 1_000_000
T = 5 * MS
START = 10**9


class Systemd:
    """The listening end of NOTIFY_SOCKET."""

    def __init__(self, address: str) -> None:
        self.socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self.socket.bind(address)
        self.socket.setblocking(False)

    def heard(self) -> list[dict[str, str]]:
        """Every datagram that waits, as its assignments."""
        found = []
        while True:
            try:
                data = self.socket.recv(4096)
            except BlockingIOError:
                return found
            found.append(dict(line.split("=", 1) for line in data.decode().split("\n")))


@pytest.fixture(params=["path", "abstract"])
def systemd(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Systemd]:
    name = str(tmp_path / "notify") if request.param == "path" else f"@timberhand-test-{os.getpid()}"
    monkeypatch.setenv("NOTIFY_SOCKET", name)
    made = Systemd(name.replace("@", "\0", 1) if name.startswith("@") else name)
    yield made
    made.socket.close()


class SilentBus(NullBus):
    """Keeps what it is given and brings nothing."""

    def __init__(self) -> None:
        super().__init__("memory")
        self.sent: list[tuple[int, bytes]] = []
        self.at_send: Callable[[], None] = lambda: None

    def send_all(self, frames: Sequence[tuple[int, bytes]]) -> int:
        self.at_send()
        self.sent += frames
        return len(frames)


@pytest.fixture
def loop() -> Iterator[Loop]:
    port = udp_end()
    settings = load("palms_471")
    controller = Controller(settings)
    made = Loop(
        controller,
        [SilentBus()],
        port,
        None,
        [],
        None,
        LoopTiming(controller, clock_ns=lambda: START),
        settings.period_ns,
        settings.sync_lead_ns,
        clock_ns=lambda: START,
    )
    yield made
    made.close()


def test_nothing_is_said_before_the_first_good_tick(systemd: Systemd) -> None:
    notifier = Notifier(lambda: "well")
    notifier.tick_done(START, False)
    assert systemd.heard() == []
    notifier.tick_done(START + T, True)
    assert systemd.heard() == [{"READY": "1", "WATCHDOG": "1", "STATUS": "well"}]


def test_alive_ten_times_and_status_once_a_second(systemd: Systemd) -> None:
    asked = []
    notifier = Notifier(lambda: asked.append("well") or asked[-1])
    heard = []
    for tick in range(401):
        notifier.tick_done(START + tick * T, True)
        heard += systemd.heard()
    assert len(heard) == 21 and all(h["WATCHDOG"] == "1" for h in heard)
    assert [i for i, h in enumerate(heard) if "STATUS" in h] == [0, 10, 20]
    assert ["READY" in h for h in heard] == [True] + [False] * 20
    assert len(asked) == 3, "the words are asked for only when they are told"


def test_bad_ticks_starve_the_watchdog(systemd: Systemd) -> None:
    notifier = Notifier(lambda: "well")
    notifier.tick_done(START, True)
    systemd.heard()
    for tick in range(1, 200):
        notifier.tick_done(START + tick * T, False)
    assert systemd.heard() == []


def test_ready_is_repeated_until_it_was_taken(systemd: Systemd, monkeypatch: pytest.MonkeyPatch) -> None:
    """A full queue of systemd must not leave the unit starting for ever."""
    notifier = Notifier(lambda: "well")
    tell = Notifier._send
    monkeypatch.setattr(Notifier, "_send", lambda self, what: False)
    notifier.tick_done(START, True)
    monkeypatch.setattr(Notifier, "_send", tell)
    notifier.tick_done(START + T, True)
    assert [h.get("READY") for h in systemd.heard()] == ["1"]


def test_without_systemd_or_with_a_dead_one_nothing_happens(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.delenv("NOTIFY_SOCKET", raising=False)
    quiet = Notifier(lambda: pytest.fail("asked for words that nobody hears"))
    quiet.tick_done(START, True)
    quiet.stopping()
    monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "nobody"))
    dead = Notifier(lambda: "well")
    dead.tick_done(START, True)
    dead.stopping()


def test_the_loop_is_ready_with_its_first_tick_and_says_why_it_stands(systemd: Systemd, loop: Loop) -> None:
    assert systemd.heard() == [], "not in the constructor"
    loop.tick(START, 0)
    (first,) = systemd.heard()
    assert first["READY"] == "1" and first["WATCHDOG"] == "1"
    mode, sentence, *_ = first["STATUS"].split(". ")
    assert (mode, numbers_in(sentence)) == ("BOOT", [2])
    assert numbers_in(first["STATUS"])[-2:] == [0, 1], "missed ticks of all"


@pytest.mark.parametrize("why", ["late", "long"])
def test_a_tick_that_is_not_good_is_not_alive(systemd: Systemd, loop: Loop, why: str) -> None:
    now_ns = START
    if why == "long":
        loop.timing._clock_ns = itertools.count(START, T).__next__
    for _ in range(30):
        now_ns += T
        loop.tick(now_ns, T if why == "late" else 0)
    assert systemd.heard() == []


def test_a_controller_without_a_bus_is_alive_and_says_so(systemd: Systemd, loop: Loop) -> None:
    (bus,) = loop.buses
    bus.stats.state = BusState.DOWN
    loop.controller.supervisor.mode = Mode.ARMED
    heard: list[dict[str, str]] = []
    for tick in range(500):
        loop.tick(START + tick * T, 0)
        heard += systemd.heard()
    assert len(heard) == 25 and all(h["WATCHDOG"] == "1" for h in heard)
    status = [h["STATUS"] for h in heard if "STATUS" in h][-1]
    assert status.startswith(Mode.FAULT.name) and "memory" in status and BusState.DOWN.name in status


def test_a_rehearsal_is_nobodys_business(systemd: Systemd) -> None:
    """Systemd would take its farewell for the end of the service."""
    settings = load("palms_471")
    warm_up(settings, Controller(settings))
    assert systemd.heard() == []
    assert Notifier(lambda: "well")._socket is not None, "and the controller itself still speaks"


def test_neutral_first_and_then_stopping(systemd: Systemd, loop: Loop) -> None:
    loop.tick(START, 0)
    systemd.heard()
    (bus,) = loop.buses
    bus.at_send = lambda: said.extend(systemd.heard())
    said: list[dict[str, str]] = []
    loop.shut_down()
    assert said == [], "nothing is said before the last frame"
    assert systemd.heard() == [{"STOPPING": "1", "STATUS": "Ending."}]


@pytest.mark.long
def test_ten_seconds_of_ticks_leaves_no_garbage(systemd: Systemd, loop: Loop) -> None:
    """The collector is off in the process: a cycle per tick would eat the memory."""
    now_ns = START

    def ticks(count: int) -> None:
        nonlocal now_ns
        for _ in range(count):
            now_ns += T
            loop.tick(now_ns, 0)
            loop.buses[0].sent.clear()
            systemd.heard()

    tracemalloc.start()
    try:
        ticks(1000)
        gc.collect()
        gc.disable()
        before = tracemalloc.get_traced_memory()[0]
        ticks(2000)
        assert gc.collect() == 0, "cycles"  # and empties the free lists, as before the first look
        grown = tracemalloc.get_traced_memory()[0] - before
    finally:
        tracemalloc.stop()
        gc.enable()
    assert grown < 4096, f"{grown} bytes in 10 s"


@pytest.mark.parametrize("state", [BusState.ACTIVE, BusState.DOWN])
def test_the_guard_lives_with_a_bus_and_without_one(systemd: Systemd, state: BusState, tmp_path: Path) -> None:
    guard, bus = build(profile_path("palms_471")), SilentBus()
    bus.stats.state = state
    ended: list[int] = []
    bus.at_send = lambda: ended.append(15) if len(bus.sent) >= 10 else None
    notifier = Notifier(lambda: f"{guard.verdict.name} {bus.stats.state.name}")
    with closing(OperatorActions(tmp_path / "guard" / "operator", 0)) as operator:
        run_guard(guard, [bus], ended, notifier, LatchFile(tmp_path / "latched"), operator)
    *others, last = systemd.heard()
    assert last == {"STOPPING": "1", "STATUS": "Ending."}
    assert others[0] == {"READY": "1", "WATCHDOG": "1", "STATUS": f"ESTOP_LOST {state.name}"}
