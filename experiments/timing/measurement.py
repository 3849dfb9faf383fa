"""Measurement windows: histograms of controller, cyclictest and sleep loop and the host's activity, all over the same
seconds."""

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
from experiments.common import host_activity
from experiments.timing import reference_loops
from experiments.timing.reference_loops import SleepLoopReport
from experiments.timing.testbed import TimingTestbed
from host.exit_codes import CommandFailed, ExitCode

GRACE_S: Final = 60.0
"""Helpers of normal priority end late on a host under heavy load."""
LOAD_SETTLES_S: Final = 2.0


@dataclass(frozen=True, slots=True)
class MeasurementWindow:
    """One window: the controller's totals at ``begin`` and ``end``, and the histograms of the time between."""

    begin: Facts
    end: Facts
    durations: dict[str, Durations]
    cyclictest: Durations
    sleep_loop: SleepLoopReport
    host: host_activity.HostActivity

    @property
    def ticks(self) -> int:
        """Ticks executed."""
        return self.end.ticks - self.begin.ticks

    @property
    def missed(self) -> int:
        """Periods skipped."""
        return self.end.missed - self.begin.missed


def measure(testbed: TimingTestbed, seconds: float, directory: Path, with_cyclictest: bool = True) -> MeasurementWindow:
    """Measure one window of this length, plus one or two seconds.

    cyclictest starts before the window and ends after it, so that it sees every stall of the host within.  Without it
    its histogram is empty.
    """
    report = directory / "cyclictest.json"
    report.unlink(missing_ok=True)
    period_ns = testbed.setting.period_ns
    if with_cyclictest:
        reference_loops.start_cyclictest(testbed.helpers, testbed.cpu, period_ns, testbed.stamp_ns, report)
        testbed.wait(reference_loops.START_S)
    first, begin = host_activity.sample(), testbed.fresh_timing()
    reference_loops.start_sleep_loop(testbed.helpers, period_ns, seconds, testbed.cpu)
    output = testbed.await_end("sleep-loop", seconds + GRACE_S)
    end, last = testbed.fresh_timing(), host_activity.sample()
    if with_cyclictest:
        testbed.end_helper("cyclictest")
    return MeasurementWindow(
        begin=begin.facts,
        end=end.facts,
        durations=between(begin, end),
        cyclictest=reference_loops.read_cyclictest(report.read_text()) if with_cyclictest else Durations(),
        sleep_loop=reference_loops.read_sleep_loop(output),
        host=host_activity.between(first, last),
    )


def between(begin: Timing, end: Timing) -> dict[str, Durations]:
    """Histograms of the time between two readings of the timing page."""
    return {name: end.durations[name] - begin.durations[name] for name in end.durations}


def pooled(histograms: Sequence[Durations]) -> Durations:
    """The sum of histograms."""
    if not histograms:
        return Durations()
    bins = np.sum([np.frombuffer(h.bins, np.uint64) for h in histograms], axis=0, dtype=np.uint64)
    return Durations(bins.tobytes(), max(h.longest_ns for h in histograms), sum(h.total_ns for h in histograms))


@contextlib.contextmanager
def load(testbed: TimingTestbed, seconds: float) -> Iterator[None]:
    """Keep every core busy for the block, which may last up to ``seconds``."""
    child = reference_loops.start_load(testbed.helpers, seconds)
    testbed.wait(LOAD_SETTLES_S)
    try:
        yield
        if child.process.poll() is not None:
            raise CommandFailed(
                "timing.load-ended", f"stress-ng ended before its time: {child.complaint()}", ExitCode.CONFIGURATION
            )
    finally:
        testbed.helpers.stop("load")


def system_calls(testbed: TimingTestbed, seconds: float, directory: Path) -> tuple[dict[str, int], float] | None:
    """System calls of the controller by name, and the number of ticks; None if it cannot be traced.

    Tracing slows the loop down but does not change how many system calls a tick makes.
    """
    table = directory / "strace.txt"
    table.unlink(missing_ok=True)
    pid = testbed.family.children["controller"].process.pid
    child = testbed.helpers.launch("strace", "strace", "-c", "-f", "-p", pid, "-o", table)
    testbed.until(
        lambda: "attached" in child.errors.read_text() or child.process.poll() is not None, GRACE_S, period_s=0.005
    )
    if "attached" not in child.errors.read_text():
        testbed.helpers.stop("strace")
        return None
    begin, begin_s = testbed.timing().facts, time.monotonic()
    testbed.wait(seconds)
    passed_s = time.monotonic() - begin_s
    testbed.helpers.stop("strace")
    missed = testbed.fresh_timing().facts.missed - begin.missed
    calls = reference_loops.count_calls(table.read_text()) if table.exists() else {}
    ticks = passed_s * testbed.setting.rate_hz - missed
    return (calls, ticks) if calls and ticks > 0 else None
