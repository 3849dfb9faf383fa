"""Parts of the timing experiment without a clock: readings, evaluation, frame continuity."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Sequence

import pytest
from msgspec import structs

from can_dbc.dbc.codec import load
from can_dbc.protocols.e2e import Sender
from can_dbc.timing.durations import Durations
from can_dbc.timing.page import STAGES, BusCounters, Facts, ProcessCounters
from experiments.common import host_activity
from experiments.common.host_activity import HostActivity
from experiments.common.result import evaluate
from experiments.timing import events, measurement
from experiments.timing.measurement import MeasurementWindow
from experiments.timing.metrics import (
    METRICS,
    Measured,
    block_growth,
    compared_windows,
    gather,
    pooled,
    quiet,
    ratio,
    spread_us,
    system_call_metrics,
    undecided,
)
from experiments.timing.stand_ins import Continuity
from hil.tick import instructions
from machine.loading.profile_file import load_profile
from machine.status.reasons import Reason

PERIOD_NS = 5_000_000


def histogram(*late_us: float, times: int = 1) -> Durations:
    made = Durations()
    for _ in range(times):
        for us in late_us:
            made.add(round(1000 * us))
    return made


def facts(ticks: int, missed: int = 0, faults: int = 0, blocks: int = 1000) -> Facts:
    process = ProcessCounters(ticks * 300_000, faults, 0, 2 * ticks, 0, 0, blocks, 50_000)
    bus = BusCounters("crane0", "ACTIVE", 12 * ticks, 5 * ticks, 0, 0, 0, 0)
    return Facts(1, 0, ticks * PERIOD_NS, PERIOD_NS, ticks, missed, 0, "ACTIVE", "", (bus,), process, {}, (), ())


def window(
    late: Sequence[float] = (30.0,),
    theirs: Sequence[float] = (25.0,),
    plain_us: float = 400.0,
    *,
    ticks: int = 2000,
    at: int = 0,
    missed: int = 0,
    plain_missed: int = 0,
    steal_ms: float = 0.0,
    faults: int = 0,
    cpu_us: float = 100.0,
    loop_us: float = 20.0,
) -> MeasurementWindow:
    """``ticks`` wake-ups that cycle through ``late``, and as many of cyclictest's."""
    durations = {name: histogram(cpu_us, times=ticks) for name in STAGES}
    durations["wake"] = histogram(*late, times=max(1, ticks // len(late)))
    return MeasurementWindow(
        facts(at),
        facts(at + ticks, missed, faults),
        durations,
        None,
        histogram(*theirs, times=max(1, ticks // len(theirs))),
        histogram(plain_us, times=ticks),
        plain_missed,
        loop_us,
        HostActivity(10.0, steal_ms, 0.1, 0.5),
    )


def metrics_of(quiet: list[MeasurementWindow], loaded: list[MeasurementWindow]) -> dict[str, float]:
    slow = Measured(quiet, loaded, ({"clock_nanosleep": 4000, "recvmsg": 8000}, 2000.0))
    fast = Measured(quiet[:1], loaded[:1])
    return gather(slow, fast)[0]


def judged(metrics: dict[str, float]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Names of the missed and of the inconclusive metrics."""
    return evaluate(METRICS, metrics, False, undecided(metrics))


def test_a_pressure_file_gives_the_waiting_time():
    text = "some avg10=31.01 avg60=14.01 avg300=7.94 total=5137622117\nfull avg10=0.00 total=7\n"
    assert host_activity.pressure_us(text) == 5137622117
    assert host_activity.pressure_us("") is None
    between = host_activity.between(
        host_activity.Sample(0, 10.0, 1_000_000, 0.0), host_activity.Sample(2_000_000_000, 40.0, 1_500_000, 3.0)
    )
    assert (between.seconds, between.steal_ms, between.pressure, between.load) == (2.0, 30.0, 0.25, 3.0)
    assert host_activity.between(host_activity.Sample(0, 0, None, 0), host_activity.Sample(1, 0, 5, 0)).pressure is None


def test_steal_is_read_where_it_is_reported():
    assert host_activity.steal_ms("cpu 1 2 3 4 5 6 7 250 0 0\n") == pytest.approx(2500.0)
    assert host_activity.steal_ms("cpu 1 2 3 4\n") == 0.0


@pytest.mark.parametrize(("stamp_ns", "period_ns"), [(7_001_234_567, 5_000_000), (12_000_999_999, 1_000_000)])
def test_cyclictest_wakes_at_a_fixed_distance_from_the_ticks(stamp_ns, period_ns):
    offset_ns = 1000 * measurement.offset_us(stamp_ns, period_ns)
    assert 0 <= offset_ns < period_ns
    distance = (offset_ns - stamp_ns) % period_ns
    assert distance == pytest.approx(measurement.QUIET_PHASE * period_ns, abs=1000)


def test_cyclictests_report_becomes_a_histogram():
    thread = {"cycles": 10, "min": 12, "max": 200_001, "avg": 20.0, "histogram": {"12": 6, "1500": 3}}
    found = measurement.read_cyclictest(json.dumps({"thread": {"0": thread}}))
    assert found.count == 10 and found.longest_ns == 200_001_000
    assert found.over(100_000_000 - 1) == 1 and found.over(PERIOD_NS) == 1
    assert found.quantile_ns(0.5) == 13_000


def test_the_output_of_the_sleep_loop_becomes_a_histogram():
    output = {"bins": {"5": 3}, "longest_ns": 5_500, "missed": 4, "cpu_us": 21.5}
    lateness, missed, cpu_us = measurement.read_sleep_loop(output)
    assert lateness.count == 3 and missed == 4 and cpu_us == 21.5


def test_system_calls_are_counted_from_the_tables_rows():
    table = (
        "% time     seconds  usecs/call     calls    errors syscall\n"
        "------ ----------- ----------- --------- --------- ----------------\n"
        " 60.00    0.000300           1       300           clock_nanosleep\n"
        " 40.00    0.000200           0       900       300 recvmsg\n"
        "------ ----------- ----------- --------- --------- ----------------\n"
        "100.00    0.000500           0      1200       300 total\n"
    )
    assert measurement.count_calls(table) == {"clock_nanosleep": 300, "recvmsg": 900}


def test_histograms_add_up():
    total = pooled([histogram(10.0, 20.0), histogram(3000.0)])
    assert total.count == 3 and total.longest_ns == 3_000_000
    assert pooled([]).count == 0


def test_a_quantile_lies_inside_its_bin():
    found = spread_us("x", histogram(*(10.0 + 0.01 * i for i in range(100))))
    assert 10.0 < found["x_p50_us"] < found["x_p99_us"] <= 11.0
    assert found["x_max_us"] == pytest.approx(10.99)


@pytest.mark.parametrize(
    ("made", "is_quiet"),
    [
        (window(), True),
        (window(theirs=[25.0] * 999 + [1001.0]), False),  # a stall that could cause a missed deadline
        (window(theirs=[25.0] * 98 + [260.0] * 2), False),
        (window(steal_ms=60.0), False),
        (window(late=[25.0] * 999 + [4000.0]), True),  # only the controller is late: it counts
    ],
)
def test_cyclictest_decides_whether_a_window_is_quiet(made, is_quiet):
    assert quiet(made) is is_quiet


def test_only_quiet_windows_are_compared_if_they_are_at_least_half():
    noisy = window(theirs=[2000.0], at=2000)
    good = window()
    assert compared_windows([good, noisy]) == ([good], True)
    assert compared_windows([good, noisy, noisy]) == ([good, noisy, noisy], False)


def test_a_ratio_compares_quantiles_and_has_an_interval():
    found = ratio("r", [histogram(30.0, times=50)] * 4, [histogram(20.0, times=50)] * 4, 0.5)
    assert found["r"] == pytest.approx(1.5, abs=0.05) and found["r_n"] == 4
    assert found["r_low"] <= found["r"] <= found["r_high"]


def test_a_long_quiet_run_is_evaluated_and_a_slow_loop_misses_its_limits():
    quiet = [window(late=[60.0], ticks=6000, at=6000 * i) for i in range(20)]
    loaded = [window(plain_us=9000.0, plain_missed=500)]
    metrics = metrics_of(quiet, loaded)
    assert metrics["host_verdict"] == 1.0 and metrics["judged_cycles"] == 120_000
    missed, open_ = judged(metrics)
    assert missed == ("wakeup_p50_ratio", "wakeup_p99_ratio")
    assert not {"missed", "page_faults", "missed_loaded_share"} & {*open_}


def test_on_a_noisy_host_clock_metrics_are_inconclusive():
    metrics = metrics_of([window(theirs=[3000.0], late=[3000.0], ticks=6000) for _ in range(20)], [window()])
    assert metrics["host_verdict"] == 0.0 and metrics["wakeup_p50_ratio"] == pytest.approx(1.0, abs=0.01)
    missed, open_ = judged(metrics)
    assert {"wakeup_p50_ratio", "wakeup_p99_ratio"} <= {*open_}
    assert missed == ()


def test_a_short_run_is_inconclusive():
    metrics = metrics_of([window(ticks=600)], [window()])
    missed, open_ = judged(metrics)
    wanted = {"wakeup_p50_ratio", "missed", "page_faults", "gc_runs", "tick_cpu_p99_us", "missed_loaded_share"}
    assert wanted <= {*open_} and not missed


def test_metrics_without_the_clock_can_miss_on_any_host():
    metrics = metrics_of([window(theirs=[3000.0], ticks=600, faults=2)], [window()])
    assert "page_faults" in judged(metrics)[0]


def test_a_deadline_missed_in_a_quiet_window_counts():
    metrics = metrics_of([window(missed=1)], [window()])
    assert "missed" in judged(metrics)[0]


@pytest.mark.parametrize(
    ("ours", "plain", "theirs", "outcome"),
    [
        (0, 500, 25.0, "met"),
        (4, 500, 25.0, "met"),
        (6, 500, 25.0, "missed"),
        (6, 500, 9000.0, "inconclusive"),  # cyclictest missed too
        (0, 50, 25.0, "inconclusive"),  # too few to decide one percent
        (0, 0, 25.0, "inconclusive"),
    ],
)
def test_missed_deadlines_under_load_are_compared_with_the_sleep_loop(ours, plain, theirs, outcome):
    pressed = window(theirs=[theirs], plain_us=9000.0, plain_missed=plain, missed=ours)
    metrics = metrics_of([window()], [pressed])
    missed, open_ = judged(metrics)
    name = "missed_loaded_share"
    assert outcome == ("missed" if name in missed else "inconclusive" if name in open_ else "met")


def test_the_cost_of_a_tick_is_judged_in_the_quietest_windows_whatever_it_is_there():
    noisy = [window(theirs=[10.0], cpu_us=500.0, loop_us=50.0, at=2000 * i) for i in range(6)]
    good = [window(theirs=[30.0], cpu_us=170.0, loop_us=20.0), window(theirs=[20.0], cpu_us=180.0, loop_us=21.0)]
    metrics = metrics_of([*noisy, *good], [window()])
    assert metrics["tick_cpu_p50_us"] == pytest.approx(175.0, abs=10.0) and metrics["tick_cpu_all_p50_us"] > 450.0
    assert metrics["plain_cpu_us"] == pytest.approx(20.5) and metrics["plain_cpu_all_us"] == pytest.approx(50.0)
    assert metrics["tick_cpu_in_plain"] == pytest.approx(10.0, abs=0.5)
    assert "tick_cpu_p50_us" in judged(metrics)[0]


def test_a_costly_tick_on_a_noisy_host_is_inconclusive_and_a_cheap_one_counts():
    costly = metrics_of([window(theirs=[400.0], cpu_us=500.0)], [window()])
    missed, open_ = judged(costly)
    assert {"tick_cpu_p50_us", "tick_cpu_p99_us"} <= {*open_}
    cheap = metrics_of([window(theirs=[400.0])], [window()])
    missed, open_ = judged(cheap)
    assert not {"tick_cpu_p50_us", "tick_cpu_p99_us"} & ({*missed} | {*open_})


def outcome_of(stalls: list[events.Stall]) -> tuple[dict[str, float], tuple[str, ...], tuple[str, ...]]:
    """One stop and 36 refused frames at 10 s, with these stalls."""
    before, after = facts(1800), facts(2000)
    bus = structs.replace(after.buses[0], refused=36)
    lost = events.losses_between(before, structs.replace(after, buses=(bus,)))
    stop = events.stop(10_000_000_000, Reason.ESTOP_LOST, "gone")
    told = events.Events([stop], lost, stalls)
    assert len(told.sentences()) == 2
    slow = Measured([window()], [window()], events=told)
    metrics = gather(slow, Measured([window()], [window()]))[0]
    return metrics, *judged(metrics)


def test_a_loss_and_a_stop_are_explained_by_a_stall_that_a_witness_saw_just_before():
    metrics, missed, open_ = outcome_of([events.Stall(0, 9_950_000_000, 90_000_000)])
    assert (metrics["frames_lost"], metrics["frames_lost_unexplained"]) == (36.0, 0.0)
    assert (metrics["stops"], metrics["stops_unexplained"]) == (1.0, 0.0)
    assert {"frames_lost", "stops"} <= {*open_} and "frames_lost" not in missed


@pytest.mark.parametrize(
    "stalls",
    [
        [],
        [events.Stall(0, 9_950_000_000, 90_000_000, own_share=0.95)],  # the testbed itself filled the processor
        [events.Stall(0, 5_000_000_000, 90_000_000)],
        [events.Stall(0, 9_950_000_000, 6_000_000)],
    ],
)
def test_a_loss_without_a_stall_long_enough_and_near_enough_counts(stalls):
    metrics, missed, _ = outcome_of(stalls)
    assert metrics["frames_lost_unexplained"] == 36.0 and metrics["stops_unexplained"] == 1.0
    assert {"frames_lost", "frames_lost_unexplained", "stops", "stops_unexplained"} <= {*missed}


@pytest.mark.parametrize(("length_ms", "explained"), [(15, False), (22, True)])
def test_a_short_stall_explains_refused_frames_only_where_it_fills_the_transmit_queue(length_ms, explained):
    """The frames of 20 ms wait for a bus, at any rate."""
    lost = events.loss(9_000_000_000, 10_000_000_000, "crane0", refused=5, dropped=0)
    stall = events.Stall(0, 9_950_000_000, length_ms * 1_000_000)
    assert (events.Events(losses=[lost], stalls=[stall]).cause(lost) is stall) is explained


def test_the_kernel_counts_what_a_thread_executes():
    descriptor = instructions.open_counter(os.getpid(), instructions.TASK_CLOCK)
    if descriptor is None:
        pytest.skip("this host does not let us count")
    try:
        before, began_ns = instructions.count(descriptor), time.thread_time_ns()
        sum(range(300_000))
        counted, passed_ns = instructions.count(descriptor) - before, time.thread_time_ns() - began_ns
    finally:
        os.close(descriptor)
    assert counted == pytest.approx(passed_ns, rel=0.2)


def test_a_metric_without_a_value_is_inconclusive():
    metrics = metrics_of([window()], [window()]) | system_call_metrics(None)
    missed, open_ = judged(metrics)
    assert "syscalls_per_tick" in open_ and "syscalls_per_tick" not in missed


def test_every_metric_of_the_page_is_measured():
    frames = {"rx_decode_us", "rx_decode_pythoncan_us"}  # from receive_cost
    bench = {"compiled_ratio_cold", "compiled_ratio_hot", "tick_instructions"}  # from hil.tick; only where counted
    assert {f.name for f in METRICS} <= set(metrics_of([window()], [window()])) | frames | bench


def test_blocks_that_come_and_go_are_no_growth():
    def growth(*blocks: int) -> float:
        return block_growth([facts(0, blocks=n) for n in blocks])

    assert growth(1000, 1003, 1001, 1002, 1000, 1005) == 0.0
    assert growth(1000, 1001, 1002, 1003, 1004, 1005) == 3.0


def test_a_lost_frame_is_a_gap_in_the_counter():
    database = load("crane")
    codec = database.message("ValveCmdA")
    sender, seen = Sender(codec.data_ids), Continuity(load_profile("palms_471"))
    frames = [sender.protect(codec.encode(*(0 for _ in codec.signals))) for _ in range(20)]
    for data in frames[:5] + frames[6:]:
        seen.add(codec.key, data)
    seen.add(codec.key, bytes(8))
    seen.add(0x182, b"\x01\x02")  # an encoder's, unprotected
    assert (seen.gaps, seen.damaged, seen.frames[codec.key], seen.frames[0x182]) == (1, 1, 20, 1)


def test_counters_of_different_messages_are_kept_apart():
    database = load("crane")
    a, b = database.message("ValveCmdA"), database.message("ValveCmdB")
    seen = Continuity(load_profile("palms_471"))
    senders = {c.key: Sender(c.data_ids, start) for c, start in ((a, 3), (b, 9))}
    for _ in range(40):
        for codec in (a, b):
            seen.add(codec.key, senders[codec.key].protect(codec.encode(*(0 for _ in codec.signals))))
    assert seen.gaps == seen.damaged == 0
