"""Turns measurement windows into metrics and compares them with their limits; pure.

Metrics that depend on the host's clock are compared with cyclictest in the same windows, and only in those in which
cyclictest shows a quiet host.  cyclictest wakes once per period of the controller, so a stall of the host that is long
enough for a missed deadline shows there too.  If too few windows are quiet, or a run is too short, such a metric is
inconclusive, whatever its value.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from can_dbc.timing.durations import BINS, Durations, edge_ns
from can_dbc.timing.page import Facts
from experiments.common.result import Metric
from experiments.timing.events import Events, event_metrics, explained
from experiments.timing.measurement import MeasurementWindow
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
MIN_PLAIN_MISSED: Final = 100.0
"""Deadlines that the sleep loop has to miss before one percent of them means something."""
RESAMPLE_COUNT: Final = 400
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
    instructions: float = math.nan
    """Instructions of the controller's thread per period over the quiet windows; NaN if the host does not count."""
    others: Mapping[str, float] = field(default_factory=dict)
    """The counters `OTHERS` over the whole measurement."""


def gather(slow: Measured, fast: Measured) -> tuple[dict[str, float], list[MeasurementWindow]]:
    """All metrics of the testbeds at 200 Hz and at 1 kHz, and the windows that were compared."""
    compared, enough = compared_windows(slow.quiet)
    pressures = [w.host.pressure for w in slow.quiet if w.host.pressure is not None]
    metrics = {
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
        **host_speed(slow.quiet),
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
    }
    for name, share in (("p50", 0.5), ("p99", 0.99)):
        ours, theirs = [w.durations["wake"] for w in compared], [w.cyclictest for w in compared]
        metrics |= ratio(f"wakeup_{name}_ratio", ours, theirs, share)
    if not math.isnan(slow.instructions):
        metrics["tick_instructions"] = slow.instructions
    return metrics, compared


def quiet(window: MeasurementWindow) -> bool:
    """Whether cyclictest and the steal counter show a quiet host."""
    period_ns = window.end.period_ns
    return (
        window.cyclictest.longest_ns <= QUIET_LONGEST_SHARE * period_ns
        and window.cyclictest.quantile_ns(0.99) <= QUIET_P99_SHARE * period_ns
        and window.host.steal_ms <= QUIET_STEAL_SHARE * 1e3 * window.host.seconds
    )


