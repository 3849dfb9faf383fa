"""Windows of a measurement: our histograms, those of the reference loops, the host, all over the same seconds."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from can_dbc.timing.durations import Durations
from can_dbc.timing.page import Facts, Timing
from experiments.timing import host_activity, reference_loops
from experiments.timing.reference_loops import Plain
from experiments.timing.testbed import Stand
from host.exit_codes import CommandFailed, ExitCode

GRACE_S: Final = 60.0
"""On a host under heavy load the helpers, of normal priority, take their time to end."""
LOAD_SETTLES_S: Final = 2.0


@dataclass(frozen=True, slots=True)
class Window:
    """``begin`` and ``end`` are the controller's facts (totals); the histograms hold what came between."""

    begin: Facts
    end: Facts
    durations: dict[str, Durations]
    cyclictest: Durations
    plain: Plain
    host: host_activity.Meanwhile

    @property
    def ticks(self) -> int:
        """Ticks that ran."""
        return self.end.ticks - self.begin.ticks

    @property
    def missed(self) -> int:
        """Periods skipped."""
        return self.end.missed - self.begin.missed


def measure(stand: Stand, seconds: float, directory: Path) -> Window:
    """One window of so many seconds and one or two more.

    cyclictest begins before and ends after it, so that no stall of the host within it stays unseen.
    """
    report = directory / "cyclictest.json"
    report.unlink(missing_ok=True)
    period_ns = stand.setting.period_ns
    reference_loops.start_cyclictest(stand.helpers, stand.cpu, period_ns, stand.stamp_ns, report)
    stand.wait(reference_loops.START_S)
    first, begin = host_activity.sample(), stand.fresh_timing()
    reference_loops.start_plain(stand.helpers, period_ns, seconds, stand.cpu)
    said = stand.await_end("plain", seconds + GRACE_S)
    end, last = stand.fresh_timing(), host_activity.sample()
    stand.end_helper("cyclictest")
    return Window(
        begin=begin.facts,
        end=end.facts,
        durations=between(begin, end),
        cyclictest=reference_loops.read_cyclictest(report.read_text()),
        plain=reference_loops.read_plain(said),
        host=host_activity.between(first, last),
    )


def between(begin: Timing, end: Timing) -> dict[str, Durations]:
    """The histograms of what came after ``begin``."""
    return {name: end.durations[name] - begin.durations[name] for name in end.durations}


def pooled(histograms: Sequence[Durations]) -> Durations:
    """All of them as one."""
    if not histograms:
        return Durations()
    bins = np.sum([np.frombuffer(h.bins, np.uint64) for h in histograms], axis=0, dtype=np.uint64)
    return Durations(bins.tobytes(), max(h.longest_ns for h in histograms), sum(h.total_ns for h in histograms))


@contextlib.contextmanager
def load(stand: Stand, seconds: float) -> Iterator[None]:
    """Every core busy for the block, which may last so many seconds."""
    child = reference_loops.start_load(stand.helpers, seconds)
    stand.wait(LOAD_SETTLES_S)
    try:
        yield
        if child.process.poll() is not None:
            raise Stopped(Exit.CONFIGURATION, f"stress-ng ended before its time: {child.complaint()}")
    finally:
        stand.helpers.stop("load")


def system_calls(stand: Stand, seconds: float, directory: Path) -> tuple[dict[str, int], float] | None:
    """System calls of the controller by name, and the ticks in which they were made; None where it cannot be traced.

    Tracing slows the loop down; how often it calls the system stays the same.
    """
    table = directory / "strace.txt"
    table.unlink(missing_ok=True)
    pid = stand.family.children["controller"].process.pid
    child = stand.helpers.launch("strace", "strace", "-c", "-f", "-p", pid, "-o", table)
    limit = time.monotonic() + GRACE_S
    while "attached" not in child.errors.read_text():
        if child.process.poll() is not None or time.monotonic() > limit:
            stand.helpers.stop("strace")
            return None
        time.sleep(0.005)
    begin, begin_s = stand.timing().facts, time.monotonic()
    stand.wait(seconds)
    passed_s = time.monotonic() - begin_s
    stand.helpers.stop("strace")
    missed = stand.fresh_timing().facts.missed - begin.missed
    calls = reference_loops.count_calls(table.read_text()) if table.exists() else {}
    ticks = passed_s * stand.setting.rate_hz - missed
    return (calls, ticks) if calls and ticks > 0 else None
