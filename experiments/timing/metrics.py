"""Metrics of the timing experiment: their limits, the page that shows them, and what measurement windows say of them.

The texts of the page say how a metric is judged.  cyclictest wakes once per period of the controller, so a stall of the
host that is long enough for a missed deadline shows there too.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from statistics import median
from typing import Final

import numpy as np

from can_dbc.timing.durations import BINS, Durations, edge_ns
from can_dbc.timing.page import Facts
from experiments.common.result import Metric
from experiments.common.result_page import Section
from experiments.timing.events import Events, event_metrics, explained
from experiments.timing.measurement import MeasurementWindow
from experiments.timing.testbed import Span
from hil.tick.compare import median_interval

MAX_MISSED_SHARE: Final = 0.01
"""Limit for our missed deadlines under load, as a share of the sleep loop's."""

CONCLUSION: Final = (
    "A tick of the controller takes {tick_cpu_p50_us} of CPU time in the median and {tick_cpu_p99_us} at the 99th "
    "percentile; the controller uses {cpu_share} of one processor at 200 Hz.",
    "Its wake-ups are late by {wakeup_p50_us} in the median, those of cyclictest by {cyclictest_p50_us}.",
    "With every core loaded it missed {missed_loaded} deadlines, cyclictest {missed_loaded_cyclictest} and the sleep "
    "loop {missed_loaded_plain}.",
)
INTRODUCTION: Final = (
    "The measured controller is the process that runs on the machine: `python -m controller` with SCHED_FIFO and "
    "locked memory, beside the real guard, on the wire bus. Every CAN node of the machine is emulated, on joints that "
    "follow their valves, so that the processors are free for what is measured."
)

LOOPS: Final = {"wakeup": "Controller", "cyclictest": "cyclictest", "plain": "Sleep loop"}
QUANTILES: Final = {"p50": "median", "p99": "p99", "p999": "p99.9", "max": "longest"}
LATE: Final = "From the deadline to the first reading of the clock, in the loop's own histogram."
MISSED: Final = "Periods skipped, or by which a wake-up of cyclictest was late."


def _lateness(mark: str, where: str, *keys: str) -> tuple[Metric, ...]:
    """Define the quantiles of the lateness of the three loops; ``mark`` follows the names of the loops."""
    return tuple(
        Metric(f"{loop}{mark}_{key}_us", f"{title}{where}: lateness, {QUANTILES[key]}", "us", LATE)
        for key in keys
        for loop, title in LOOPS.items()
    )


def _missed(end: str, where: str) -> tuple[Metric, ...]:
    """Define the deadlines that each loop missed under load."""
    titles = {"": "controller", "_cyclictest": "cyclictest", "_plain": "sleep loop"}
    named = {f"missed_loaded{loop}{end}": f"Deadlines missed{where}: {title}" for loop, title in titles.items()}
    return tuple(Metric(name, title, "", MISSED) for name, title in named.items())


