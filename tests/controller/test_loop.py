"""The process: its loop with a bus in memory and a scripted clock (deadlines, datagrams, records), and its command."""

import mmap
import os

import msgspec
import pytest

from can_dbc.bus.base import BusState, Filter
from can_dbc.bus.reconnector import FIRST_RETRY_NS, RETRY_PERIOD_NS
from can_dbc.frame import Frame
from can_dbc.messages import operator_link
from can_dbc.messages.crane import OperatorAction, OperatorCommand, StateReport
from can_dbc.messages.datagrams import decode, encode
from can_dbc.messages.envelope import DatagramRefused, opened, signed, write_key
from can_dbc.messages.tick_record import BusReading
from can_dbc.messages.vehicle import Driving
from can_dbc.protocols.canopen import SYNC_ID
from can_dbc.timing.page import TimingWriter, read_timing
from controller.bus_io import BusMonitor
from controller.carrier.vehicle import Vehicle
from controller.config import MIN_QUEUE_FRAMES, TX_QUEUE_NS, load
from controller.process.bus_link import BusLink
from controller.process.command import main
from controller.process.loop import Loop
from controller.process.operator_socket import OperatorSocket
from controller.process.setpoint_port import DATAGRAM_BYTES, MAX_DATAGRAMS, listen
from controller.process.timing import LoopTiming, ProcessReader
from controller.process.warm_up import NullBus, warm_up
from controller.step import Controller
from hil.wire.core import WireCore
from hil.wire.faults import Fault, Kind
from hil.wire.inprocess import InProcessBus
from machine.loading.profile_file import load_profile
from machine.profile import Plc
from machine.status.reasons import Reason
from runtime.errors import LinkError
from tests.codes import coded, numbers_in
from tests.controller.bench import DATABASE, MS, SETTINGS, Bench, T

LEAD = SETTINGS.sync_lead_ns


class MemoryBus(NullBus):
    """Keeps the frames sent, and counts the tries to reopen it."""

    def __init__(self, clock=None):
        super().__init__("memory")
        self.sent, self.sent_at = [], []
        self.closed = False
        self.tries = self.flushed = 0
        self._clock = clock

    def send(self, key, data):
        self.sent.append((key, data))
        self.sent_at.append((key, self._clock.now_ns if self._clock else 0))
        return True

    def send_all(self, frames):
        for key, data in frames:
            self.send(key, data)
        return len(frames)

    def flush(self):
        self.flushed += 1
        super().flush()

    def reopen(self):
        self.tries += 1
        return False

    def close(self):
        self.closed = True


class Clock:
    """A clock that wakes late by the values of a script [ns]."""

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


def build(udp, clock, bus=None, page=None, reports=None, operator=None, key=None):
    setpoints, receiver, records = udp
    controller = Controller(SETTINGS, DATABASE)
    timing = LoopTiming(controller, TimingWriter(page) if page else None, clock.time, clock.time)
    return Loop(
        controller,
        [bus or MemoryBus()],
        setpoints,
        operator,
        [reports or receiver.getsockname()],
        records.ring,
        timing,
        T,
        LEAD,
        clock.time,
        clock.sleep,
        key=key,
    )


def run(loop, ticks):
    """Run ``ticks`` ticks, then end within a tick, as SIGTERM does."""
    tick = loop.tick

    def counted(now_ns, late_ns):
        outputs = tick(now_ns, late_ns)
        if loop.ticks >= ticks:
            loop.stop()
        return outputs

    loop.tick = counted
    loop.run()


def test_absolute_deadlines_skip_and_never_burst(udp):
    #               tick | SYNC, tick | SYNC, tick | SYNC, tick | SYNC, tick
    clock = Clock([0, 0, 1 * MS, 0, 12 * MS, 0, 0, 0, 0])
    loop = build(udp, clock)
    run(loop, 5)
    first = 10**9 + T
    ticks = [first, first + T, first + 2 * T, first + 5 * T, first + 6 * T]
    assert clock.deadlines[::2] == ticks
    assert clock.deadlines[1::2] == [tick - LEAD for tick in ticks[1:]]
    assert loop.missed == 2 and loop.ticks == 5
    assert loop.timing.wake.longest_ns == 12 * MS
    record = udp[2].read()
    assert [r.now_ns for r in record] == [first, first + T, first + 4 * T, first + 5 * T, first + 6 * T]
    assert [r.late_ns for r in record] == [0, 1 * MS, 12 * MS, 0, 0]
    assert [r.missed_ticks for r in record] == [0, 0, 2, 2, 2]


