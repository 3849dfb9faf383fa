"""The guard's process around its core: command line, buses, deadlines, signals and exit codes."""

from __future__ import annotations

import signal
from types import SimpleNamespace
from typing import ClassVar

import pytest

from can_dbc.bus.base import BusState
from can_dbc.frame import EXTENDED
from controller.guard import __main__ as process
from controller.guard.__main__ import build, main, profile_path
from controller.guard.guard import Guard
from controller.guard.latch_file import LatchFile, default_path
from controller.guard.verdicts import Verdict
from hil.wire.core import WireCore
from hil.wire.inprocess import InProcessBus
from runtime.errors import LinkError
from tests.controller.bench import DATABASE, MS

T = process.PERIOD_NS


class World:
    """Clock and buses of one guard process; ``until`` ticks pass before ``number`` ends it."""

    def __init__(self, until: int, number: int = signal.SIGTERM, late_ticks: dict[int, int] | None = None) -> None:
        self.now_ns, self.ticks = 10**9, 0
        self._until, self._number, self._late = until, number, late_ticks or {}
        self.cores: dict[str, WireCore] = {}
        self.heard: dict[str, InProcessBus] = {}
        self.deadlines: list[int] = []
        self.called: list[str] = []

    def open_bus(self, address: str, **options) -> InProcessBus:
        core = self.cores.setdefault(address, WireCore(1_000_000, address))
        core.advance(self.now_ns)
        self.heard.setdefault(address, InProcessBus(core, "listener"))
        return InProcessBus(core, "guard", **options)

    def sleep_until(self, deadline_ns: int) -> None:
        self.deadlines.append(deadline_ns)
        self.ticks += 1
        self.now_ns = max(self.now_ns, deadline_ns) + self._late.get(self.ticks, 0)
        for core in self.cores.values():
            core.advance(self.now_ns)
        if self.ticks == self._until:
            signal.raise_signal(self._number)

    def frames(self, address: str) -> list:
        found: list = []
        for core in self.cores.values():
            core.advance(core.now_ns + 10 * MS)
        self.heard[address].drain(found)
        return found


@pytest.fixture(autouse=True)
def handlers():
    """The process sets its own handlers; the tests get theirs back."""
    before = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT)}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


def run_guard(
    monkeypatch, world: World, *arguments: str, profile: str = "palms_471", buses=("--bus", "crane0=here")
) -> int:
    monkeypatch.setattr(process, "open_bus", world.open_bus)
    monkeypatch.setattr(process, "sleep_until", world.sleep_until)
    monkeypatch.setattr(process, "time", SimpleNamespace(monotonic_ns=lambda: world.now_ns))
    monkeypatch.setattr(process, "prepare", lambda priority: [f"FIFO {priority}"])
    for name in ("stop_garbage_collection", "keep_memory"):
        monkeypatch.setattr(process, name, lambda name=name: world.called.append(name))
    return main(["--profile", profile, *buses, *arguments])


@pytest.fixture(autouse=True)
def state(monkeypatch, tmp_path):
    """The folder of the service's state."""
    monkeypatch.setenv("STATE_DIRECTORY", str(tmp_path / "state"))
    monkeypatch.setenv("RUNTIME_DIRECTORY", str(tmp_path / "run"))
    return tmp_path / "state" / "latched"


@pytest.mark.parametrize(("number", "code"), [(signal.SIGTERM, 0), (signal.SIGINT, 130)])
def test_it_sends_its_status_every_10_ms_until_it_is_ended(monkeypatch, capsys, number, code):
    world = World(100, number)
    assert run_guard(monkeypatch, world) == code
    sent = [frame.key for frame in world.frames("here")]
    status = DATABASE.message("GuardStat").key
    assert 48 <= sent.count(status) <= 52
    assert sent.count(0x77D) == 5
    assert "FIFO 85" in capsys.readouterr().err


def test_without_real_time_it_asks_for_nothing(monkeypatch, capsys):
    assert run_guard(monkeypatch, World(3), "--no-realtime") == 0
    assert "FIFO" not in capsys.readouterr().err