_FAST: Final = (
    "The limit is 25 % of the period; quietest windows. The wire bus runs at 4 Mbit/s: ten frames of 8 bytes per "
    "millisecond do not fit on a CAN bus of 1 Mbit/s."
)
_FILLED: Final = "No witness saw a stall before that is long enough to fill the transmit queue, or of 25 ms."
_BLOCKS: Final = "Of the interpreter: minimum of the second half of the windows less minimum of the first half."
_SWITCHES: Final = "One wait for SYNC and one for the tick."
_INTERPRETER: Final = "Kept recordings (`timberhand bench tick`), the smaller ratio of the two machines."
OWN: Final = Section(
    "Cost of the controller",
    "Page faults, garbage collection and system calls do not depend on the host's noise, so their limits hold on any "
    "host. CPU time does: other work replaces the tick's data in the caches, and what the hypervisor takes in the "
    "middle of a tick counts as the tick's. It is therefore judged in the quietest quarter of the windows, chosen by "
    "the processor time of the sleep loop alone, and a missed limit is *inconclusive* if cyclictest was late even in "
    "these. Three figures see a regression on any host: the tick's median in cycles of the sleep loop, which does the "
    "same each time on the same processor in the same seconds, the instructions of a tick, where the host counts "
    "them, and the ratios of interpreter and compiled tick, measured in turn. A lost frame or a stop counts against "
    "the controller unless a witness, a process with nothing to do and the highest priority of its processor, saw "
    "that processor stand still just before. The whole forwarder is on both buses and moves with every control law "
    "active; reports and a record of every tick leave the process as on the machine.",
    (
        Metric("tick_cpu_p50_us", "CPU time of a tick, median", "us", "The thread's own clock, 200 Hz.", most=150.0),
        Metric("tick_cpu_p99_us", "CPU time of a tick, p99", "us", "The limit is 6 % of the period.", most=300.0),
        Metric("tick_cpu_all_p50_us", "CPU time of a tick in all windows, median", "us"),
        Metric("tick_cpu_all_p99_us", "CPU time of a tick in all windows, p99", "us"),
        Metric("tick_cpu_in_plain", "CPU time of a tick in cycles of the sleep loop", "x", "Median of all windows."),
        Metric("plain_cpu_us", "CPU time of a cycle of the sleep loop, quietest windows", "us", "The host's speed."),
        Metric("plain_cpu_all_us", "CPU time of a cycle of the sleep loop, all windows", "us"),
        Metric("tick_p50_us", "Tick by the wall clock, median", "us", "From its first to its last stage."),
        Metric("tick_p99_us", "Tick by the wall clock, p99", "us"),
        Metric("tick_cpu_max_us", "CPU time of a tick, longest", "us", "Quietest windows."),
        Metric("tick_instructions", "Instructions of the controller per tick", "", "perf_event_open(2), with waits."),
        Metric("compiled_ratio_cold", "Interpreter over compiled tick, cold caches", "x", _INTERPRETER, least=2.0),
        Metric("compiled_ratio_hot", "Interpreter over compiled tick, hot caches", "x", _INTERPRETER, least=2.0),
        Metric("tick1k_cpu_p99_us", "CPU time of a tick at 1 kHz, fixed crane, p99", "us", _FAST, most=250.0),
        Metric("cpu_share", "CPU load of the controller at 200 Hz", "%", "getrusage, quiet windows."),
        Metric("frames_per_s", "Frames received and sent, both buses", "1/s", "The controller's own counters."),
        Metric(
            "frames_lost", "Frames refused by a bus or lost before they were read", "", "Its own counters.", most=0.0
        ),
        Metric("frames_lost_unexplained", "Lost frames without a stall of the host", "", _FILLED, most=0.0),
        Metric("machine_frames_lost", "Frames lost by the emulated machine", ""),
        Metric("records_lost", "Tick records lost on the way to the observer", "", "By their nominal times."),
        Metric("stalls", "Stalls of a processor that a witness saw", "", "3 ms or longer, whole measurement."),
        Metric("stall_max_ms", "Longest of them", "ms", "By the witness's own lateness."),
        Metric("page_faults", "Page faults", "", "Minor and major, all quiet windows.", most=0.0),
        Metric("gc_runs", "Runs of the garbage collector", "", most=0.0),
        Metric("allocated_blocks_growth", "Growth of allocated memory blocks", "", _BLOCKS, most=0.0),
        Metric("resident_growth_kb", "Growth of resident memory", "kB", "First to last reading.", most=0.0),
        Metric("syscalls_per_tick", "System calls per tick", "", "By strace, after the measurement.", most=60.0),
        Metric("voluntary_switches_per_tick", "Voluntary context switches per tick", "", _SWITCHES, most=2.05),
        Metric("involuntary_switches_per_tick", "Involuntary context switches per tick", ""),
    ),
    (("stages.png", "Duration of the stages of a tick: median, p99 and longest (log scale)."),),
)
_RATIO = "Interpolated inside the bins of 1 us; 95 % interval over the windows."
WAKEUPS: Final = Section(
    "Wake-ups compared with cyclictest",
    "The lateness of a wake-up depends more on the host than on the controller. Therefore cyclictest (rt-tests, in C, "
    "without work) wakes at the controller's priority on its core during the same seconds, 0.8 of a period after the "
    "tick, and a `time.sleep` loop of normal priority runs beside it. Only windows in which cyclictest shows a quiet "
    "host are compared: its longest lateness is at most a fifth of the period, its p99 at most a twentieth, and steal "
    "at most 0.5 %. If fewer than half of the windows are quiet, the host is too noisy, and these metrics are "
    "*inconclusive* whatever their values.",
    (
        Metric("host_verdict", "Host quiet enough (1 yes, 0 no)", ""),
        Metric("quiet_windows", "Quiet windows", ""),
        Metric("windows", "All windows", ""),
        *_lateness("", "", *QUANTILES),
        Metric("wakeup_p50_ratio", "Ratio of the medians, controller over cyclictest", "x", _RATIO, most=1.5),
        Metric("wakeup_p99_ratio", "Ratio of the p99", "x", _RATIO, most=2.0),
        Metric("judged_cycles", "Cycles compared", "", "Ticks of the controller in these windows."),
        Metric("missed", "Deadlines missed in these cycles", "", "The limit is zero in 100,000 cycles.", most=0.0),
        Metric("steal_ms", "Time taken by the hypervisor", "ms", "/proc/stat, all processors, all windows."),
        Metric("pressure", "Share of time in which a process waited for a processor", "%", "/proc/pressure/cpu."),
    ),
    (("wakeups.png", "Lateness of wake-ups on a quiet host and with every core loaded; dashed: one period."),),
)
_STALLED: Final = "No witness saw a stall of 10 ms or more in the 0.45 s before."
LOADED: Final = Section(
    "Wake-ups with every core loaded",
    "stress-ng keeps every core and the memory busy. The sleep loop runs during the same seconds on the same core and "
    "in the same session, like a script started from the terminal of the load.",
    (
        *_lateness("_loaded", "", "p50", "p99"),
        *_missed("", ""),
        Metric(
            "missed_loaded_share", "Deadlines missed, controller over sleep loop", "%", "200 Hz.", most=MAX_MISSED_SHARE
        ),
        *_lateness("1k", " at 1 kHz, quiet", "p99"),
        Metric("missed_1k", "Deadlines missed by the controller at 1 kHz, quiet", "", "Fixed crane."),
        *_missed("_1k", " at 1 kHz"),
        Metric("stops", "Stops of the machine in the whole measurement", "", "Late inputs or a late loop.", most=0.0),
        Metric("stops_unexplained", "Stops without a stall of the host", "", _STALLED, most=0.0),
    ),
)
FRAME: Final = "On this host, the same frames (`timberhand bench bus`)."
_SAMPLE: Final = "From the encoders' sample to the valve command"
_SYNC: Final = "From the time stamp of SYNC on the wire bus to the command passed to the bus, 200 Hz, quiet windows."
_PERIOD: Final = "The limit is one period."
LATENCY: Final = Section(
    "From sample to command",
    "The encoders sample on SYNC; the tick that uses the samples sends the valve command. The wire bus gives every "
    "frame its transmission time.",
    (
        Metric("sample_to_command_p50_us", f"{_SAMPLE}, median", "us", _SYNC),
        Metric("sample_to_command_p99_us", f"{_SAMPLE}, p99", "us", _PERIOD, most=5000.0, clocked=True),
        Metric("rx_decode_us", "Receiving and decoding one frame, raw socket", "us", FRAME, most=5.0, clocked=True),
        Metric("rx_decode_pythoncan_us", "Receiving and decoding one frame, python-can", "us", FRAME),
    ),
    (("ages.png", "Age of every input when a tick used it: newest and longest."),),
)
SECTIONS: Final = (OWN, WAKEUPS, LOADED, LATENCY)
METRICS: Final = tuple(m for section in SECTIONS for m in section.metrics)


