"""Activity of the host during a measurement (steal, pressure, load), and its description.

Sources: proc(5) for stat and loadavg, the kernel's accounting/psi.rst for pressure.  What a host does not report is
None or "unknown"; only steal is then 0.
"""

from __future__ import annotations

import os
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from host.doctor import facts

_STEAL: Final = 8
"""Index of steal in a line of /proc/stat: name user nice system idle iowait irq softirq steal."""


FACTS: Final = {
    "processor": "{}",
    "cpus": "{} cores",
    "hypervisor": "hypervisor: {}",
    "kernel": "kernel {}",
    "preemption": "preemption {}",
    "clock": "clock {}",
    "governor": "governor {}",
    "isolated": "isolated processors {}",
    "python": "Python {}",
    "tick": "tick: {}",
}


@dataclass(frozen=True, slots=True)
class Sample:
    """Totals since boot: steal of all processors, time in which a process waited for one [us]; load average."""

    at_ns: int
    steal_ms: float
    pressure_us: int | None
    load: float


def sample() -> Sample:
    """The totals now."""
    pressure = pressure_us(_read("/proc/pressure/cpu"))
    return Sample(time.monotonic_ns(), steal_ms(_read("/proc/stat")), pressure, os.getloadavg()[0])


def steal_ms(stat: str) -> float:
    """Steal of all processors since boot, from the text of /proc/stat; 0 where it is not reported."""
    words = stat.partition("\n")[0].split()
    return float(words[_STEAL]) * 1e3 / os.sysconf("SC_CLK_TCK") if len(words) > _STEAL else 0.0


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
    """Kernel, preemption model, frequency governors, isolated processors, clock, hypervisor, real-time throttling."""
    found = facts.read(Path("/"))
    return {
        "kernel": found.release,
        "preemption": found.preemption or "unknown",
        "governor": ", ".join(sorted(set(found.governors.values()))) or "none reported",
        "isolated": ", ".join(map(str, sorted(found.isolated))) or "none",
        "clock": found.clock_source or "unknown",
        "hypervisor": "no" if found.machine in ("", "a container") else "yes",
        "rt_runtime_us": "unknown" if found.rt_runtime_us is None else str(found.rt_runtime_us),
    }


def sentence(environment: Mapping[str, str]) -> str:
    """The host that measured, for a page; facts that a result does not hold are left out."""
    told = (words.format(environment[name]) for name, words in FACTS.items() if name in environment)
    return f"Host: {', '.join(told)}."


def _read(path: str) -> str:
    try:
        return Path(path).read_text()
    except OSError:
        return ""
