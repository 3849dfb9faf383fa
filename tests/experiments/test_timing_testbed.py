"""The timing testbed: emulated machine and setpoint source with the real controller in virtual time, observer, soak."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
from msgspec import structs
from typer.testing import CliRunner

from can_dbc.dbc.codec import load
from can_dbc.frame import Frame
from can_dbc.messages.crane import CraneSetpoint, StateReport
from can_dbc.messages.datagrams import decode
from can_dbc.messages.tick_record import BusReading
from can_dbc.timing.page import Facts, ProcessCounters
from controller.bus_io import BusMonitor
from controller.config import load as settings_of
from controller.guard.__main__ import build, profile_path, split
from controller.guard.operator import action_of
from controller.process.tick_recording import record
from controller.step import Controller, step
from controller.tick import Inputs
from experiments.timing import soak
from experiments.timing.stand_ins import STAMP_AGE_NS, BusObserver, SetpointSource, Swing
from machine.joints import JOINTS
from machine.loading.profile_file import load_profile
from machine.status.modes import Mode
from machine.status.reasons import Reason
from sim.kinematic import KinematicMachine, KinematicWorld
from sim.nodes.valve import FUNCTIONS
from sim.truth.load import load_truth
from tests.console.state_reports import at
from timberhand.cli import app

START_NS = 1_000_000_000
PALMS = load_profile("palms_471")


class Virtual:
    """Controller, guard, setpoint source, observer and emulated machine in one process, in steps of a period."""

    def __init__(self, profile: str, rate_hz: int) -> None:
        settings = settings_of(profile, rate_hz)
        self.profile, self.period_ns = settings.profile, settings.period_ns
        self.controller, self.guard = Controller(settings), build(profile_path(profile))
        cycle_ns = min(5_000_000, self.period_ns)
        self.machine = KinematicMachine(settings.profile, 1, step_ns=min(cycle_ns, 2_500_000), cycle_ns=cycle_ns)
        self.source = SetpointSource(settings.profile)
        self.observer = BusObserver(settings.profile, self.period_ns)
        self.now_ns, self.guard_ns = START_NS, 0
        self.inputs = Inputs()
        self.received: list[tuple[str, Frame]] = []
        self.for_guard: list[Frame] = []
        self.datagrams: list[bytes] = []
        self.pressed: list[bytes] = []
        self.modes: list[tuple[int, int]] = []

    def tick(self) -> None:
        self.now_ns += self.period_ns
        crane, machine = self.profile.crane_bus, self.profile.machine_bus
        sent = self.machine.step(self.now_ns, self.received)
        inputs = self.inputs
        inputs.frames[:] = [Frame(self.now_ns, key, data) for bus, key, data in sent if bus == crane]
        inputs.machine_frames[:] = [Frame(self.now_ns, key, data) for bus, key, data in sent if bus == machine]
        self.for_guard += inputs.frames + inputs.machine_frames
        self.received, guarded, alive = [], [], []
        if self.now_ns >= self.guard_ns:
            self.guard_ns = self.now_ns + 5_000_000
            guarded, alive = split(self.guard.step(self.now_ns, self.for_guard))
            self.for_guard = []
        inputs.frames += [Frame(self.now_ns, key, data) for key, data in guarded]
        inputs.operator[:], self.pressed = self.pressed, []
        for command in inputs.operator:
            self.guard.hear(action_of(command, 0, self.now_ns)[0], self.now_ns)
        inputs.datagrams[:], self.datagrams = self.datagrams, []
        outputs = step(self.controller, inputs, self.now_ns)
        self.observer.add(record(inputs, outputs, self.now_ns))
        self.received = [(crane, Frame(self.now_ns, *wire)) for wire in (*outputs.frames, outputs.sync, *guarded)]
        self.received += [(machine or "", Frame(self.now_ns, *wire)) for wire in (*outputs.machine_frames, *alive)]
        self.for_guard += [Frame(self.now_ns, *wire) for wire in (*outputs.frames, *outputs.machine_frames)]
        if outputs.report is not None:
            report = decode(outputs.report)
            assert isinstance(report, StateReport)
            if not self.modes or self.modes[-1][0] != report.mode:
                self.modes.append((report.mode, report.reason))
            self.pressed += [d for d in (self.source.receive(report),) if d]
        if self.now_ns % 50_000_000 < self.period_ns:
            self.datagrams += [d for d in (self.source.setpoint(self.now_ns),) if d]


@pytest.mark.long
@pytest.mark.parametrize(("profile", "rate_hz", "seconds"), [("aoro_fc8", 200, 5.0), ("palms_471", 1000, 4.0)])
def test_the_emulated_machine_is_armed_moves_and_never_stops(profile, rate_hz, seconds):
    bench = Virtual(profile, rate_hz)
    begin = bench.machine.joint_positions()
    for _ in range(round(seconds * rate_hz)):
        bench.tick()
    assert [mode for mode, _ in bench.modes] == [Mode.BOOT, Mode.STANDBY, Mode.ARMED, Mode.ACTIVE]
    moved = [abs(b - a) for a, b in zip(begin, bench.machine.joint_positions(), strict=True)]
    assert min(moved) > 0.005
    report = bench.source.report
    assert report is not None and report.refused == 0
    for measured, wanted, spec in zip(report.position, report.reference, bench.profile.joints.values(), strict=True):
        if spec.encoder is not None:
            assert measured == pytest.approx(wanted, abs=0.1 * spec.speed_limit)
    totals = bench.observer.totals()
    assert totals["records"] == seconds * rate_hz
    assert not any(totals[name] for name in ("records_lost", "records_unreadable", "gaps", "damaged", "unanswered"))


def active_at_1_khz() -> Virtual:
    bench = Virtual("palms_471", 1000)
    while not bench.modes or bench.modes[-1][0] != Mode.ACTIVE:
        bench.tick()
    return bench


@pytest.mark.parametrize(("lost_ms", "mode"), [(15, Mode.ACTIVE), (23, Mode.STOP)])
def test_at_1_khz_the_valve_nodes_echo_may_stand_as_long_as_at_200_hz(lost_ms, mode):
    bench = active_at_1_khz()
    commands = {load("crane").message(name).key for name in ("ValveCmdA", "ValveCmdB")}
    for _ in range(lost_ms):
        bench.received = [(bus, frame) for bus, frame in bench.received if frame.key not in commands]
        bench.tick()
    for _ in range(5):
        bench.tick()
    supervisor = bench.controller.supervisor
    assert (supervisor.mode, supervisor.reason) == (
        mode,
        Reason.NONE if mode is Mode.ACTIVE else Reason.VALVE_ECHO_STUCK,
    )


@pytest.mark.parametrize(("late_ms", "reason"), [(9, Reason.NONE), (11, Reason.LOOP_LATE)])
def test_at_1_khz_a_tick_is_late_when_it_would_be_at_200_hz(late_ms, reason):
    bench = active_at_1_khz()
    bench.inputs.late_ns = late_ms * 1_000_000
    bench.tick()
    supervisor = bench.controller.supervisor
    assert (supervisor.mode, supervisor.reason) == (Mode.ACTIVE, reason)


def test_at_1_khz_a_bus_may_refuse_frames_as_long_as_at_200_hz():
    monitor, reading = BusMonitor(0), BusReading()
    for ms in range(12):
        reading.refused += 1
        monitor.update(reading, True, ms * 1_000_000)
        assert monitor.reason == (Reason.SEND_REFUSED if ms >= 10 else Reason.NONE)


def test_a_joint_follows_its_valve_through_dead_time_and_dead_band():
    world = KinematicWorld(PALMS, load_truth("nominal", 1, PALMS.name), 5_000_000)
    valve, lift = PALMS.joints["lift"].valve, FUNCTIONS.index("lift")
    command = [0.0] * len(FUNCTIONS)
    begin = world.q["lift"]

    def run(percent: float, steps: int) -> float:
        command[lift] = valve.sign * percent / 100.0
        for _ in range(steps):
            world.step(command)
        return world.qd["lift"]

    delay = round(valve.delay_s / 0.005)
    assert run(0.5 * valve.deadband_plus_pct, 2 * delay) == 0.0
    assert run(100.0, delay) == 0.0 and world.q["lift"] == begin
    assert run(100.0, 1) == pytest.approx(valve.full_speed_plus)
    assert world.q["lift"] == pytest.approx(begin + 0.005 * valve.full_speed_plus)
    assert run(100.0, 4000) == 0.0 and world.q["lift"] == PALMS.joints["lift"].upper


def test_a_swing_begins_at_rest_and_stays_within_range_and_speed():
    for joint in JOINTS:
        spec = PALMS.joints[joint.name.lower()]
        for start in (spec.lower, spec.upper, (spec.lower + spec.upper) / 2):
            swing = Swing(start, spec.lower, spec.upper, spec.speed_limit, spec.acceleration_limit)
            assert swing.at(0.0) == (start, 0.0)
            samples = [swing.at(0.01 * i) for i in range(4000)]
            assert all(spec.lower - 1e-9 <= q <= spec.upper + 1e-9 for q, _ in samples)
            assert 0.0 < max(abs(v) for _, v in samples) < 0.5 * spec.speed_limit


def test_no_setpoint_is_sent_to_a_machine_that_is_not_armed():
    source = SetpointSource(PALMS)
    report = at((0.1, math.nan, 0.0, 0.5, 0.0), START_NS, Mode.STANDBY)
    source.receive(report)
    assert source.setpoint(START_NS) is None
    source.receive(replace(report, mode=Mode.ARMED))
    first = decode(source.setpoint(START_NS) or b"")
    assert isinstance(first, CraneSetpoint) and first.stamp_ns == START_NS - STAMP_AGE_NS
    assert first.knots[0].position == (0.1, 0.0, 0.0, 0.5, 0.0) and first.knots[0].velocity == (0.0,) * 5


def test_the_observer_reports_a_lost_record_but_not_a_missed_period():
    bench = Virtual("palms_471", 200)
    records = []
    bench.observer.add = records.append  # type: ignore[method-assign]
    for _ in range(400):
        bench.tick()
    observer = BusObserver(PALMS, 5_000_000)
    for data in records[:100] + records[101:]:
        observer.add(data)
    observer.add(records[-1][:-1] + bytes([records[-1][-1] ^ 1]))
    totals = observer.totals()
    assert totals["records_lost"] == 1 and totals["records_unreadable"] == 1 and totals["gaps"] > 0


def test_growth_compares_the_halves_of_a_run():
    process = ProcessCounters(0, 5, 0, 0, 0, 3, 1000, 0)
    facts = Facts(1, 0, 0, 5_000_000, 0, 0, 0, "ACTIVE", "", (), process, {}, (), ())

    def reading(at_s: float, kb: int, blocks: int) -> soak.Reading:
        grown = structs.replace(facts, process=structs.replace(process, allocated_blocks=blocks))
        return soak.Reading(at_s, grown, kb, 10_000, "ACTIVE")

    breathing = [reading(i, 50_000 + 4 * (i % 2), 1000 + i % 3) for i in range(10)]
    assert soak.memory(breathing)["controller_growth_kb"] == soak.memory(breathing)["allocated_blocks_growth"] == 0.0
    growing = [reading(i, 50_000 + 100 * i, 1000 + i) for i in range(10)]
    assert soak.memory(growing)["controller_growth_kb"] == 500.0
    assert soak.memory(growing)["allocated_blocks_growth"] == 5.0


def soaked(**changed: float) -> dict[str, float]:
    still = {"active_share": 1.0, "ticks": 4000.0, "allocated_blocks_growth": 0.0}
    return still | {"stops": 0.0, "stops_unexplained": 0.0, "stall_max_ms": 80.0} | changed


def test_a_machine_stopped_by_the_host_alone_is_inconclusive():
    assert "active_share" in soak.undecided(soaked(active_share=0.2, stops=2.0))
    assert not soak.undecided(soaked(active_share=0.2, stops=2.0, stops_unexplained=1.0))
    assert not soak.undecided(soaked(active_share=0.2))  # without a stop
    assert not soak.undecided(soaked(active_share=0.9, stops=2.0))


def test_only_a_long_soak_detects_a_small_leak():
    name = "allocated_blocks_growth"
    assert name in soak.undecided(soaked(allocated_blocks_growth=2.0))
    assert not soak.undecided(soaked(allocated_blocks_growth=20.0))
    assert name in soak.undecided(soaked(allocated_blocks_growth=15.0, stops=1.0))
    assert not soak.undecided(soaked(allocated_blocks_growth=15.0))
    assert not soak.undecided(soaked(allocated_blocks_growth=50.0, stops=1.0))
    assert not soak.undecided(soaked(allocated_blocks_growth=2.0, ticks=360_000.0))


def test_an_unknown_bus_is_refused():
    assert CliRunner().invoke(app, ["experiment", "soak", "--bus", "can0"]).exit_code == 2
