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
    """Read the totals now."""
    pressure = pressure_us(_read("/proc/pressure/cpu"))
    return Sample(time.monotonic_ns(), steal_ms(_read("/proc/stat")), pressure, os.getloadavg()[0])


def steal_ms(stat: str) -> float:
    """Read the steal of all processors since boot, from the text of /proc/stat; 0 where it is not reported."""
    fields = stat.partition("\n")[0].split()
    return float(fields[_STEAL]) * 1e3 / os.sysconf("SC_CLK_TCK") if len(fields) > _STEAL else 0.0


def pressure_us(text: str) -> int | None:
    """Read the total of the line ``some`` of a pressure file."""
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
    """Compute the activity between two samples."""
    seconds = (last.at_ns - first.at_ns) * 1e-9
    waited = None
    if first.pressure_us is not None and last.pressure_us is not None:
        waited = (last.pressure_us - first.pressure_us) * 1e-6 / seconds
    return HostActivity(seconds, last.steal_ms - first.steal_ms, waited, last.load)


def cpu_s(pid: int) -> float:
    """Read the processor time of a process so far [s]; 0 once it has ended."""
    fields = _read(f"/proc/{pid}/stat").rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK") if fields else 0.0


def describe() -> dict[str, str]:
    """Describe kernel, preemption, governors, isolated processors, clock, hypervisor and real-time throttling."""
    host_facts = facts.read(Path("/"))
    return {
        "kernel": host_facts.release,
        "preemption": host_facts.preemption or "unknown",
        "governor": ", ".join(sorted(set(host_facts.governors.values()))) or "none reported",
        "isolated": ", ".join(map(str, sorted(host_facts.isolated))) or "none",
        "clock": host_facts.clock_source or "unknown",
        "hypervisor": "no" if host_facts.machine in ("", "a container") else "yes",
        "rt_runtime_us": "unknown" if host_facts.rt_runtime_us is None else str(host_facts.rt_runtime_us),
    }


def sentence(environment: Mapping[str, str]) -> str:
    """Describe the host that measured, for a page; facts that a result does not hold are left out."""
    fact_texts = (template.format(environment[name]) for name, template in FACTS.items() if name in environment)
    return f"Host: {', '.join(fact_texts)}."


def _read(path: str) -> str:
    try:
        return Path(path).read_text()
    except OSError:
        return ""
