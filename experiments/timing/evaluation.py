"""Turns measurement windows into metrics and compares them with their limits; pure.

Metrics that depend on the host's clock are compared with cyclictest in the same windows, and only in those in which
cyclictest shows a quiet host.  cyclictest wakes once per period of the controller, so a stall of the host that is long
enough for a missed deadline shows there too.  If too few windows are quiet, or a run is too short, such a metric is
inconclusive, whatever its value.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from can_dbc.timing.durations import BINS, Durations, edge_ns
from experiments.common.result import Metric
from experiments.timing.measurement import MeasurementWindow, pooled
from experiments.timing.metrics import METRICS

QUIET_LONGEST_SHARE: Final = 0.2
"""Longest lateness of cyclictest in a quiet window, as a share of the period."""
QUIET_P99_SHARE: Final = 0.05
"""Lateness of cyclictest at p99 in a quiet window, as a share of the period."""
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
RESAMPLE_COUNT: Final = 400
EDGES_NS: Final = np.array([0, *(edge_ns(i) for i in range(BINS))], float)


def quiet(window: MeasurementWindow) -> bool:
    """Whether cyclictest and the steal counter show a quiet host."""
    period_ns = window.end.period_ns
    return (
        window.cyclictest.longest_ns <= QUIET_LONGEST_SHARE * period_ns
        and window.cyclictest.quantile_ns(0.99) <= QUIET_P99_SHARE * period_ns
        and window.host.steal_ms <= QUIET_STEAL_SHARE * 1e3 * window.host.seconds
    )


def compared_windows(windows: Sequence[MeasurementWindow]) -> tuple[list[MeasurementWindow], bool]:
    """The quiet windows and True; all windows and False if too few are quiet."""
    good = [w for w in windows if quiet(w)]
    enough = len(good) >= QUIET_WINDOW_SHARE * len(windows)
    return (good, True) if enough and good else (list(windows), False)


def quietest_windows(windows: Sequence[MeasurementWindow]) -> list[MeasurementWindow]:
    """The quietest quarter, at least one, by the sleep loop's processor time alone: our own times choose nothing.

    The loop does the same in every cycle, on the same processor in the same seconds.  What makes it dear, other
    machines' work in the shared caches, makes a tick dear; cyclictest's lateness does not tell these windows apart.
    """
    ordered = sorted(windows, key=lambda w: w.sleep_loop.cpu_us)
    return ordered[: max(1, math.ceil(COST_WINDOW_SHARE * len(ordered)))]


def host_speed(windows: Sequence[MeasurementWindow]) -> dict[str, float]:
    """Processor time of the sleep loop's cycle [us], and the tick's median in such cycles: the median window's."""
    in_cycles = [w.durations["cpu"].quantile_ns(0.5) / 1e3 / w.sleep_loop.cpu_us for w in windows]
    return {
        "plain_cpu_us": float(np.median([w.sleep_loop.cpu_us for w in quietest_windows(windows)])),
        "plain_cpu_all_us": float(np.median([w.sleep_loop.cpu_us for w in windows])),
        "tick_cpu_in_plain": float(np.median(in_cycles)),
    }


def still(window: MeasurementWindow) -> bool:
    """Whether the host left the processor and its caches alone, as far as cyclictest, steal and pressure tell."""
    return (
        window.cyclictest.quantile_ns(0.99) <= STILL_P99_NS
        and window.host.steal_ms <= QUIET_STEAL_SHARE * 1e3 * window.host.seconds
        and (window.host.pressure or 0.0) <= STILL_PRESSURE
    )


def quantile_us(bins: np.ndarray, share: float, longest_ns: float) -> float:
    """A quantile [us], interpolated linearly inside its bin; NaN without entries."""
    total = bins.sum()
    if not total:
        return math.nan
    cumulated = np.cumsum(bins)
    i = int(np.searchsorted(cumulated, share * total))
    low, high = EDGES_NS[i], min(EDGES_NS[i + 1], max(longest_ns, EDGES_NS[i])) if i < BINS - 1 else longest_ns
    inside = (share * total - (cumulated[i] - bins[i])) / bins[i]
    return float(low + inside * (high - low)) / 1e3


