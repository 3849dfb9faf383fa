"""Measurement windows of the timing testbed: controller, cyclictest and sleep loop over the same seconds.

cyclictest (Debian package rt-tests) runs at the controller's priority on its core.  Its wake-ups lie at a fixed
distance from the ticks, while the controller sleeps; otherwise two threads of one priority on one core would delay each
other.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import shutil
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from can_dbc.timing.durations import Durations, bin_of
from experiments.common import host_activity
from experiments.timing.testbed import Span, TimingTestbed
from host.exit_codes import CommandFailed, ExitCode

PRIORITY: Final = 80
"""SCHED_FIFO priority of the controller and of cyclictest."""
QUIET_PHASE: Final = 0.8
"""Phase in the controller's period at which cyclictest wakes: after the tick and after SYNC."""
MAX_LATENESS_US: Final = 100_000
START_S: Final = 2.2
"""cyclictest starts at a full second, the next one or the one after."""
GRACE_S: Final = 60.0
"""Helpers of normal priority end late on a host under heavy load."""
LOAD_SETTLES_S: Final = 2.0
TOOLS: Final = {"cyclictest": "rt-tests", "stress-ng": "stress-ng", "strace": "strace"}
_CALLS: Final = re.compile(r"^\s*[\d.]+\s+[\d.]+\s+\d+\s+(\d+)\s+(?:\d+\s+)?(\w+)\s*$", re.MULTILINE)


@dataclass(frozen=True, slots=True)
class MeasurementWindow(Span):
    """One window of the controller, with the reference loops over the same time, and the host's activity.

    ``plain`` is the lateness of the sleep loop, ``plain_missed`` its missed deadlines, ``plain_cpu_us`` the processor
    time of one of its cycles.
    """

    cyclictest: Durations
    plain: Durations
    plain_missed: int
    plain_cpu_us: float
    host: host_activity.HostActivity


def missing_tools() -> dict[str, str]:
    """List the missing programs with their Debian packages."""
    return {tool: package for tool, package in TOOLS.items() if shutil.which(tool) is None}


def measure(testbed: TimingTestbed, seconds: float, directory: Path, with_cyclictest: bool = True) -> MeasurementWindow:
    """Measure one window of this length, plus one or two seconds.

    cyclictest starts before the window and ends after it, so that it sees every stall of the host within.  Without it
    its histogram is empty.
    """
    report, period_ns = directory / "cyclictest.json", testbed.setting.period_ns
    report.unlink(missing_ok=True)
    if with_cyclictest:
        how = f"-q -m -t 1 -a {testbed.cpu} -p {PRIORITY} --policy fifo -i {period_ns // 1000} -h {MAX_LATENESS_US}"
        when = f"--secaligned {offset_us(testbed.stamp_ns, period_ns)} --histfile=/dev/null"
        testbed.helpers.launch("cyclictest", "cyclictest", *how.split(), *when.split(), f"--json={report}")
        testbed.wait(START_S)
    first, mark = host_activity.sample(), testbed.mark()
    module = "experiments.timing.sleep_loop"
    child = testbed.helpers.start("sleep-loop", module, period_us=period_ns // 1000, seconds=seconds)
    os.sched_setaffinity(child.process.pid, {testbed.cpu})
    output = testbed.await_end("sleep-loop", seconds + GRACE_S)
    span, last = testbed.since(mark), host_activity.sample()
    if with_cyclictest:
        testbed.end_helper("cyclictest")
    ours = (span.begin, span.end, span.durations, span.instructions)
    theirs = read_cyclictest(report.read_text()) if with_cyclictest else Durations()
    return MeasurementWindow(*ours, theirs, *read_sleep_loop(output), host_activity.between(first, last))


def offset_us(stamp_ns: int, period_ns: int) -> int:
    """Compute cyclictest's offset from the full second so that it wakes `QUIET_PHASE` of a period after the ticks."""
    return round((stamp_ns + QUIET_PHASE * period_ns) % period_ns / 1000) % (period_ns // 1000)


def read_cyclictest(report: str) -> Durations:
    """Read the histogram of a finished run, from its JSON report."""
    thread = json.loads(report)["thread"]["0"]
    histogram = Durations(longest_ns=1000 * int(thread["max"]), total_ns=round(1000 * thread["avg"] * thread["cycles"]))
    for late_us, n in thread["histogram"].items():
        histogram.bins[bin_of(1000 * int(late_us))] += int(n)
    histogram.bins[-1] += max(0, int(thread["cycles"]) - histogram.count)
    return histogram


def read_sleep_loop(output: dict[str, Any]) -> tuple[Durations, int, float]:
    """Parse the output of the sleep loop: its lateness, missed deadlines, processor time of a cycle [us]."""
    lateness = Durations(longest_ns=output["longest_ns"])
    for i, n in output["bins"].items():
        lateness.bins[int(i)] = n
    return lateness, output["missed"], output["cpu_us"]


@contextlib.contextmanager
def load(testbed: TimingTestbed, seconds: float) -> Iterator[None]:
    """Keep every core and the memory busy for the block, which may last up to ``seconds``.

    The load is in the session of the sleep loop, as if both were started from one terminal.
    """
    cores = len(os.sched_getaffinity(0))
    memory = ("--vm", 1, "--vm-bytes", "128m")
    words = ("--quiet", "--cpu", cores, *memory, "--timeout", f"{seconds:.0f}s")
    child = testbed.helpers.launch("load", "stress-ng", *words)
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
    """Count the system calls of the controller by name, and the number of ticks; None if it cannot be traced.

    Tracing slows the loop down but does not change how many system calls a tick makes.
    """
    table = directory / "strace.txt"
    table.unlink(missing_ok=True)
    pid = testbed.family.children["controller"].process.pid
    child = testbed.helpers.launch("strace", "strace", "-c", "-f", "-p", pid, "-o", table)

    def attached() -> bool:
        return "attached" in child.errors.read_text()

    testbed.until(lambda: attached() or child.process.poll() is not None, GRACE_S, period_s=0.005)
    if not attached():
        testbed.helpers.stop("strace")
        return None
    begin, begin_s = testbed.timing().facts, time.monotonic()
    testbed.wait(seconds)
    passed_s = time.monotonic() - begin_s
    testbed.helpers.stop("strace")
    missed = testbed.fresh_timing().facts.missed - begin.missed
    calls = count_calls(table.read_text()) if table.exists() else {}
    ticks = passed_s * testbed.setting.rate_hz - missed
    return (calls, ticks) if calls and ticks > 0 else None


def count_calls(summary: str) -> dict[str, int]:
    """Count the system calls by name, from the table that ``strace -c`` prints."""
    return {name: int(calls) for calls, name in _CALLS.findall(summary) if name != "total"}