QUIET_LONGEST_SHARE: Final = 0.2
QUIET_P99_SHARE: Final = 0.05
"""Lateness of cyclictest in a quiet window, longest and at p99, as a share of the period."""
QUIET_STEAL_SHARE: Final = 0.005
"""Share of the time of one processor that the hypervisor may take in a quiet window."""
QUIET_WINDOW_SHARE: Final = 0.5
"""Share of quiet windows from which on the host counts as quiet."""
MIN_RATIO_CYCLES: Final = 10_000
MIN_MISS_CYCLES: Final = 100_000
MIN_STEADY_TICKS: Final = 10_000
MIN_CPU_TICKS: Final = 1_000
COST_WINDOW_SHARE: Final = 0.25
"""Share of the windows in which the processor time of a tick is judged: the quietest."""
STILL_P99_NS: Final = 100_000
"""Lateness of cyclictest at p99 [ns] up to which a window shows the processor time of a tick; beyond it other work has
replaced the tick's data in the caches, or the hypervisor's time counts as the thread's."""
STILL_PRESSURE: Final = 0.3
"""Share of time in which a process waits for a processor; the testbed itself causes about half of it."""
MIN_PLAIN_MISSED: Final = 100.0
"""Deadlines that the sleep loop has to miss before one percent of them means something."""
EDGES_NS: Final = np.array([0, *(edge_ns(i) for i in range(BINS))], float)
OTHERS: Final = ("machine_frames_lost", "machine_stalls", "records_lost")
"""Counters of emulated machine and observer."""