def test_cycle_is_sync_then_after_the_lead_the_commands(udp):
    clock = Clock()
    bus = MemoryBus(clock)
    run(build(udp, clock, bus), 4)
    command = DATABASE.message("ValveCmdA").key
    first = 10**9 + T
    sync_at = [at for key, at in bus.sent_at if key == SYNC_ID]
    assert sync_at == [first + k * T - LEAD for k in (1, 2, 3)]
    assert [at for key, at in bus.sent_at if key == command][:4] == [first + k * T for k in range(4)]


def test_stall_before_sync_makes_one_late_sync_and_no_more(udp):
    clock = Clock([0, 23 * MS])
    bus = MemoryBus(clock)
    loop = build(udp, clock, bus)
    run(loop, 3)
    # the stall ends 23 ms after SYNC was due: SYNC at once, then the tick that is due by then
    assert [at - 10**9 for key, at in bus.sent_at if key == SYNC_ID] == [10 * MS - LEAD + 23 * MS, 35 * MS - LEAD]
    assert loop.missed == 4 and loop.timing.sync.longest_ns == 23 * MS


def test_records_hold_frames_datagrams_outputs_and_reports(udp):
    clock, bus = Clock(), MemoryBus()
    loop = build(udp, clock, bus)
    frame = Bench()
    frame.tick()
    bus.waiting = list(frame.inputs.frames)
    udp[1].sendto(b"hello", udp[0].getsockname())
    outputs = loop.tick(10**9, 0)
    assert bus.sent == outputs.frames, "SYNC goes out later"
    record = udp[2].read()[0]
    assert record.frames_in == tuple(frame.inputs.frames) and record.datagrams == (b"hello",)
    assert record.frames_out == (*outputs.frames, outputs.sync) and record.report == outputs.report
    report = decode(udp[1].recv(2048))
    assert isinstance(report, StateReport) and report.refused == 1
    assert report.refusal == Reason.DATAGRAM_LENGTH


def test_a_flood_of_datagrams_is_taken_in_order_sixteen_in_a_tick(udp):
    loop = build(udp, Clock())
    sent = [b"%d" % i for i in range(20)] + [b"x" * (DATAGRAM_BYTES + 9)]
    for data in sent:
        udp[1].sendto(data, udp[0].getsockname())
    taken = []
    for i, wanted in enumerate((MAX_DATAGRAMS, 5, 0)):
        loop.tick(10**9 + i * T, 0)
        taken.append(udp[2].read()[0].datagrams)
        assert len(taken[-1]) == wanted
    with pytest.raises(BlockingIOError):
        udp[0].recv(DATAGRAM_BYTES)
    assert [*taken[0], *taken[1]] == [*sent[:-1], b"x" * DATAGRAM_BYTES], "what is longer is cut and refused by its CRC"


def test_process_counters_follow_the_process_on_one_descriptor():
    open_before = set(os.listdir("/proc/self/fd"))
    reader = ProcessReader()
    first = reader.read()
    kept = mmap.mmap(-1, 8 << 20)  # memory of its own: the heap may give back what it has
    for at in range(0, len(kept), mmap.PAGESIZE):
        kept[at] = 1
    second = reader.read()
    assert second.resident_kb >= first.resident_kb + 4096 and second.minor_faults > first.minor_faults
    reader.close()
    reader.close()
    kept.close()
    assert set(os.listdir("/proc/self/fd")) == open_before