def still(window: MeasurementWindow) -> bool:
    """Whether the host left the processor and its caches alone, as far as cyclictest, steal and pressure tell."""
    return (
        window.cyclictest.quantile_ns(0.99) <= STILL_P99_NS
        and window.host.steal_ms <= QUIET_STEAL_SHARE * 1e3 * window.host.seconds
        and (window.host.pressure or 0.0) <= STILL_PRESSURE
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


def cost_metrics(name: str, windows: Sequence[MeasurementWindow]) -> dict[str, float]:
    """Processor time of a tick in the quietest windows and in all, and whether the host was still in the former."""
    judged = quietest_windows(windows)
    found = spread_us(name, pooled([w.durations["cpu"] for w in judged]))
    found |= spread_us(f"{name}_all", pooled([w.durations["cpu"] for w in windows]))
    return found | {f"{name}_host_still": float(all(map(still, judged)))}


def host_speed(windows: Sequence[MeasurementWindow]) -> dict[str, float]:
    """Processor time of the sleep loop's cycle [us], and the tick's median in such cycles: the median window's."""
    in_cycles = [w.durations["cpu"].quantile_ns(0.5) / 1e3 / w.sleep_loop.cpu_us for w in windows]
    return {
        "plain_cpu_us": float(np.median([w.sleep_loop.cpu_us for w in quietest_windows(windows)])),
        "plain_cpu_all_us": float(np.median([w.sleep_loop.cpu_us for w in windows])),
        "tick_cpu_in_plain": float(np.median(in_cycles)),
    }


def pooled(histograms: Sequence[Durations]) -> Durations:
    """The sum of histograms."""
    bins = np.sum([np.zeros(BINS), *(np.asarray(h.bins) for h in histograms)], axis=0).astype(np.uint64)
    longest_ns = max((h.longest_ns for h in histograms), default=0)
    return Durations(bins.tobytes(), longest_ns, sum(h.total_ns for h in histograms))


def quantile_us(bins: np.ndarray, share: float, longest_ns: float) -> float:
    """A quantile [us], interpolated linearly inside its bin; NaN without entries."""
    if not bins.any():
        return math.nan
    tops = np.minimum(EDGES_NS[1:], longest_ns)
    tops[-1] = longest_ns  # of the bin that holds the rest
    cumulated = np.cumsum(bins)
    i = int(np.searchsorted(cumulated, share * cumulated[-1]))
    inside = (share * cumulated[-1] - (cumulated[i] - bins[i])) / bins[i]
    return float(EDGES_NS[i] + inside * (max(tops[i], EDGES_NS[i]) - EDGES_NS[i])) / 1e3


def spread_us(name: str, histogram: Durations) -> dict[str, float]:
    """Metrics ``NAME_p50_us``, p99, p99.9 and the longest [us]."""
    bins, longest = np.array(histogram.bins), histogram.longest_ns
    shares = {"p50": 0.5, "p99": 0.99, "p999": 0.999}
    found = {f"{name}_{k}_us": quantile_us(bins, share, longest) for k, share in shares.items()}
    return found | {f"{name}_max_us": longest / 1e3 if bins.any() else math.nan}


def ratio(name: str, ours: Sequence[Durations], theirs: Sequence[Durations], share: float) -> dict[str, float]:
    """Ratio of a quantile over all windows as metric ``name``, with a 95 % bootstrap interval over the windows."""
    a, b = (np.array([h.bins for h in side], float) for side in (ours, theirs))
    tops = [max((h.longest_ns for h in side), default=0) for side in (ours, theirs)]

    def of(picked: np.ndarray) -> float:
        up, down = (quantile_us(side[picked].sum(0), share, top) for side, top in zip((a, b), tops, strict=True))
        return up / down if down else math.nan

    n, rng = len(ours), np.random.default_rng(1)
    drawn = [of(rng.integers(0, n, n)) for _ in range(RESAMPLE_COUNT)]
    low, high = np.quantile(drawn, (0.025, 0.975))
    return {name: of(np.arange(n)), f"{name}_low": float(low), f"{name}_high": float(high), f"{name}_n": float(n)}


def process_metrics(windows: Sequence[MeasurementWindow]) -> dict[str, float]:
    """Counters of the process over all windows: totals, or per tick where the name says so."""
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
        **load_metrics(begin, end),
    }


def load_metrics(begin: Facts, end: Facts) -> dict[str, float]:
    """Share of a processor that the controller used between two pages, and its frames per second, both directions."""
    seconds = (end.written_ns - begin.written_ns) * 1e-9
    frames = [sum(b.received + b.sent for b in facts.buses) for facts in (begin, end)]
    return {
        "cpu_share": (end.process.cpu_ns - begin.process.cpu_ns) * 1e-9 / seconds,
        "frames_per_s": (frames[1] - frames[0]) / seconds,
    }


