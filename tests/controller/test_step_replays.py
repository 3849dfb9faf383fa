"""Determinism, hostile inputs and memory: the basis of replay and of long runs."""

from itertools import pairwise

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from can_dbc.frame import EXTENDED, Frame
from can_dbc.messages import tick_record
from can_dbc.messages.crane import CraneSetpoint, GrappleCommand, Knot
from can_dbc.messages.datagrams import encode
from controller.laws.valve_map import ValveMap
from controller.process.tick_recording import record, restore_inputs, transmitted
from controller.step import Controller, step
from controller.tick import Inputs
from machine.profile import SPEED_HEADROOM_SHARE
from machine.status.modes import Mode
from tests.controller.bench import AORO, DATABASE, GNSS, MACHINE, MS, SETTINGS, SPECS, Bench, T, bytes_kept

CLAIM = MACHINE.message("AddressClaim")
KNOWN_KEYS = [m.key for m in DATABASE.messages.values()]
any_key = st.one_of(st.sampled_from(KNOWN_KEYS), st.integers(0, 0x7FF), st.just(0x18FF2F27 | EXTENDED))
frames = st.lists(st.tuples(any_key, st.binary(max_size=8)), max_size=6)
number = st.one_of(st.floats(allow_nan=True, allow_infinity=True), st.floats(-4, 4))
five = st.tuples(*[number] * 5)


@st.composite
def setpoints(draw):
    """Setpoints with a valid checksum and random contents."""
    n = draw(st.integers(1, 4))
    knots = tuple(Knot(1000 * draw(st.integers(0, 4_000_000)), draw(five), draw(five)) for _ in range(n))
    profile_hash = draw(st.sampled_from([0, SETTINGS.profile_hash]))
    stamp = (draw(st.integers(0, 2**32 - 1)), profile_hash, *(draw(st.integers(0, ms * MS)) for ms in (3_000, 600)))
    return encode(CraneSetpoint(*stamp, draw(st.sampled_from(GrappleCommand)), draw(st.booleans()), knots))


@st.composite
def near_setpoints(draw):
    """Knots near the present position: some are accepted."""
    small = st.floats(-0.4, 0.4)
    return [
        (50 * (i + 1), [draw(small) for _ in range(5)], [draw(small) for _ in range(5)])
        for i in range(draw(st.integers(1, 5)))
    ]


hostile = st.lists(st.tuples(frames, st.lists(st.one_of(st.binary(max_size=80), setpoints()), max_size=2)), max_size=8)


def inside_the_envelope(bench):
    commands = {**bench.commands_a, **bench.commands_b}
    for spec, estimator in zip(SPECS, bench.controller.estimators, strict=True):
        made = ValveMap(spec.valve)
        made.set_position(estimator.position)
        limit = SPEED_HEADROOM_SHARE * spec.speed_limit
        low, high = made.spool_pct(-limit), made.spool_pct(limit)
        assert min(low, high) - 0.05 <= commands[spec.valve.signal] <= max(low, high) + 0.05
    assert commands["Aux"] == 0.0 and commands["Mode"] in (0, 2)
    if bench.mode not in (Mode.ACTIVE, Mode.STOP):
        assert bench.neutral
    if bench.mode not in (Mode.ARMED, Mode.ACTIVE) and not bench.controller.supervisor.ramping:
        assert commands["ArmKey"] == 0


@given(hostile, st.sampled_from(["boot", "armed", "active"]))
@settings(max_examples=25, deadline=None)
def test_random_input_never_raises_or_leaves_the_envelope(script, state):
    bench = PREPARED[state]()
    for extra, datagrams in script:
        bench.extra = list(extra)
        bench.tick(datagrams)
        inside_the_envelope(bench)


@given(st.lists(near_setpoints(), min_size=1, max_size=6))
@settings(max_examples=25, deadline=None)
def test_any_accepted_setpoint_keeps_the_commands_in_the_envelope(plans):
    bench = Bench().armed()
    for plan in plans:
        here = list(bench.controller.reference_position)
        knots = [(ms, [h + 0.2 * p for h, p in zip(here, q, strict=True)], v) for ms, q, v in plan]
        bench.tick([bench.setpoint(knots)])
        inside_the_envelope(bench)
        for _ in range(8):
            bench.tick()
            inside_the_envelope(bench)