@pytest.mark.parametrize("how", ["stop", "exception"])
def test_loop_always_ends_neutral_and_disarmed(udp, how):
    clock, bus = Clock(), MemoryBus()
    loop = build(udp, clock, bus)
    loop.controller = Bench().active().controller
    if how == "exception":
        loop._sleep = lambda _deadline: (_ for _ in ()).throw(KeyboardInterrupt)
        with pytest.raises(KeyboardInterrupt):
            loop.run()
    else:
        run(loop, 3)
    a, b, status = (DATABASE.message(n) for n in ("ValveCmdA", "ValveCmdB", "CtrlStatus"))
    assert [key for key, _ in bus.sent[-3:]] == [a.key, b.key, status.key]
    last_a, last_b, last = (c.named(c.decode(data)) for c, (_, data) in zip((a, b, status), bus.sent[-3:], strict=True))
    assert [last_a[s] for s in ("Mode", "Slew", "Lift", "Tilt", "Ext")] == [0] * 5
    assert last_b["ArmKey"] == last_b["Rot"] == last_b["Grapple"] == last_b["Aux"] == 0
    assert last_b["GrappleMode"] in (0, 3), "neutral or hold"
    assert last["Reason"] == Reason.CONTROLLER_ENDED
    loop.close()
    assert bus.closed


