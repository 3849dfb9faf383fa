"""Probe: what does this computer leave to a process with deadlines?  ``python -ISB lateness.py SECONDS``.

First it counts for half a second how many processors the others leave free, and reads what share of its time a virtual
machine lost to its host since it started.  Then, on every processor, a child sleeps until absolute deadlines 1 ms
apart and works, as the processes of a live run do, with their real-time priority where the system grants it; a quota
of the processor shows there.  Prints one JSON object.  Standard library alone; a process of its own, because it ends
with its children.
"""

import contextlib
import json
import os
import sys
import time

PERIOD_NS = 1_000_000
NEED = 1.5
"""Processors that a live run keeps busy, roughly."""
MOST = 0.75
"""Share of a processor that the probe takes at most: something must remain for the computer."""
PRIORITY = 50
"""SCHED_FIFO of the plant in a live run (`hil.harness.live`)."""
COUNT_S = 0.5
STAT = "/proc/stat"
IDLE, IOWAIT, STEAL = 3, 4, 7
"""Fields of the line ``cpu`` of /proc/stat, in ticks of all processors since the start: proc(5)."""


def ticks() -> list[int]:
    """Read user, nice, system, idle, iowait, irq, softirq, steal; guests are within user and nice."""
    with open(STAT) as stat:
        return [int(field) for field in stat.readline().split()[1:9]]


def free(before: list[int], after: list[int], processors: int) -> float:
    """Compute how many processors idled between two readings of `ticks`."""
    spent = [b - a for a, b in zip(before, after, strict=True)]
    return processors * (spent[IDLE] + spent[IOWAIT]) / max(sum(spent), 1)


def stolen(since_start: list[int]) -> float:
    """Compute the share of busy time that the host of a virtual machine took away from the processors."""
    return since_start[STEAL] / max(sum(since_start) - since_start[IDLE] - since_start[IOWAIT], 1)


def work_ns(processors: int) -> int:
    """Compute the work of a child in each period [ns], where there are so many processors."""
    return int(PERIOD_NS * min(NEED / processors, MOST))


def longest_ns(duration_ns: int, work_ns: int) -> int:
    """Measure the longest time from a deadline to the end of its work, less the work [ns]."""
    clock, used = time.monotonic_ns, time.thread_time_ns
    longest, deadline = 0, clock() + PERIOD_NS
    end = deadline + duration_ns
    while deadline < end:
        time.sleep(max(deadline - clock(), 0) / 1e9)
        begin = used()
        while used() - begin < work_ns:
            pass
        late = clock() - deadline - work_ns
        longest = max(longest, late)
        deadline += PERIOD_NS * (1 + max(late, 0) // PERIOD_NS)
    return longest


def on(cpu: int, duration_ns: int, work_ns: int) -> int:
    """Start a child on processor ``cpu``; a descriptor from which its longest lateness can be read."""
    read, write = os.pipe()
    if os.fork():
        os.close(write)
        return read
    os.setsid()  # a share of the processor of its own, as the processes of a live run have
    with contextlib.suppress(OSError):
        os.sched_setaffinity(0, {cpu})
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
    os.write(write, str(longest_ns(duration_ns, work_ns)).encode())
    os._exit(0)


def main() -> None:
    duration_ns = int(float(sys.argv[1]) * 1e9)
    cpus = sorted(os.sched_getaffinity(0))
    before = ticks()
    time.sleep(COUNT_S)
    after = ticks()
    pipes = [on(cpu, duration_ns, work_ns(len(cpus))) for cpu in cpus]
    result = {
        "longest_ns": max(int(os.read(pipe, 32)) for pipe in pipes),
        "free": free(before, after, os.cpu_count() or 1),
        "stolen": stolen(after),
    }
    print(json.dumps(result))


if __name__ == "__main__":
    main()