def spread_us(name: str, histogram: Durations) -> dict[str, float]:
    """Metrics ``NAME_p50_us``, p99, p99.9 and the longest [us]."""
    bins, longest = np.array(histogram.bins), histogram.longest_ns
    shares = {"p50": 0.5, "p99": 0.99, "p999": 0.999}
    found = {f"{name}_{k}_us": quantile_us(bins, share, longest) for k, share in shares.items()}
    return found | {f"{name}_max_us": longest / 1e3 if histogram.count else math.nan}


def ratio(name: str, ours: Sequence[Durations], theirs: Sequence[Durations], share: float) -> dict[str, float]:
    """Ratio of a quantile over all windows as metric ``name``, with a 95 % bootstrap interval over the windows."""
    a, b = (np.array([h.bins for h in side], float) for side in (ours, theirs))
    tops = [max((h.longest_ns for h in side), default=0) for side in (ours, theirs)]

    def of(picked: np.ndarray) -> float:
        up, down = (quantile_us(side[picked].sum(0), share, top) for side, top in zip((a, b), tops, strict=True))
        return up / down if down else math.nan

    n = len(ours)
    if n == 0:
        return {name: math.nan}
    every = np.arange(n)
    rng = np.random.default_rng(1)
    drawn = [of(rng.integers(0, n, n)) for _ in range(RESAMPLE_COUNT)] if n > 1 else [of(every)]
    low, high = np.quantile(drawn, (0.025, 0.975))
    return {name: of(every), f"{name}_low": float(low), f"{name}_high": float(high), f"{name}_n": float(n)}


def process_metrics(windows: Sequence[MeasurementWindow]) -> dict[str, float]:
    """Counters of the process over all windows: totals, or per tick where the name says so."""
    ticks = max(1, sum(w.ticks for w in windows))
    first, last = windows[0].begin.process, windows[-1].end.process
    span = max(1, windows[-1].end.ticks - windows[0].begin.ticks)
    frames = sum(b.received + b.sent for b in windows[-1].end.buses)
    frames -= sum(b.received + b.sent for b in windows[0].begin.buses)
    return {
        "ticks": float(ticks),
        "page_faults": float(last.minor_faults + last.major_faults - first.minor_faults - first.major_faults),
        "gc_runs": float(last.gc_runs - first.gc_runs),
        "allocated_blocks_growth": float(block_growth(windows)),
        "resident_growth_kb": float(last.resident_kb - first.resident_kb),
        "voluntary_switches_per_tick": (last.voluntary_switches - first.voluntary_switches) / span,
        "involuntary_switches_per_tick": (last.involuntary_switches - first.involuntary_switches) / span,
        "cpu_share": (last.cpu_ns - first.cpu_ns) / (windows[-1].end.written_ns - windows[0].begin.written_ns),
        "frames_per_s": frames / ((windows[-1].end.written_ns - windows[0].begin.written_ns) * 1e-9),
    }