@dataclass(frozen=True, slots=True)
class Measured:
    """Measurements of one testbed; ``calls``: system calls by name, and the number of ticks that made them."""

    quiet: list[MeasurementWindow]
    loaded: list[MeasurementWindow]
    calls: tuple[dict[str, int], float] | None = None
    events: Events = field(default_factory=Events)
    others: Mapping[str, float] = field(default_factory=dict)
    """The counters `OTHERS` over the whole measurement."""


def gather(slow: Measured, fast: Measured) -> tuple[dict[str, float], list[MeasurementWindow]]:
    """Compute all metrics of the testbeds at 200 Hz and at 1 kHz, and select the windows to compare."""
    compared, enough = compared_windows(slow.quiet)
    pressures = [w.host.pressure for w in slow.quiet if w.host.pressure is not None]
    ours, theirs = [w.durations["wake"] for w in compared], [w.cyclictest for w in compared]
    executed = [w.instructions for w in slow.quiet if w.instructions is not None]
    ticks = sum(w.ticks for w in slow.quiet)
    return {
        **process_metrics(slow.quiet),
        "host_verdict": float(enough),
        "windows": float(len(slow.quiet)),
        "quiet_windows": float(sum(map(quiet, slow.quiet))),
        "steal_ms": sum(w.host.steal_ms for w in slow.quiet),
        "pressure": sum(pressures) / len(pressures) if pressures else math.nan,
        **spread_us("tick", pooled([w.durations["tick"] for w in compared])),
        **spread_us("sample_to_command", pooled([w.durations["sample_to_command"] for w in compared])),
        **cost_metrics("tick_cpu", slow.quiet),
        **cost_metrics("tick1k_cpu", fast.quiet),
        "plain_cpu_us": median(w.plain_cpu_us for w in quietest_windows(slow.quiet)),
        "plain_cpu_all_us": median(w.plain_cpu_us for w in slow.quiet),
        "tick_cpu_in_plain": median(w.durations["cpu"].quantile_ns(0.5) / 1e3 / w.plain_cpu_us for w in slow.quiet),
        **wakeups("", compared),
        **wakeups("_loaded", slow.loaded),
        **wakeups("1k", fast.quiet),
        **loaded("", slow.loaded),
        **loaded("_1k", fast.loaded),
        **event_metrics([slow.events, fast.events]),
        **system_call_metrics(slow.calls),
        **{name: sum(m.others.get(name, 0.0) for m in (slow, fast)) for name in OTHERS},
        "period_us": slow.quiet[0].end.period_ns / 1e3,
        "judged_cycles": float(sum(w.ticks + w.missed for w in compared)),
        "missed": float(sum(w.missed for w in compared)),
        "ticks_1k": float(sum(w.ticks for w in fast.quiet)),
        "missed_1k": float(sum(w.missed for w in fast.quiet)),
        **ratio("wakeup_p50_ratio", ours, theirs, 0.5),
        **ratio("wakeup_p99_ratio", ours, theirs, 0.99),
        **({"tick_instructions": sum(executed) / max(1, ticks)} if executed else {}),
    }, compared


def quiet(window: MeasurementWindow) -> bool:
    """Tell whether cyclictest and the steal counter show a quiet host."""
    period_ns = window.end.period_ns
    longest_ns, p99_ns = QUIET_LONGEST_SHARE * period_ns, QUIET_P99_SHARE * period_ns
    return window.cyclictest.longest_ns <= longest_ns and _calm(window, p99_ns)


def still(window: MeasurementWindow) -> bool:
    """Tell whether the host left the processor and its caches alone, as far as cyclictest, steal and pressure tell."""
    return (window.host.pressure or 0.0) <= STILL_PRESSURE and _calm(window, STILL_P99_NS)


def _calm(window: MeasurementWindow, p99_ns: float) -> bool:
    stolen_ms = QUIET_STEAL_SHARE * 1e3 * window.host.seconds
    return window.cyclictest.quantile_ns(0.99) <= p99_ns and window.host.steal_ms <= stolen_ms


def compared_windows(windows: Sequence[MeasurementWindow]) -> tuple[list[MeasurementWindow], bool]:
    """Select the quiet windows and return True; all windows and False if too few are quiet."""
    good = [w for w in windows if quiet(w)]
    enough = len(good) >= QUIET_WINDOW_SHARE * len(windows)
    return (good, True) if enough and good else (list(windows), False)


