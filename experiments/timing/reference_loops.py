"""What our loop is compared with and what presses on it: cyclictest, a plain loop, stress-ng, the system-call count.

cyclictest (Debian package rt-tests) runs at our priority on our core in the same seconds.  Its wake-ups lie at a fixed
distance from our ticks, where our loop sleeps: two threads of one priority on one core would else delay each other.
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
from hil.harness.processes import Child, Family

PRIORITY: Final = 80
"""That of the controller."""
QUIET_PHASE: Final = 0.8
"""Where in our period cyclictest wakes: after our tick and after SYNC."""
WIDEST_US: Final = 100_000
START_S: Final = 2.2
"""cyclictest begins with a full second, the next one or that after it."""
TOOLS: Final = {"cyclictest": "rt-tests", "stress-ng": "stress-ng", "strace": "strace"}


def missing_tools() -> dict[str, str]:
    """Programs that are not there, with their Debian packages."""
    return {tool: package for tool, package in TOOLS.items() if shutil.which(tool) is None}


def offset_us(stamp_ns: int, period_ns: int) -> int:
    """cyclictest's distance from the full second, so that it wakes `QUIET_PHASE` of a period after our ticks."""
    return round((stamp_ns + QUIET_PHASE * period_ns) % period_ns / 1000) % (period_ns // 1000)


def start_cyclictest(family: Family, cpu: int, period_ns: int, stamp_ns: int, report: Path) -> Child:
    """Begin; it ends, and writes its report, when it is stopped.  ``stamp_ns`` is the nominal time of any of our
    ticks.
    """
    return family.launch(
        "cyclictest", "cyclictest", "-q", "-m", "-t", 1, "-a", cpu, "-p", PRIORITY, "--policy", "fifo",
        "-i", period_ns // 1000, "--secaligned", offset_us(stamp_ns, period_ns),
        "-h", WIDEST_US, "--histfile=/dev/null", f"--json={report}",
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
class Plain:
    """What the plain loop saw."""

    lateness: Durations
    missed: int


def start_plain(family: Family, period_ns: int, seconds: float, cpu: int) -> Child:
    """Begin a plain loop on our core."""
    child = family.start("plain", "experiments.timing.sleep_loop", "--period-us", period_ns // 1000, "--seconds", seconds)
    os.sched_setaffinity(child.process.pid, {cpu})
    return child


def read_plain(said: dict[str, Any]) -> Plain:
    """From what it said at its end."""
    lateness = Durations(longest_ns=said["longest_ns"])
    for i, n in said["bins"].items():
        lateness.bins[int(i)] = n
    return Plain(lateness, said["missed"])


def start_load(family: Family, seconds: float) -> Child:
    """Keep every core busy, and memory with it; in the session of the plain loop, as from one terminal."""
    cores = len(os.sched_getaffinity(0))
    return family.launch(
        "load", "stress-ng", "--quiet", "--cpu", cores, "--vm", 1, "--vm-bytes", "128m", "--timeout", f"{seconds:.0f}s"
    )


def count_calls(summary: str) -> dict[str, int]:
    """System calls by name from the table that ``strace -c`` prints."""
    row = re.compile(r"^\s*[\d.]+\s+[\d.]+\s+\d+\s+(\d+)\s+(?:\d+\s+)?(\w+)\s*$", re.MULTILINE)
    return {name: int(calls) for calls, name in row.findall(summary) if name != "total"}
