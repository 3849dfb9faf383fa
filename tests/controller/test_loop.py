"""The shell: deadlines, skipping, datagrams, records, the way out; with a bus in memory and a clock of its own."""

import json
import socket

import pytest
from bench import DATABASE, MS, SETTINGS, Bench, T
from hypothesis import given
from hypothesis import strategies as st

from can_dbc import tick_record
from can_dbc.bus import BusState, BusStats
from can_dbc.setpoint import OperatorAction, OperatorCommand, StateReport, decode, encode
from controller.__main__ import address, listen, main, parser
from controller.config import ConfigError, load
from controller.loop import BUS_GONE_NS, Histogram, Loop
from controller.realtime import sleep_until
from controller.step import Controller
from machine.faults import Reason


class MemoryBus:
    def __init__(self):
        self.name, self.stats = "memory", BusStats()
        self.waiting, self.sent = [], []
        self.closed = False

    def fileno(self):
        return -1

    def drain(self, frames):
        frames.extend(self.waiting)
        n = len(self.waiting)
        self.waiting.clear()
        return n

    def send(self, key, data):
        self.sent.append((key, data))
        return True

    def close(self):
        self.closed = True


class Clock:
    """A clock that wakes late by what the script says, in ns."""

    def __init__(self, lateness=()):
        self.now_ns = 10**9
        self.lateness = list(lateness)
        self.deadlines = []

    def time(self):
        return self.now_ns

    def sleep(self, deadline_ns):
        self.deadlines.append(deadline_ns)
        late_ns = self.lateness.pop(0) if self.lateness else 0
        self.now_ns = max(self.now_ns, deadline_ns) + late_ns


@pytest.fixture
def udp():
    made = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(3)]
    for s in made:
        s.bind(("127.0.0.1", 0))
        s.settimeout(2)
    made[0].setblocking(False)
    yield made
    for s in made:
        s.close()


def build(udp, clock, bus=None):
    setpoints, reports, record = udp
    return Loop(
        Controller(SETTINGS, DATABASE), bus or MemoryBus(), setpoints, [reports.getsockname()], record.getsockname(), T,
        clock.time, clock.sleep,
    )  # fmt: skip


def run(loop, clock, ticks):
    sleep = clock.sleep

    def counted(deadline_ns):
        sleep(deadline_ns)
        if len(clock.deadlines) >= ticks:
            loop.stop()

    loop._sleep = counted
    loop.run()


def test_absolute_deadlines_skip_and_never_burst(udp):
    clock = Clock([0, 1 * MS, 12 * MS, 0, 0])
    loop = build(udp, clock)
    run(loop, clock, 5)
    first = 10**9 + T
    assert clock.deadlines == [first, first + T, first + 2 * T, first + 5 * T, first + 6 * T]
    assert loop.missed == 2 and loop.work.count == 5
    assert loop.lateness.longest_ns == 12 * MS
    record = [tick_record.decode(udp[2].recv(65535)) for _ in range(5)]
    assert [r.now_ns for r in record] == [first, first + T, first + 4 * T, first + 5 * T, first + 6 * T]
    assert [r.late_ns for r in record] == [0, 1 * MS, 12 * MS, 0, 0]
    assert [r.missed_ticks for r in record] == [0, 0, 2, 2, 2]


def test_records_hold_frames_datagrams_outputs_and_reports(udp):
    clock, bus = Clock(), MemoryBus()
    loop = build(udp, clock, bus)
    frame = Bench()
    frame.tick()
    bus.waiting = list(frame.inputs.frames)
    udp[1].sendto(b"hello", udp[0].getsockname())
    outputs = loop.tick(10**9, 0)
    assert bus.sent == outputs.frames
    record = tick_record.decode(udp[2].recv(65535))
    assert record.frames_in == tuple(frame.inputs.frames) and record.datagrams == (b"hello",)
    assert record.frames_out == tuple(outputs.frames) and record.report == outputs.report
    report = decode(udp[1].recv(2048))
    assert isinstance(report, StateReport) and report.refused == 1
    assert report.refusal == Reason.DATAGRAM_LENGTH


@pytest.mark.parametrize("how", ["stop", "exception"])
def test_neutral_and_disarmed_whatever_the_way_out(udp, how):
    clock, bus = Clock(), MemoryBus()
    loop = build(udp, clock, bus)
    loop.controller = Bench().active().controller
    if how == "exception":
        loop._sleep = lambda _deadline: (_ for _ in ()).throw(KeyboardInterrupt)
        with pytest.raises(KeyboardInterrupt):
            loop.run()
    else:
        run(loop, clock, 3)
    a, b, status = (DATABASE.message(n) for n in ("ValveCmdA", "ValveCmdB", "CtrlStatus"))
    assert [key for key, _ in bus.sent[-3:]] == [a.key, b.key, status.key]
    last_a, last_b = a.named(a.decode(bus.sent[-3][1])), b.named(b.decode(bus.sent[-2][1]))
    assert [last_a[s] for s in ("Mode", "Slew", "Lift", "Tilt", "Ext")] == [0] * 5
    assert last_b["ArmKey"] == last_b["Rot"] == last_b["Grapple"] == 0
    assert last_b["GrappleMode"] in (0, 3), "neutral or hold"
    loop.close()
    assert bus.closed