def quietest_windows(windows: Sequence[MeasurementWindow]) -> list[MeasurementWindow]:
    """Select the quietest quarter, at least one, by the sleep loop's processor time: our own times choose nothing.

    What makes that loop dear, other machines' work in the shared caches, makes a tick dear; cyclictest's lateness does
    not tell these windows apart.
    """
    ordered = sorted(windows, key=lambda w: w.plain_cpu_us)
    return ordered[: max(1, math.ceil(COST_WINDOW_SHARE * len(ordered)))]


def cost_metrics(name: str, windows: Sequence[MeasurementWindow]) -> dict[str, float]:
    """Compute the processor time of a tick, in the quietest windows and in all; was the host still in the former?"""
    judged = quietest_windows(windows)
    metrics = spread_us(name, pooled([w.durations["cpu"] for w in judged]))
    metrics |= spread_us(f"{name}_all", pooled([w.durations["cpu"] for w in windows]))
    return metrics | {f"{name}_host_still": float(all(map(still, judged)))}


def pooled(histograms: Sequence[Durations]) -> Durations:
    """Add up histograms."""
    bins = np.sum([np.zeros(BINS), *(np.asarray(h.bins) for h in histograms)], axis=0).astype(np.uint64)
    longest_ns = max((h.longest_ns for h in histograms), default=0)
    return Durations(bins.tobytes(), longest_ns, sum(h.total_ns for h in histograms))


def quantile_us(histogram: Durations, share: float) -> float:
    """Compute a quantile [us], interpolated linearly inside its bin; NaN without entries."""
    bins = np.array(histogram.bins)
    if not bins.any():
        return math.nan
    reached = np.cumsum(bins)
    i = int(np.searchsorted(reached, share * reached[-1]))
    inside = (share * reached[-1] - (reached[i] - bins[i])) / bins[i]
    top_ns = histogram.longest_ns if i == BINS - 1 else min(EDGES_NS[i + 1], histogram.longest_ns)
    return float(EDGES_NS[i] + inside * max(0.0, top_ns - EDGES_NS[i])) / 1e3


def spread_us(name: str, histogram: Durations) -> dict[str, float]:
    """Compute the metrics ``NAME_p50_us``, p99, p99.9 and the longest [us]."""
    shares = {"p50": 0.5, "p99": 0.99, "p999": 0.999}
    metrics = {f"{name}_{k}_us": quantile_us(histogram, share) for k, share in shares.items()}
    return metrics | {f"{name}_max_us": histogram.longest_ns / 1e3 if histogram.count else math.nan}


def ratio(name: str, ours: Sequence[Durations], theirs: Sequence[Durations], share: float) -> dict[str, float]:
    """Compute the ratio of a quantile over all windows, with the 95 % interval of the windows' own ratios."""

    def of(a: Durations, b: Durations) -> float:
        below = quantile_us(b, share)
        return quantile_us(a, share) / below if below else math.nan

    low, high = median_interval([of(a, b) for a, b in zip(ours, theirs, strict=True)])
    whole = of(pooled(ours), pooled(theirs))
    return {name: whole, f"{name}_low": low, f"{name}_high": high, f"{name}_n": float(len(ours))}


def process_metrics(windows: Sequence[MeasurementWindow]) -> dict[str, float]:
    """Compute the counters of the process over all windows: totals, or per tick where the name says so."""
    begin, end = windows[0].begin, windows[-1].end
    first, last = begin.process, end.process
    span = max(1, end.ticks - begin.ticks)
    return {
        "ticks": float(max(1, sum(w.ticks for w in windows))),
        "page_faults": float(last.minor_faults + last.major_faults - first.minor_faults - first.major_faults),
        "gc_runs": float(last.gc_runs - first.gc_runs),
        "allocated_blocks_growth": block_growth([*(w.begin for w in windows), end]),
        "resident_growth_kb": float(last.resident_kb - first.resident_kb),
        "voluntary_switches_per_tick": (last.voluntary_switches - first.voluntary_switches) / span,
        "involuntary_switches_per_tick": (last.involuntary_switches - first.involuntary_switches) / span,
        **Span(begin, end, {}, None).load,
    }


