"""Determinism, hostile inputs, memory: what replay and a long run rely on."""

import gc
import tracemalloc
from itertools import pairwise

from bench import DATABASE, MS, SPECS, Bench, T
from hypothesis import given, settings
from hypothesis import strategies as st

from can_dbc import tick_record
from can_dbc.bus import BusState
from can_dbc.frame import EXTENDED, Frame
from can_dbc.setpoint import CraneSetpoint, GrappleCommand, Knot, encode
from controller.laws.pd import HEADROOM
from controller.step import Controller, Inputs, step
from controller.valve import ValveMap
from machine.modes import Mode

KNOWN_KEYS = [m.key for m in DATABASE.messages.values()]
frames = st.lists(
    st.tuples(
        st.one_of(st.sampled_from(KNOWN_KEYS), st.integers(0, 0x7FF), st.just(0x18FF2F27 | EXTENDED)),
        st.binary(max_size=8),
    ),
    max_size=6,
)
number = st.one_of(st.floats(allow_nan=True, allow_infinity=True), st.floats(-4, 4))
five = st.tuples(number, number, number, number, number)


@st.composite
def setpoints(draw):
    """Setpoints with a right checksum and wild contents."""
    n = draw(st.integers(1, 4))
    knots = tuple(Knot(1000 * draw(st.integers(0, 4_000_000)), draw(five), draw(five)) for _ in range(n))
    return encode(
        CraneSetpoint(
            draw(st.integers(0, 2**32 - 1)), draw(st.sampled_from([0, Bench().settings.profile_hash])),
            draw(st.integers(0, 3_000 * MS)), draw(st.integers(0, 600 * MS)),
            draw(st.sampled_from(list(GrappleCommand))), draw(st.booleans()), knots,
        )
    )  # fmt: skip


@st.composite
def near_setpoints(draw):
    """Knots near where the machine is: some are accepted."""
    small = st.floats(-0.4, 0.4)
    return [
        (50 * (i + 1), [draw(small) for _ in range(5)], [draw(small) for _ in range(5)])
        for i in range(draw(st.integers(1, 5)))
    ]


hostile = st.lists(st.tuples(frames, st.lists(st.one_of(st.binary(max_size=80), setpoints()), max_size=2)), max_size=8)


def inside_the_envelope(bench):
    commands = {**bench.commands_a, **bench.commands_b}
    for spec in SPECS:
        made = ValveMap(spec.valve)
        limit = HEADROOM * spec.speed_limit
        low, high = made.spool_pct(-limit), made.spool_pct(limit)
        assert min(low, high) - 0.05 <= commands[spec.valve.signal] <= max(low, high) + 0.05
    assert commands["Aux"] == 0.0 and commands["Mode"] in (0, 2)
    if bench.mode not in (Mode.ACTIVE, Mode.STOP):
        assert bench.neutral
    if bench.mode not in (Mode.ARMED, Mode.ACTIVE) and not bench.controller.supervisor.ramping:
        assert commands["ArmKey"] == 0


@given(hostile, st.sampled_from(["boot", "armed", "active"]))
@settings(max_examples=25, deadline=None)
def test_nothing_raises_and_outputs_stay_in_the_envelope(script, state):
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
        here = list(bench.controller.reference)
        knots = [(ms, [h + 0.2 * p for h, p in zip(here, q, strict=True)], v) for ms, q, v in plan]
        bench.tick([bench.setpoint(knots)])
        inside_the_envelope(bench)
        for _ in range(8):
            bench.tick()
            inside_the_envelope(bench)


PREPARED = {
    "boot": Bench,
    "armed": lambda: Bench().armed(),
    "active": lambda: Bench().active(ticks=10),
}


def record(bench, tape, datagrams=(), **measured):
    outputs = bench.tick(datagrams, **measured)
    i = bench.inputs
    bus = (i.bus_state, i.bus_dropped, i.bus_refused, i.bus_errors)
    tape.append(
        tick_record.encode(
            bench.now_ns, i.late_ns, i.tick_ns, i.missed_ticks, bus, i.frames, i.datagrams, outputs.frames,
            outputs.report,
        )
    )  # fmt: skip