def test_a_late_guard_skips_periods_and_never_catches_up(monkeypatch):
    world = World(12, late_ticks={5: 3 * T + 1 * MS, 8: T - 1})
    assert run_guard(monkeypatch, world) == 0
    gaps = [b - a for a, b in zip(world.deadlines, world.deadlines[1:], strict=False)]
    assert gaps == [T] * 4 + [4 * T] + [T] * 6


def test_its_status_text_names_verdict_and_bus(monkeypatch):
    seen = []

    class Notifier:
        def __init__(self, text) -> None:
            self._text = text

        def tick_done(self, now_ns, punctual) -> None:
            seen.append((self._text(), punctual))

        def stopping(self) -> None:
            seen.append(("stopping", True))

    monkeypatch.setattr(process, "Notifier", Notifier)
    assert run_guard(monkeypatch, World(4, late_ticks={2: 2 * T})) == 0
    assert Verdict.ESTOP_LOST.name in seen[0][0] and BusState.ACTIVE.name in seen[0][0]
    assert [punctual for _, punctual in seen] == [True, False, True, True, True]
    assert seen[-1][0] == "stopping"


def test_a_bus_that_cannot_be_opened_ends_it(monkeypatch, capsys):
    def refuses(address, **_options):
        raise LinkError("bus.no-such", f"no {address}")

    world = World(1)
    monkeypatch.setattr(world, "open_bus", refuses)
    assert run_guard(monkeypatch, world) == 4
    assert "no here" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        *((["--profile", "palms_471", "--bus", given], given) for given in ("crane1=x", "crane0=", "crane0")),
        (["--profile", "palms_471", "--bus", "crane0=here", "--rate", "-1"], "--rate -1"),
        (["--bus", "crane0=here"], "--profile"),
    ],
)
def test_a_bad_bus_or_rate_or_no_profile_is_a_usage_error(capsys, arguments, told):
    with pytest.raises(SystemExit) as ended:
        main(arguments)
    assert ended.value.code == 2 and told in capsys.readouterr().err


def test_without_an_address_it_uses_the_usual_one(monkeypatch):
    world = World(2)
    monkeypatch.setattr(process, "default_address", lambda name: f"usual {name}")
    assert run_guard(monkeypatch, world, "--no-realtime", buses=()) == 0
    assert "usual crane0" in world.cores


def test_a_profile_is_found_by_its_name_or_its_path(tmp_path):
    assert profile_path("palms_471").is_file()
    assert profile_path(str(tmp_path / "x.toml")) == tmp_path / "x.toml"


@pytest.mark.parametrize(("options", "rate_hz"), [((), 0), (("--rate", "500"), 500)])
def test_the_rate_is_that_of_the_profile_or_the_option(monkeypatch, options, rate_hz):
    asked = []
    monkeypatch.setattr(
        process, "build", lambda _path, rate_hz, latched: asked.append(rate_hz) or build(profile_path("palms_471"))
    )
    assert run_guard(monkeypatch, World(2), *options) == 0
    assert asked == [rate_hz]


def test_commands_at_another_rate_have_its_period(monkeypatch):
    monkeypatch.setattr(process, "Guard", lambda envelope, *_more: envelope)
    assert build(profile_path("palms_471")).period_ns == 5_000_000
    assert build(profile_path("palms_471"), rate_hz=1000).period_ns == 1_000_000


def test_it_keeps_its_memory_and_stops_the_collector(monkeypatch):
    world, buses = World(2), ("--bus", "crane0=here", "--bus", "mach0=there")
    assert run_guard(monkeypatch, world, "--no-realtime", profile="aoro_fc8", buses=buses) == 0
    assert world.called == ["keep_memory", "stop_garbage_collection"] and set(world.cores) == {"here", "there"}