def block_growth(readings: Sequence[Facts]) -> float:
    """Compute the growth of the interpreter's memory blocks between the halves of the readings, of their minima:
    blocks come and go.
    """
    blocks = [facts.process.allocated_blocks for facts in readings]
    half = max(1, len(blocks) // 2)
    return float(min(blocks[half:]) - min(blocks[:half]))


def system_call_metrics(calls: tuple[dict[str, int], float] | None) -> dict[str, float]:
    """Compute the system calls per tick, in total and by name; NaN if the process cannot be traced."""
    by_name, ticks = calls or ({}, math.nan)
    each = {f"syscalls_{name}": count / ticks for name, count in by_name.items()}
    return {"syscalls_per_tick": sum(by_name.values()) / ticks, **each}


def loops(windows: Sequence[MeasurementWindow]) -> tuple[Durations, Durations, Durations]:
    """Add up the histograms of controller, cyclictest and sleep loop over all windows."""
    histograms = [(w.durations["wake"], w.cyclictest, w.plain) for w in windows]
    ours, theirs, plain = (pooled(column) for column in zip(*histograms, strict=True))
    return ours, theirs, plain


def wakeups(mark: str, windows: Sequence[MeasurementWindow]) -> dict[str, float]:
    """Compute the lateness of the wake-ups of controller, cyclictest and sleep loop; ``mark`` follows their names."""
    spreads = [spread_us(f"{name}{mark}", lateness) for name, lateness in zip(LOOPS, loops(windows), strict=True)]
    return {name: us for spread in spreads for name, us in spread.items()}


def loaded(end: str, windows: Sequence[MeasurementWindow]) -> dict[str, float]:
    """Count the missed deadlines of the three loops under load; ``end`` is the suffix of the metric names."""
    ours, plain = sum(w.missed for w in windows), sum(w.plain_missed for w in windows)
    return {
        f"missed_loaded{end}": float(ours),
        f"missed_loaded_plain{end}": float(plain),
        f"missed_loaded_cyclictest{end}": float(sum(w.cyclictest.periods(w.end.period_ns) for w in windows)),
        f"missed_loaded{end}_share": ours / plain if plain else math.nan,
    }


def undecided(metrics: Mapping[str, float]) -> dict[str, str]:
    """List the metrics that a run with these values cannot decide, with the reason."""
    reasons: dict[str, str] = {}
    noisy = "cyclictest itself was late: the host is too noisy"
    quiet_host, cycles, ticks = metrics["host_verdict"], metrics["judged_cycles"], metrics["ticks"]

    def need(name: str, count: float, least: int, unit: str) -> bool:
        if count < least:
            reasons[name] = f"{count:.0f} {unit} are too few; at least {least} are needed"
        return count >= least

    for name in ("wakeup_p50_ratio", "wakeup_p99_ratio"):
        need(name, cycles, MIN_RATIO_CYCLES, "cycles")
        reasons |= {} if quiet_host else {name: noisy}
    if not metrics["missed"]:
        need("missed", cycles, MIN_MISS_CYCLES, "cycles")
    elif not quiet_host:
        reasons["missed"] = noisy
    for name in ("page_faults", "gc_runs", "allocated_blocks_growth"):
        if metrics[name] <= 0.0:
            need(name, ticks, MIN_STEADY_TICKS, "ticks")
    limits = {m.name: m.most or math.inf for m in METRICS}
    cost = {"tick_cpu_p50_us": ticks, "tick_cpu_p99_us": ticks, "tick1k_cpu_p99_us": metrics.get("ticks_1k", 0.0)}
    for name, count in cost.items():
        still_host = metrics[f"{name.partition('_p')[0]}_host_still"]
        if need(name, count, MIN_CPU_TICKS, "ticks") and metrics[name] > limits[name] and not still_host:
            reasons[name] = "even the quietest windows were noisy, and noise adds to the processor time"
    reasons |= explained(metrics)
    if not quiet_host and metrics.get("sample_to_command_p99_us", 0.0) > metrics["period_us"]:
        reasons["sample_to_command_p99_us"] = noisy
    ours, plain = metrics["missed_loaded"], metrics["missed_loaded_plain"]
    if ours and metrics["missed_loaded_cyclictest"] >= ours:
        reasons["missed_loaded_share"] = "cyclictest missed as many deadlines: the host withheld the processor"
    elif plain < MIN_PLAIN_MISSED and ours * 100.0 <= plain:
        few = f"the sleep loop missed only {plain:.0f} deadlines, too few to decide a limit of one percent"
        reasons["missed_loaded_share"] = few
    return unmeasured(METRICS, metrics) | reasons


def unmeasured(definitions: Iterable[Metric], metrics: Mapping[str, float]) -> dict[str, str]:
    """List the metrics with a limit that have no value: inconclusive, with the reason."""
    missing = [m.name for m in definitions if m.limit_text() and math.isnan(metrics.get(m.name, math.nan))]
    return dict.fromkeys(missing, "it could not be measured here")