def test_a_record_of_a_whole_life_replays_to_the_same_bytes():
    bench, tape = Bench(), []
    for _ in range(130):
        record(bench, tape)
    record(bench, tape, [bench.operator(1)])
    record(bench, tape, [bench.hold()])
    for k in range(100):
        record(bench, tape, [bench.moving(0, 0.1)] if k % 10 == 0 else (), late_ns=k * 1000, tick_ns=k)
    record(bench, tape, [b"rubbish"], late_ns=T + 1, bus_state=2, bus_dropped=1, bus_refused=1, bus_errors=3)
    bench.dropped.add("EncSlew")
    for _ in range(40):
        record(bench, tape, [bench.hold()])
    assert bench.mode is Mode.FAULT

    controller, inputs = Controller(bench.settings, DATABASE), Inputs()
    for data in tape:
        tick = tick_record.decode(data)
        inputs.frames, inputs.datagrams = list(tick.frames_in), list(tick.datagrams)
        inputs.late_ns, inputs.tick_ns, inputs.missed_ticks = tick.late_ns, tick.tick_ns, tick.missed_ticks
        inputs.bus_state, inputs.bus_dropped = tick.bus_state, tick.bus_dropped
        inputs.bus_refused, inputs.bus_errors = tick.bus_refused, tick.bus_errors
        outputs = step(controller, inputs, tick.now_ns)
        assert tuple(outputs.frames) == tick.frames_out
        assert (outputs.report or b"") == tick.report


def test_a_tick_leaves_nothing_behind():
    bench = Bench().active()
    planned = [(list(bench._answers()), [bench.moving(0, 0.08)] if k % 10 == 0 else []) for k in range(40)]
    state, inputs = bench.controller, Inputs()

    def ticks(n):
        for k in range(n):
            bench.now_ns += T
            answers, datagrams = planned[k % 40]
            inputs.frames = [Frame(bench.now_ns, key, data) for key, data in answers]
            inputs.datagrams = datagrams
            step(state, inputs, bench.now_ns)

    ticks(400)
    gc.collect()
    tracemalloc.start(1)
    ticks(200)
    gc.collect()  # also empties the interpreter's free lists, which count as memory
    before, _ = tracemalloc.get_traced_memory()
    ticks(2000)
    gc.collect()
    after, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert after - before < 2048, "bytes kept by 2000 ticks"
    gc.collect()
    gc.disable()
    try:
        ticks(500)
        assert gc.collect() == 0, "a tick must not make reference cycles"
    finally:
        gc.enable()


def test_reports_come_50_times_a_second_and_tell_what_is_unknown():
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


def test_status_heartbeat_and_sync_on_the_bus():
    bench = Bench().boot()
    seen, counters = {}, []
    for _ in range(200):
        for key, data in bench.tick().frames:
            seen[key] = seen.get(key, 0) + 1
            if key == 0x080:
                counters.append(data[0])
    assert seen[0x210] == seen[0x310] == seen[0x080] == 200
    assert seen[0x4FE] == 50 and seen[0x77E] == 10
    assert all(b == a % 240 + 1 for a, b in pairwise(counters))
    bench.run(1, bus_state=BusState.ACTIVE)
    assert bench.controller.outputs.frames[-1][0] == 0x080


def test_farewell_is_neutral_and_disarmed():
    bench = Bench().active()
    out = bench.controller.farewell()
    bench.controller.outputs.frames[:] = out
    bench._obey(bench.controller.outputs)
    assert bench.neutral and bench.commands_b["ArmKey"] == 0
    codec = DATABASE.message("CtrlStatus")
    assert out[-1][0] == codec.key and codec.named(codec.decode(out[-1][1]))["Reason"] == 13