def block_growth(windows: Sequence[MeasurementWindow]) -> int:
    """Growth of the interpreter's memory blocks: minimum of the second half of the readings less that of the first.

    The minima remove blocks that come and go between readings.
    """
    readings = [w.begin.process.allocated_blocks for w in windows] + [windows[-1].end.process.allocated_blocks]
    half = max(1, len(readings) // 2)
    return min(readings[half:]) - min(readings[:half])


def host_metrics(windows: Sequence[MeasurementWindow], enough: bool) -> dict[str, float]:
    """Metrics of the host."""
    seconds = sum(w.host.seconds for w in windows)
    pressures = [w.host.pressure for w in windows if w.host.pressure is not None]
    return {
        "host_verdict": float(enough),
        "windows": float(len(windows)),
        "quiet_windows": float(sum(map(quiet, windows))),
        "steal_ms": sum(w.host.steal_ms for w in windows),
        "measured_s": seconds,
        "pressure": sum(pressures) / len(pressures) if pressures else math.nan,
        "load_average": max(w.host.load for w in windows),
    }


@dataclass(frozen=True, slots=True)
class Evaluation:
    """Names of the missed metrics, and the inconclusive ones with their reason."""

    missed: tuple[str, ...]
    inconclusive: dict[str, str]


def evaluate(definitions: Iterable[Metric], metrics: Mapping[str, float], undecidable: Mapping[str, str]) -> Evaluation:
    """Compare every metric that has a limit with it.

    ``undecidable``: metrics that this run cannot decide, with the reason.  They are inconclusive even if their value
    meets the limit.  A metric without a value is inconclusive, too.
    """
    missed, inconclusive = [], {}
    for metric in definitions:
        if metric.least is None and metric.most is None:
            continue
        value = metrics.get(metric.name, math.nan)
        if metric.name in undecidable:
            inconclusive[metric.name] = undecidable[metric.name]
        elif math.isnan(value):
            inconclusive[metric.name] = "it could not be measured here"
        elif not metric.holds(value):
            missed.append(metric.name)
    return Evaluation(tuple(missed), inconclusive)


def undecided(metrics: Mapping[str, float]) -> dict[str, str]:
    """The metrics that a run with these values cannot decide, with the reason."""
    found: dict[str, str] = {}
    noisy = "cyclictest itself was late: the host is too noisy"
    ticks = metrics["ticks"]
    for name in ("wakeup_p50_ratio", "wakeup_p99_ratio"):
        if not metrics["host_verdict"]:
            found[name] = noisy
        elif metrics["judged_cycles"] < MIN_RATIO_CYCLES:
            found[name] = f"{metrics['judged_cycles']:.0f} cycles are too few; at least {MIN_RATIO_CYCLES} are needed"
    if not metrics["host_verdict"] and metrics["missed"]:
        found["missed"] = noisy
    elif metrics["judged_cycles"] < MIN_MISS_CYCLES and not metrics["missed"]:
        found["missed"] = f"{metrics['judged_cycles']:.0f} cycles are too few; at least {MIN_MISS_CYCLES} are needed"
    for name in ("page_faults", "gc_runs", "allocated_blocks_growth"):
        if ticks < MIN_STEADY_TICKS and metrics[name] <= 0.0:
            found[name] = f"{ticks:.0f} ticks are too few; at least {MIN_STEADY_TICKS} are needed"
    cost = (("tick_cpu_p50_us", ticks), ("tick_cpu_p99_us", ticks), ("tick1k_cpu_p99_us", metrics.get("ticks_1k", 0.0)))
    for name, count in cost:
        most = next(m.most for m in METRICS if m.name == name) or math.inf
        if count < MIN_CPU_TICKS:
            found[name] = f"{count:.0f} ticks are too few; at least {MIN_CPU_TICKS} are needed"
        elif metrics[name] > most and not metrics[f"{name.partition('_p')[0]}_host_still"]:
            found[name] = "even the quietest windows were noisy, and noise adds to the processor time"
    for name in ("frames_lost", "stops"):
        if metrics.get(name) and not metrics[f"{name}_unexplained"]:
            found[name] = (
                f"the host withheld a processor for up to {metrics['stall_max_ms']:.0f} ms; a witness saw a stall "
                "before each of them"
            )
    if not metrics["host_verdict"] and metrics.get("sample_to_command_p99_us", 0.0) > metrics["period_us"]:
        found["sample_to_command_p99_us"] = noisy
    for end in ("", "_1k"):
        if reason := _loaded_undecidable(metrics, end):
            found[f"missed_loaded{end}_share"] = reason
    return found


def _loaded_undecidable(metrics: Mapping[str, float], end: str) -> str:
    """Why the comparison under load is inconclusive; empty if it is not."""
    ours, plain = metrics.get(f"missed_loaded{end}", 0.0), metrics.get(f"missed_loaded_plain{end}", 0.0)
    if ours and metrics.get(f"missed_loaded_cyclictest{end}", 0.0) >= ours:
        return "cyclictest missed as many deadlines: the host withheld the processor"
    if plain < 100.0 and ours * 100.0 <= plain:
        return f"the sleep loop missed only {plain:.0f} deadlines, too few to decide a limit of one percent"
    return ""


def wakeups(kind: str, windows: Sequence[MeasurementWindow]) -> dict[str, float]:
    """Lateness of the wake-ups of controller, cyclictest and sleep loop, as metrics whose names begin with ``kind``."""
    found: dict[str, float] = {}
    ours, theirs, plain = loops(windows)
    for name, histogram in (("wakeup", ours), ("cyclictest", theirs), ("plain", plain)):
        found |= spread_us(f"{kind}{name}", histogram)
    return found


def loops(windows: Sequence[MeasurementWindow]) -> tuple[Durations, Durations, Durations]:
    """Histograms of controller, cyclictest and sleep loop over all windows."""
    return (
        pooled([w.durations["wake"] for w in windows]),
        pooled([w.cyclictest for w in windows]),
        pooled([w.sleep_loop.lateness for w in windows]),
    )