def test_a_tick_judges_what_both_buses_have_brought_and_watches_them(monkeypatch):
    brought = {"crane0": [[(1, 0x181, b"a")], [(2, 0x182, b"b")], []], "mach0": [[], [(3, 0x8CFF_0000, b"c")], []]}
    judged, watched, sent = [], [], []

    class Link:
        def __init__(self, bus: str) -> None:
            self.bus = bus

        def receive(self, frames, _reading) -> None:
            frames[:] = brought[self.bus].pop(0)

        def send(self, frames) -> None:
            sent.append((self.bus, frames))

        def watch(self, now_ns) -> None:
            watched.append((self.bus, now_ns))

    class Judge:
        latched = True
        pressed: ClassVar[list[int]] = []

        def hear(self, action, _now_ns):
            self.pressed.append(action)

        def step(self, _now_ns, frames):
            judged.append(list(frames))
            return [(0x77F, b""), (0x18FF_0000 | EXTENDED, b"")]

    ended, deadlines, punctual = [], [], []

    def sleep_until(deadline_ns) -> None:
        deadlines.append(deadline_ns)
        clock[0] = deadline_ns + (T if len(deadlines) == 2 else 0)
        if len(deadlines) == 3:
            ended.append(signal.SIGTERM)

    clock = [0]
    monkeypatch.setattr(process, "BusLink", Link)
    monkeypatch.setattr(process, "sleep_until", sleep_until)
    monkeypatch.setattr(process, "time", SimpleNamespace(monotonic_ns=lambda: clock[0]))
    notifier = SimpleNamespace(tick_done=lambda _now, in_time: punctual.append(in_time), stopping=lambda: None)
    kept = []
    operator = SimpleNamespace(receive=lambda now_ns: [now_ns // T])
    process.run(Judge(), ["crane0", "mach0"], ended, notifier, SimpleNamespace(keep=kept.append), operator)
    assert kept == [True] * 3 and Judge.pressed == [1, 3, 4], "at the time at which it woke"
    assert judged == [[(1, 0x181, b"a")], [(2, 0x182, b"b"), (3, 0x8CFF_0000, b"c")], []]
    assert [bus for bus, _ in watched] == ["crane0", "mach0"] * 3
    assert sent[:2] == [("crane0", [(0x77F, b"")]), ("mach0", [(0x18FF_0000 | EXTENDED, b"")])]
    assert deadlines == [T, 2 * T, 4 * T], "a whole period late: that period is left out"
    assert punctual == [True, False, True]


def test_the_latch_survives_the_process_until_a_person_resets_it(monkeypatch, capsys, state):
    world = World(20)
    assert run_guard(monkeypatch, world) == 0 and not state.exists(), "nothing has happened"
    world = World(20)
    world.sleep_before = world.sleep_until

    def meet_another_guard(deadline_ns: int) -> None:
        world.sleep_before(deadline_ns)
        if world.ticks == 10:
            world.heard["here"].send(DATABASE.message("GuardStat").key, bytes(8))

    world.sleep_until = meet_another_guard
    assert run_guard(monkeypatch, world) == 0 and state.exists()
    latched = []
    monkeypatch.setattr(process, "Guard", lambda *given: latched.append(given[2]) or Guard(*given))
    assert run_guard(monkeypatch, World(20)) == 0 and latched == [True]
    assert state.exists(), "nobody has pressed reset"


def test_a_latch_that_cannot_be_kept_stops_the_start(monkeypatch, capsys, tmp_path):
    (tmp_path / "file").touch()
    assert run_guard(monkeypatch, World(3), "--state", str(tmp_path / "file" / "latched")) == 3
    assert "--state" in capsys.readouterr().err


def test_a_latch_file_is_there_while_the_guard_is_latched(tmp_path, capsys):
    latch = LatchFile(tmp_path / "new" / "latched")
    assert not latch.latched
    for latched in (False, True, True, False, True):
        latch.keep(latched)
        assert (tmp_path / "new" / "latched").exists() is latch.latched is latched
        assert LatchFile(tmp_path / "new" / "latched").latched is latched
    (tmp_path / "new" / "latched").unlink()
    (tmp_path / "new").rmdir()
    for _ in range(2):
        latch.keep(False)
        assert latch.latched, "it is tried again"
    assert capsys.readouterr().err.count("guard: ") == 1


def test_without_a_service_the_latch_is_kept_in_shared_memory(monkeypatch, tmp_path):
    monkeypatch.delenv("STATE_DIRECTORY")
    monkeypatch.setenv("RUNTIME_DIRECTORY", str(tmp_path))
    assert default_path() == tmp_path / "guard.latched"


def test_its_socket_for_the_operator_is_removed_at_the_end(monkeypatch, tmp_path):
    assert run_guard(monkeypatch, World(3)) == 0
    assert not any((tmp_path / "run-guard").iterdir())