def block_growth(readings: Sequence[Facts]) -> float:
    """Growth of the interpreter's memory blocks: minimum of the second half of the readings less that of the first.

    The minima remove blocks that come and go between readings.
    """
    blocks = [facts.process.allocated_blocks for facts in readings]
    half = max(1, len(blocks) // 2)
    return float(min(blocks[half:]) - min(blocks[:half]))


def system_call_metrics(calls: tuple[dict[str, int], float] | None) -> dict[str, float]:
    """System calls per tick, in total and by name; NaN if the process cannot be traced."""
    by_name, ticks = calls or ({}, math.nan)
    each = {f"syscalls_{name}": count / ticks for name, count in by_name.items()}
    return {"syscalls_per_tick": sum(by_name.values()) / ticks, **each}


def loops(windows: Sequence[MeasurementWindow]) -> tuple[Durations, Durations, Durations]:
    """Histograms of controller, cyclictest and sleep loop over all windows."""
    histograms = [(w.durations["wake"], w.cyclictest, w.sleep_loop.lateness) for w in windows]
    ours, theirs, plain = (pooled(column) for column in zip(*histograms, strict=True))
    return ours, theirs, plain


def wakeups(mark: str, windows: Sequence[MeasurementWindow]) -> dict[str, float]:
    """Lateness of the wake-ups of controller, cyclictest and sleep loop; ``mark`` follows their names."""
    ours, theirs, plain = loops(windows)
    found = spread_us(f"wakeup{mark}", ours) | spread_us(f"cyclictest{mark}", theirs)
    return found | spread_us(f"plain{mark}", plain)


def loaded(end: str, windows: Sequence[MeasurementWindow]) -> dict[str, float]:
    """Missed deadlines of the three loops under load; ``end`` is the suffix of the metric names."""
    ours, plain = sum(w.missed for w in windows), sum(w.sleep_loop.missed for w in windows)
    return {
        f"missed_loaded{end}": float(ours),
        f"missed_loaded_plain{end}": float(plain),
        f"missed_loaded_cyclictest{end}": float(sum(w.cyclictest.periods(w.end.period_ns) for w in windows)),
        f"missed_loaded{end}_share": ours / plain if plain else math.nan,
    }


def undecided(metrics: Mapping[str, float]) -> dict[str, str]:
    """The metrics that a run with these values cannot decide, with the reason."""
    found: dict[str, str] = {}
    noisy = "cyclictest itself was late: the host is too noisy"
    quiet_host, cycles, ticks = metrics["host_verdict"], metrics["judged_cycles"], metrics["ticks"]

    def need(name: str, count: float, least: int, unit: str) -> bool:
        if count < least:
            found[name] = f"{count:.0f} {unit} are too few; at least {least} are needed"
        return count < least

    for name in ("wakeup_p50_ratio", "wakeup_p99_ratio"):
        if not quiet_host:
            found[name] = noisy
        else:
            need(name, cycles, MIN_RATIO_CYCLES, "cycles")
    if not metrics["missed"]:
        need("missed", cycles, MIN_MISS_CYCLES, "cycles")
    elif not quiet_host:
        found["missed"] = noisy
    for name in ("page_faults", "gc_runs", "allocated_blocks_growth"):
        if metrics[name] <= 0.0:
            need(name, ticks, MIN_STEADY_TICKS, "ticks")
    cost = {"tick_cpu_p50_us": ticks, "tick_cpu_p99_us": ticks, "tick1k_cpu_p99_us": metrics.get("ticks_1k", 0.0)}
    for name, count in cost.items():
        most = next(m.most for m in METRICS if m.name == name) or math.inf
        enough = not need(name, count, MIN_CPU_TICKS, "ticks")
        if enough and metrics[name] > most and not metrics[f"{name.partition('_p')[0]}_host_still"]:
            found[name] = "even the quietest windows were noisy, and noise adds to the processor time"
    found |= explained(metrics)
    if not quiet_host and metrics.get("sample_to_command_p99_us", 0.0) > metrics["period_us"]:
        found["sample_to_command_p99_us"] = noisy
    ours, plain = metrics["missed_loaded"], metrics["missed_loaded_plain"]
    if ours and metrics["missed_loaded_cyclictest"] >= ours:
        found["missed_loaded_share"] = "cyclictest missed as many deadlines: the host withheld the processor"
    elif plain < MIN_PLAIN_MISSED and ours * 100.0 <= plain:
        why = f"the sleep loop missed only {plain:.0f} deadlines, too few to decide a limit of one percent"
        found["missed_loaded_share"] = why
    return unmeasured(METRICS, metrics) | found


def unmeasured(definitions: Iterable[Metric], metrics: Mapping[str, float]) -> dict[str, str]:
    """The metrics with a limit that have no value: inconclusive, with the reason."""
    missing = [m.name for m in definitions if m.limit_text() and math.isnan(metrics.get(m.name, math.nan))]
    return dict.fromkeys(missing, "it could not be measured here")