def test_lost_link_is_reopened_and_the_process_survives(udp):
    clock, bus = Clock(), MemoryBus()
    loop = build(udp, clock, bus)
    now_ns = 10**9
    bus.stats.state = BusState.DOWN

    def ticks(duration_ns):
        nonlocal now_ns
        for _ in range(duration_ns // T):
            now_ns += T
            loop.tick(now_ns, 0)

    ticks(FIRST_RETRY_NS)
    assert bus.tries == 0, "most links come back by themselves"
    ticks(T + 3 * RETRY_PERIOD_NS)
    assert bus.tries == 4 and not loop.stopping
    assert BusState.DOWN.name in loop.status_text()
    bus.stats.state = BusState.ACTIVE
    ticks(2 * RETRY_PERIOD_NS)
    assert bus.tries == 4


def test_frames_from_before_a_loss_are_discarded(udp):
    clock, bus = Clock(), MemoryBus()
    loop = build(udp, clock, bus)
    bus.stats.recoveries = 1
    bus.waiting = [Frame(10**9, DATABASE.message("EstopStat").key, bytes(8))]
    loop.tick(10**9, 0)
    assert bus.flushed == 1 and not loop._inputs.frames and loop._inputs.bus.recoveries == 1
    loop.tick(10**9 + T, 0)
    assert bus.flushed == 1


def test_timing_page_carries_the_measurements(udp, tmp_path):
    clock = Clock([0, 0, 1 * MS] + [0] * 600)
    loop = build(udp, clock, page=tmp_path / "page")
    run(loop, 202)
    timing = read_timing(tmp_path / "page")
    facts = timing.facts
    assert facts.ticks == 200 and facts.missed == facts.late == 0 and facts.period_ns == T
    assert facts.mode == "BOOT" and facts.words.startswith(facts.mode)
    assert timing.durations["wake"].count == 201 and timing.durations["wake"].over(MS - 1000) == 1
    assert timing.durations["sync"].count == timing.durations["control"].count - 1 == 200
    assert [bus.name for bus in facts.buses] == ["memory"]
    assert facts.process.allocated_blocks > 0 and facts.process.resident_kb > 0
    loop.close()
    assert not (tmp_path / "page").exists()


def test_sample_to_command_counts_from_the_sync_of_the_oldest_sample(udp):
    """One encoder answers after the tick: its value is used a period later, and is a period older."""
    clock = Clock()
    bus = MemoryBus(clock)
    loop = build(udp, clock, bus)
    encoders = [s for s in loop.controller.crane_inputs.encoders if s is not None]
    now_ns = 10**9
    found = []
    for k in range(6):
        now_ns += T
        clock.now_ns = now_ns - LEAD
        loop.timing.sync_sent(0)
        clock.now_ns = now_ns
        for i, slot in enumerate(encoders):
            slot.values = (0,) * 8
            slot.timeout_ns = 10 * T
            slot.stamp_ns = now_ns - T + MS if k >= 3 and i == 2 else now_ns - LEAD + MS
        before = loop.timing.sample_to_command.total_ns
        loop.timing.begin(0)
        loop.timing.command_sent()
        found.append(loop.timing.sample_to_command.total_ns - before)
    assert found == [LEAD] * 3 + [LEAD + T] * 3


def test_an_operators_stop_waits_behind_no_setpoint(udp, tmp_path):
    """A flood on the setpoint port fills it; the operator's command is heard in the next tick all the same."""
    operator = OperatorSocket(tmp_path / "operator")
    loop = build(udp, Clock(), operator=operator)
    for _ in range(400):
        udp[1].sendto(b"flood", udp[0].getsockname())
    stop = encode(OperatorCommand(1, SETTINGS.profile_hash, 10**9, OperatorAction.STOP))
    operator_link.send(stop, tmp_path / "operator")
    loop.tick(10**9, 0)
    (record,) = udp[2].read()
    assert record.operator == (stop,) and record.datagrams == (b"flood",) * MAX_DATAGRAMS
    loop.close()


def test_with_a_key_only_its_holder_and_stop_are_heard_and_no_record_holds_its_work(udp):
    key, hash_ = b"0123456789abcdef", SETTINGS.profile_hash
    loop = build(udp, Clock(), key=key)
    arm, stop = (encode(OperatorCommand(1, hash_, 10**9, a)) for a in (OperatorAction.ARM, OperatorAction.STOP))
    sent = [arm, signed(arm, key), signed(arm, key[::-1]), b"", b"x", stop, signed(stop, key[::-1]), signed(stop, key)]
    for data in sent:
        udp[1].sendto(data, udp[0].getsockname())
    loop.tick(10**9, 0)
    (record,) = udp[2].read()
    assert record.datagrams == (b"", arm, b"", b"", b"", stop, stop, stop)
    told = udp[1].recv(2048)
    assert opened(told, key) == record.report
    with pytest.raises(DatagramRefused):
        decode(told)


def test_reports_that_nobody_receives_are_counted(udp):
    loop = build(udp, Clock())
    udp[1].close()  # the port answers that nobody listens, and the next datagram meets that answer
    for k in range(20):
        loop.tick(10**9 + k * T, 0)
    assert loop.unsent > 0 and loop.unrecorded == 0
    loop.close()


def test_an_address_without_a_way_to_it_is_named(udp):
    with pytest.raises(LinkError, match=r"255.255.255.255:5006", check=coded("udp.unreachable")):
        build(udp, Clock(), reports=("255.255.255.255", 5006))


@pytest.mark.parametrize("profile", ["palms_471", "aoro_fc8"])
def test_warm_up_runs_every_code_path(profile, monkeypatch):
    settings = load(profile)
    controller = Controller(settings, DATABASE)
    seen, driven, worked = set(), set(), []
    apply = type(controller.supervisor)._react

    def react(supervisor, now_ns):
        seen.add(supervisor.mode.name)
        apply(supervisor, now_ns)

    monkeypatch.setattr(type(controller.supervisor), "_react", react)
    obey, law = Vehicle._command, type(controller.crane.law).step
    monkeypatch.setattr(Vehicle, "_command", lambda v, *floats: (driven.add(v.driving), obey(v, *floats)))
    monkeypatch.setattr(type(controller.crane.law), "step", lambda *a: (worked.append(1), law(*a)))
    warm_up(settings, controller)
    assert {"ARMED", "ACTIVE"} <= seen
    assert all(slot.stamp_ns for _, slot in controller.inputs_in_use), "every input has been decoded"
    assert controller.gate.refused > 100, "invalid datagrams were refused"
    assert len(worked) > 100 and (not controller.vehicle or driven == {Driving.DRIVING, Driving.BRAKING})
    assert not controller.vehicle or controller.vehicle.gate.sequence, "a drive setpoint was accepted"


@pytest.mark.parametrize("profile", ["palms_471", "aoro_fc8"])
def test_bus_filter_passes_all_inputs_and_nothing_else(profile):
    """Every message of the databases, also from another node where the source does not matter, and foreign frames."""
    controller = Controller(load(profile), DATABASE)
    crane = Filter(controller.crane_inputs.filters())
    listened = {slot.codec.key for _, slot in controller.inputs_in_use if not slot.machine}
    assert all(key in crane for key in listened)
    for node in controller.crane_inputs.nodes.by_number:
        assert {0x80 + node, 0x580 + node, 0x700 + node} <= {k for k in range(0x800) if k in crane}
    assert DATABASE.message("ValveCmdA").key in crane, "foreign frames with the controller's keys are received"
    assert 0x600 not in crane and 0x7FF not in crane
    if controller.carrier_bus is None:
        return
    machine = Filter(controller.carrier_bus.inputs.filters())
    for _, slot in controller.inputs_in_use:
        if slot.machine:
            other_source = (slot.codec.key & ~0xFF | 0x55) ^ 0x0400_0000  # and another priority
            assert slot.codec.key in machine and (other_source in machine) == slot.codec.by_pgn, slot.codec.name
    assert 0x98EEFF80 in machine and 0x98EA2780 in machine, "address claims and requests"
    assert 0x98FEDB00 not in machine


# -- the command: start errors with their exit codes, and addresses


def test_start_errors_have_their_code_and_one_sentence(capsys, tmp_path):
    good = ["--setpoint-port", "0", "--key-file", str(write_key(tmp_path / "good"))]
    assert main(["--profile", "nowhere", *good, "--bus", "crane0=wire:none"]) == 3
    assert main(["--profile", "palms_471", *good, "--bus", "crane0=wire:none"]) == 4
    assert main(["--profile", "palms_471", *good, "--rate", "7"]) == 3
    key = tmp_path / "key"
    key.write_bytes(b"short")
    assert main(["--profile", "palms_471", "--setpoint-port", "0", "--key-file", str(key)]) == 3
    assert main(["--profile", "palms_471", "--setpoint-port", "0", "--key-file", str(key) + "x"]) == 3
    for arguments in (
        [*good, "--bus", "x=wire:x"],
        [*good, "--report", "nowhere"],
        [*good, "--guard-not-needed"],
        good[:2],
    ):
        with pytest.raises(SystemExit) as stopped:
            main(["--profile", "palms_471", *arguments])
        assert stopped.value.code == 2
    palms = ["--profile", "palms_471", *good, "--bus", "crane0=virtual:start"]
    assert main([*palms, "--bus", "mach0=virtual:x"]) == 3
    assert main([*palms, "--sync-lead-us", "5000"]) == 3
    errors = [line for line in capsys.readouterr().err.splitlines() if line.startswith("controller: ")]
    assert len(errors) == 7


def test_busy_port_is_one_sentence_and_exit_4(capsys, udp, tmp_path):
    port = udp[0].getsockname()[1]
    arguments = ["--profile", "palms_471", "--setpoint-port", str(port), "--bus", "crane0=virtual:busy"]
    arguments += ["--key-file", str(write_key(tmp_path / "key"))]
    assert main(arguments) == 4
    assert port in numbers_in(capsys.readouterr().err)


def test_setpoint_socket_is_on_loopback_only():
    with listen(0) as made:
        assert made.getsockname()[0] == "127.0.0.1"


# -- what waits for a bus that transmits nothing: no command older than the queue's bound leaves afterwards

COMMANDS = (0x210, 0x310, 0x080)
"""The frames of a tick."""


class BlockedBus:
    """A controller that numbers its commands, on a bus that a babbling node occupies from 100 ms on."""

    def __init__(self, rate_hz: int, end_ns: int) -> None:
        self.period_ns = 1_000_000_000 // rate_hz
        self.core = WireCore(1_000_000)
        self.core.inject(Fault(Kind.BABBLE, 100 * MS, end_ns, key=0x000))
        self.bus = InProcessBus(self.core, "controller", tx_queue=load("palms_471", rate_hz).tx_queue_frames[0])
        self.listener = InProcessBus(self.core, "listener")
        self.link, self.reading, self.monitor = BusLink(self.bus), BusReading(), BusMonitor(0)
        self.reasons: list[tuple[int, Reason]] = []

    def run(self, until_ns: int) -> list[Frame]:
        """The commands that arrived; their data is the time of their tick."""
        arrived: list[Frame] = []
        while self.core.now_ns < until_ns:
            now_ns = self.core.now_ns
            self.link.receive([], self.reading)
            self.monitor.update(self.reading, True, now_ns)
            self.reasons.append((now_ns, self.monitor.reason))
            self.link.send([(key, now_ns.to_bytes(8, "big")) for key in COMMANDS])
            self.core.advance(now_ns + self.period_ns)
            self.listener.drain(arrived)
        return [frame for frame in arrived if frame.key in COMMANDS]

    def ages_ns(self, frames: list[Frame]) -> list[int]:
        return [frame.stamp_ns - int.from_bytes(frame.data, "big") for frame in frames]


@pytest.mark.parametrize("rate_hz", [50, 200, 1000])
@pytest.mark.parametrize("blocked_ms", [15, 40, 500])
def test_no_command_leaves_that_is_older_than_the_bound(rate_hz: int, blocked_ms: int) -> None:
    rig = BlockedBus(rate_hz, (100 + blocked_ms) * MS)
    arrived = rig.run(800 * MS)
    assert max(rig.ages_ns(arrived)) <= TX_QUEUE_NS + 2 * rig.period_ns
    last = [frame for frame in arrived if frame.stamp_ns > (130 + blocked_ms) * MS]
    assert max(rig.ages_ns(last)) <= rig.period_ns, "the queue is empty again"


@pytest.mark.parametrize("rate_hz", [200, 1000])
def test_a_short_stall_loses_nothing(rate_hz: int) -> None:
    rig = BlockedBus(rate_hz, 115 * MS)
    ticks = 200 * MS // rig.period_ns
    assert len(rig.run(200 * MS)) == ticks * len(COMMANDS)
    assert rig.bus.stats.refused == 0


@pytest.mark.parametrize("rate_hz", [200, 1000])
def test_a_bus_that_transmits_nothing_is_reported_within_50_ms(rate_hz: int) -> None:
    """Catalogue entry 12: what was cancelled counts as refused, tick after tick."""
    rig = BlockedBus(rate_hz, 500 * MS)
    rig.run(400 * MS)
    seen_ns = next(at_ns for at_ns, reason in rig.reasons if reason is Reason.SEND_REFUSED)
    assert seen_ns - 100 * MS <= 50 * MS
    assert rig.reasons[-1][1] is Reason.SEND_REFUSED, "and as long as it lasts"


def test_commands_that_are_not_due_in_every_tick_are_neither_cancelled_early_nor_sent_late() -> None:
    """As on mach0: four frames in every fourth tick, and a queue for two periods."""
    core = WireCore(250_000)
    core.inject(Fault(Kind.BABBLE, 100 * MS, 400 * MS, key=0x000))
    bus, listener = InProcessBus(core, "controller", tx_queue=MIN_QUEUE_FRAMES), InProcessBus(core, "listener")
    link, reading, monitor = BusLink(bus), BusReading(), BusMonitor(1)
    arrived: list[Frame] = []
    seen_ns, sent = None, False
    for tick in range(120):
        link.receive([], reading)
        monitor.update(reading, sent, core.now_ns)
        if seen_ns is None and monitor.reason is Reason.SEND_REFUSED:
            seen_ns = core.now_ns
        sent = tick % 4 == 0
        link.send([(0x300 + i, core.now_ns.to_bytes(8, "big")) for i in range(4)] if sent else [])
        core.advance(core.now_ns + 5 * MS)
        listener.drain(arrived)
    ages_ns = [frame.stamp_ns - int.from_bytes(frame.data, "big") for frame in arrived if frame.key >= 0x300]
    assert max(ages_ns) <= 45 * MS and len([age for age in ages_ns if age < 5 * MS]) >= 4 * 14
    assert seen_ns is not None and seen_ns - 100 * MS <= 100 * MS


def test_joint_references_have_room_in_the_queue() -> None:
    settings = load("palms_471")
    plain = settings.tx_queue_frames[0]
    profile = msgspec.structs.replace(load_profile("palms_471"), plc=Plc("references"))
    assert type(settings)(profile, 0, settings.rate_hz).tx_queue_frames[0] > plain
