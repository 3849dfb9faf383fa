"""Reference loops and load: cyclictest, a sleep loop, stress-ng, and the count of system calls.

cyclictest (Debian package rt-tests) runs at the controller's priority on its core during the same seconds.  Its
wake-ups lie at a fixed distance from the ticks, while the controller sleeps; otherwise two threads of one priority on
one core would delay each other.
"""

from __future__ import annotations

import json
import os
import re
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from can_dbc.timing.durations import Durations, bin_of
from hil.harness.processes import Child, ProcessGroup

PRIORITY: Final = 80
"""SCHED_FIFO priority of the controller and of cyclictest."""
QUIET_PHASE: Final = 0.8
"""Phase in the controller's period at which cyclictest wakes: after the tick and after SYNC."""
MAX_LATENESS_US: Final = 100_000
START_S: Final = 2.2
"""cyclictest starts at a full second, the next one or the one after."""
TOOLS: Final = {"cyclictest": "rt-tests", "stress-ng": "stress-ng", "strace": "strace"}


def missing_tools() -> dict[str, str]:
    """Missing programs with their Debian packages."""
    return {tool: package for tool, package in TOOLS.items() if shutil.which(tool) is None}


def offset_us(stamp_ns: int, period_ns: int) -> int:
    """Offset of cyclictest from the full second so that it wakes `QUIET_PHASE` of a period after the ticks."""
    return round((stamp_ns + QUIET_PHASE * period_ns) % period_ns / 1000) % (period_ns // 1000)


def start_cyclictest(family: ProcessGroup, cpu: int, period_ns: int, stamp_ns: int, report: Path) -> Child:
    """Start cyclictest, which writes its report when it is stopped.  ``stamp_ns``: nominal time of any tick."""
    return family.launch(
        "cyclictest", "cyclictest", "-q", "-m", "-t", 1, "-a", cpu, "-p", PRIORITY, "--policy", "fifo",
        "-i", period_ns // 1000, "--secaligned", offset_us(stamp_ns, period_ns),
        "-h", MAX_LATENESS_US, "--histfile=/dev/null", f"--json={report}",
    )  # fmt: skip


def read_cyclictest(report: str) -> Durations:
    """The histogram of a finished run, from its JSON report."""
    thread = json.loads(report)["thread"]["0"]
    found = Durations(longest_ns=1000 * int(thread["max"]), total_ns=round(1000 * thread["avg"] * thread["cycles"]))
    counted = 0
    for late_us, n in thread["histogram"].items():
        found.bins[bin_of(1000 * int(late_us))] += int(n)
        counted += int(n)
    found.bins[-1] += max(0, int(thread["cycles"]) - counted)
    return found


@dataclass(frozen=True, slots=True)
class SleepLoopReport:
    """Lateness and missed deadlines of the sleep loop; processor time of one of its cycles [us]."""

    lateness: Durations
    missed: int
    cpu_us: float


def start_sleep_loop(family: ProcessGroup, period_ns: int, seconds: float, cpu: int) -> Child:
    """Start a sleep loop on the controller's core."""
    child = family.start(
        "sleep-loop", "experiments.timing.sleep_loop", "--period-us", period_ns // 1000, "--seconds", seconds
    )
    os.sched_setaffinity(child.process.pid, {cpu})
    return child


def read_sleep_loop(output: dict[str, Any]) -> SleepLoopReport:
    """Parse the output of the sleep loop."""
    lateness = Durations(longest_ns=output["longest_ns"])
    for i, n in output["bins"].items():
        lateness.bins[int(i)] = n
    return SleepLoopReport(lateness, output["missed"], output["cpu_us"])


def start_load(family: ProcessGroup, seconds: float) -> Child:
    """Keep every core and the memory busy, in the session of the sleep loop, as if started from one terminal."""
    cores = len(os.sched_getaffinity(0))
    return family.launch(
        "load", "stress-ng", "--quiet", "--cpu", cores, "--vm", 1, "--vm-bytes", "128m", "--timeout", f"{seconds:.0f}s"
    )


def count_calls(summary: str) -> dict[str, int]:
    """System calls by name, from the table that ``strace -c`` prints."""
    row = re.compile(r"^\s*[\d.]+\s+[\d.]+\s+\d+\s+(\d+)\s+(?:\d+\s+)?(\w+)\s*$", re.MULTILINE)
    return {name: int(calls) for calls, name in row.findall(summary) if name != "total"}
