"""Probe: how much time does a spinning process lose on the lab's processor?  ``python -ISB lost_time.py SECONDS``.

It claims a free processor and takes the same share as the lab (`keeper`), reads the clock without a pause, and counts
gaps between two readings.  A gap is time in which the host ran something else: another process, or another machine
(steal).  Prints one JSON object.  Standard library alone; a process of its own, because it takes a session's share.
"""

import contextlib
import json
import os
import sys
import time
from pathlib import Path

GAP_NS = 200_000
"""Longer than an interrupt of the host, shorter than a time slice."""
_STEAL = 7
"""Index of steal in a line of /proc/stat: user nice system idle iowait irq softirq steal."""


def lost(duration_ns: int) -> tuple[int, int, int]:
    """Spin for ``duration_ns``; total, sum of the gaps, and longest gap in ns."""
    clock = time.monotonic_ns
    begin = last = clock()
    total = longest = 0
    while last - begin < duration_ns:
        now = clock()
        gap = now - last
        if gap > GAP_NS:
            total += gap
            longest = max(longest, gap)
        last = now
    return last - begin, total, longest


def steal_s(cpu: int) -> float:
    """Read the time of a processor that the hypervisor took, since boot; 0 where it is not reported."""
    for line in Path("/proc/stat").read_text().splitlines():
        fields = line.split()
        if fields[0] == f"cpu{cpu}" and len(fields) > _STEAL + 1:
            return int(fields[_STEAL + 1]) / os.sysconf("SC_CLK_TCK")
    return 0.0


def main() -> None:
    sys.path.append(str(Path(__file__).resolve().parents[2]))
    from host.vcan_lab.keeper import NICENESS, claim_cpu

    claim = claim_cpu()  # noqa: F841  held until this process ends
    with contextlib.suppress(OSError):
        Path("/proc/self/autogroup").write_text(str(NICENESS))
    cpu = min(os.sched_getaffinity(0))
    stolen_s = steal_s(cpu)
    total_ns, lost_ns, longest_ns = lost(int(float(sys.argv[1]) * 1e9))
    stolen_s = steal_s(cpu) - stolen_s
    result = {
        "share": lost_ns / total_ns,
        "longest_ns": longest_ns,
        "steal_share": stolen_s * 1e9 / total_ns,
        "cpu": cpu,
    }
    print(json.dumps(result))


if __name__ == "__main__":
    main()
