"""Activity of the host during a measurement (steal, pressure, load), and its description.

Sources: proc(5) for stat and loadavg, the kernel's accounting/psi.rst for pressure.  What a host does not report is
None or "unknown", never 0.
"""

from __future__ import annotations

import os
import platform
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Final

_STEAL: Final = 7
"""Index of steal in a line of /proc/stat: user nice system idle iowait irq softirq steal."""


@dataclass(frozen=True, slots=True)
class Sample:
    """Totals since boot: steal of all processors, time in which a process waited for one [us]; load average."""

    at_ns: int
    steal_ms: float
    pressure_us: int | None
    load: float


def sample() -> Sample:
    """The totals now."""
    words = _read("/proc/stat").split("\n", 1)[0].split()[1:]
    tick_ms = 1e3 / os.sysconf("SC_CLK_TCK")
    steal = float(words[_STEAL]) * tick_ms if len(words) > _STEAL else 0.0
    load = os.getloadavg()[0]
    return Sample(time.monotonic_ns(), steal, pressure_us(_read("/proc/pressure/cpu")), load)


def pressure_us(text: str) -> int | None:
    """The total of the line ``some`` of a pressure file."""
    for line in text.splitlines():
        kind, _, rest = line.partition(" ")
        if kind == "some":
            return int(rest.rpartition("total=")[2])
    return None


@dataclass(frozen=True, slots=True)
class HostActivity:
    """Between two samples: seconds, steal of all processors [ms], share of time with a waiting process, load at the
    end."""

    seconds: float
    steal_ms: float
    pressure: float | None
    load: float


def between(first: Sample, last: Sample) -> HostActivity:
    """Activity between two samples."""
    seconds = (last.at_ns - first.at_ns) * 1e-9
    waited = None
    if first.pressure_us is not None and last.pressure_us is not None:
        waited = (last.pressure_us - first.pressure_us) * 1e-6 / seconds
    return HostActivity(seconds, last.steal_ms - first.steal_ms, waited, last.load)


def cpu_s(pid: int) -> float:
    """Processor time of a process so far [s]; 0 once it has ended."""
    words = _read(f"/proc/{pid}/stat").rpartition(")")[2].split()
    return (int(words[11]) + int(words[12])) / os.sysconf("SC_CLK_TCK") if words else 0.0


def describe() -> dict[str, str]:
    """Kernel, preemption model, frequency governor, isolated processors and hypervisor."""
    return {
        "kernel": platform.release(),
        "preemption": preemption(platform.version(), _read("/sys/kernel/debug/sched/preempt")),
        "governor": _read("/sys/devices/system/cpu/cpu0/cpufreq/scaling_governor").strip() or "none reported",
        "isolated": _read("/sys/devices/system/cpu/isolated").strip() or "none",
        "clock": _read("/sys/devices/system/clocksource/clocksource0/current_clocksource").strip() or "unknown",
        "hypervisor": "yes" if " hypervisor" in _read("/proc/cpuinfo") else "no",
        "rt_runtime_us": _read("/proc/sys/kernel/sched_rt_runtime_us").strip() or "unknown",
    }


def preemption(version: str, dynamic: str) -> str:
    """The preemption model by ``uname -v`` and, for a dynamic one, the mode in brackets of sched/preempt."""
    for word in ("PREEMPT_RT", "PREEMPT_DYNAMIC", "PREEMPT"):
        if word in version:
            mode = dynamic.partition("(")[2].partition(")")[0]
            return f"{word} ({mode})" if word == "PREEMPT_DYNAMIC" and mode else word
    return "none"


def _read(path: str) -> str:
    try:
        return Path(path).read_text()
    except OSError:
        return ""