PREPARED = {"boot": Bench, "armed": lambda: Bench().armed(), "active": lambda: Bench().active(ticks=10)}


def note(bench, tape, datagrams=(), **measured):
    tape.append(record(bench.inputs, bench.tick(datagrams, **measured), bench.now_ns))


@pytest.mark.parametrize("settings_", [SETTINGS, AORO], ids=lambda s: s.profile.name)
def test_record_of_a_whole_run_replays_to_the_same_bytes(settings_):
    bench, tape = Bench(settings_), []
    for _ in range(150):
        note(bench, tape)
    note(bench, tape, [bench.operator(1)])
    note(bench, tape, [bench.hold()])
    for k in range(100):
        note(bench, tape, [bench.moving(0, 0.1)] if k % 10 == 0 else (), late_ns=k * 1000, tick_ns=k)
    assert bench.mode is Mode.ACTIVE
    note(bench, tape, [b"rubbish"], late_ns=T + 1, bus_state=2, bus_dropped=1, bus_refused=1, bus_errors=3)
    note(bench, tape, machine_bus_dropped=1, machine_bus_refused=2)
    bench.machine_extra += [(CLAIM.key, bytes(8))] if bench.carrier else []
    bench.dropped.add("EncSlew")
    for _ in range(40):
        note(bench, tape, [bench.hold()])
    note(bench, tape, bus_recoveries=1, machine_bus_recoveries=2, bus_state=0)
    for _ in range(100):
        note(bench, tape)
    assert bench.mode is Mode.FAULT

    controller, inputs = Controller(bench.settings, DATABASE, (MACHINE, GNSS)), Inputs()
    for data in tape:
        tick = tick_record.decode(data)
        restore_inputs(inputs, tick)
        outputs = step(controller, inputs, tick.now_ns)
        assert transmitted(outputs) == (tick.frames_out, tick.machine_frames_out, tick.report, tick.vehicle_report)
        assert tick.frames_out[-1][0] == 0x080, "SYNC goes out last"
    sent = [frame for data in tape for frame in tick_record.decode(data).machine_frames_out]
    assert bool(sent) is (settings_ is AORO)


@pytest.mark.parametrize("settings_", [SETTINGS, AORO])
@pytest.mark.long
def test_tick_keeps_no_memory(settings_):
    bench = Bench(settings_).active()
    planned = []
    for k in range(40):
        bench.count += 1
        datagrams = [bench.moving(0, 0.08)] if k % 10 == 0 else []
        planned.append((list(bench._answers()), list(bench._machine_answers()), datagrams))
    state, inputs = bench.controller, Inputs()

    def ticks(n):
        for k in range(n):
            bench.now_ns += T
            answers, machine_answers, inputs.datagrams = planned[k % 40]
            inputs.frames = [Frame(bench.now_ns, key, data) for key, data in answers]
            inputs.machine_frames = [Frame(bench.now_ns, key, data) for key, data in machine_answers]
            step(state, inputs, bench.now_ns)

    assert bytes_kept(ticks, 2000) < 2048


def test_reports_come_50_times_a_second_with_nan_for_unknown_values():
    bench = Bench()
    bench.run(5)
    assert all(p != p for p in bench.reports[0].position)
    bench.boot()
    n = len(bench.reports)
    bench.run(200)
    assert len(bench.reports) - n == 50
    report = bench.reports[-1]
    assert report.mode == Mode.STANDBY and report.stale_mask == 0
    assert abs(report.position[1] - 0.5) < 1e-3 and report.opening_pct == 100.0
    assert report.sequence == len(bench.reports) and report.frames_received > 0


def test_status_and_heartbeat_on_the_bus_and_sync_apart():
    bench = Bench().boot()
    seen, counters = {}, []
    for _ in range(200):
        outputs = bench.tick()
        counters.append(outputs.sync[1][0])
        for key, _ in (*outputs.frames, outputs.sync):
            seen[key] = seen.get(key, 0) + 1
    assert seen[0x210] == seen[0x310] == seen[0x080] == 200
    assert seen[0x4FE] == 50 and seen[0x77E] == 10
    assert all(b == a % 240 + 1 for a, b in pairwise(counters))