def test_a_link_that_stays_down_ends_the_loop_and_a_short_one_does_not(udp):
    clock, bus = Clock(), MemoryBus()
    loop = build(udp, clock, bus)
    now_ns = 10**9
    for state, ticks in ((BusState.DOWN, 30), (BusState.ACTIVE, 1), (BusState.DOWN, 30)):
        bus.stats.state = state
        for _ in range(ticks):
            now_ns += T
            loop.tick(now_ns, 0)
    assert not loop.bus_lost
    for _ in range(BUS_GONE_NS // T):
        now_ns += T
        loop.tick(now_ns, 0)
    assert loop.bus_lost and loop.stopping


def test_a_flood_of_datagrams_does_not_hold_the_tick(udp):
    loop = build(udp, Clock())
    command = encode(OperatorCommand(1, SETTINGS.profile_hash, 10**9, OperatorAction.STOP))
    for _ in range(40):
        udp[1].sendto(command, udp[0].getsockname())
    loop.tick(10**9, 0)
    assert len(loop._inputs.datagrams) == 16


@given(st.lists(st.integers(-1000, 20 * MS), min_size=1, max_size=200))
def test_histogram_quantiles(durations):
    made = Histogram()
    for d in durations:
        made.add(d)
    assert sum(made.bins) == made.count == len(durations)
    ordered = sorted(max(d, 0) for d in durations)
    median = ordered[max(0, -(-len(ordered) // 2) - 1)]
    if max(durations) > 0 and median < 10 * MS:
        assert abs(made.quantile_ns(0.5) - median) <= Histogram.BIN_NS
    assert set(made.summary()) == {"p50_us", "p99_us", "p999_us", "max_us"}


def test_histogram_of_nothing():
    assert Histogram().quantile_ns(0.99) == 0


def test_sleep_until_the_past_returns_and_the_future_is_reached():
    import time

    sleep_until(0)
    until_ns = time.monotonic_ns() + 3 * MS
    sleep_until(until_ns)
    assert time.monotonic_ns() >= until_ns


def test_start_errors_have_their_code_and_one_sentence(capsys, tmp_path):
    assert main(["--profile", "nowhere", "--setpoint-port", "0", "--bus", "crane0=wire:none"]) == 3
    assert main(["--profile", "palms_471", "--setpoint-port", "0", "--bus", "crane0=wire:none"]) == 4
    assert main(["--profile", "palms_471", "--setpoint-port", "0", "--rate", "7"]) == 3
    key = tmp_path / "key"
    key.write_bytes(b"short")
    assert main(["--profile", "palms_471", "--setpoint-port", "0", "--key-file", str(key)]) == 3
    assert main(["--profile", "palms_471", "--setpoint-port", "0", "--key-file", str(key) + "x"]) == 3
    for arguments in (["--bus", "mach0=x"], ["--report", "nowhere"], ["--guard-not-needed"]):
        with pytest.raises(SystemExit) as stopped:
            main(["--profile", "palms_471", "--setpoint-port", "0", *arguments])
        assert stopped.value.code == 2
    errors = [line for line in capsys.readouterr().err.splitlines() if line.startswith("controller: ")]
    assert len(errors) == 5


def test_a_busy_port_is_one_sentence_and_exit_4(capsys, udp):
    port = udp[0].getsockname()[1]
    arguments = ["--profile", "palms_471", "--setpoint-port", str(port), "--bus", "crane0=virtual:busy"]
    assert main(arguments) == 4
    assert f"UDP port {port} cannot be used" in capsys.readouterr().err


def test_the_setpoint_socket_is_on_loopback_only():
    with listen(0) as made:
        assert made.getsockname()[0] == "127.0.0.1"


def test_addresses_and_settings():
    assert address("127.0.0.1:5006") == ("127.0.0.1", 5006)
    assert parser().parse_args(["--profile", "x", "--setpoint-port", "1"]).report == []
    assert load("palms_471", 100).period_ns == 10 * MS
    with pytest.raises(ConfigError, match="Hz"):
        load("palms_471", 2000)


def test_main_runs_and_ends_by_signal(capsys, monkeypatch):
    """One short life on an in-memory bus; SIGTERM after some ticks."""
    import signal

    from controller import loop as loop_module

    ticks = []
    original = loop_module.Loop.tick

    def tick(self, now_ns, late_ns):
        ticks.append(now_ns)
        if len(ticks) == 5:
            signal.raise_signal(signal.SIGTERM)
        return original(self, now_ns, late_ns)

    handlers = {n: signal.getsignal(n) for n in (signal.SIGTERM, signal.SIGINT)}
    monkeypatch.setattr(loop_module.Loop, "tick", tick)
    arguments = ["--profile", "palms_471", "--setpoint-port", "0", "--bus", "crane0=virtual:life", "--no-realtime"]
    try:
        assert main(arguments) == 0
    finally:
        import gc

        gc.unfreeze()
        gc.enable()
        for number, handler in handlers.items():
            signal.signal(number, handler)
    captured = capsys.readouterr()
    assert json.loads(captured.out)["ticks"] == 5
    assert "palms_471 at 200 Hz on virtual:life" in captured.err
