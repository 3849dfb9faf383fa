"""Probe: how late does a process with deadlines wake up and work here?  ``python -ISB lateness.py SECONDS``.

On every processor a child sleeps until absolute deadlines 1 ms apart and then works, as the processes of a live run do,
with their real-time priority where the system grants it.  All of them work as much as a live run: a computer without
that much to spare, or with a quota, shows it.  Prints one JSON object.  Standard
library alone; a process of its own, because it ends with its children.
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


def work_ns(processors: int) -> int:
    """The work of a child in each period [ns], where there are so many processors."""
    return int(PERIOD_NS * min(NEED / processors, MOST))


def longest_ns(duration_ns: int, work_ns: int) -> int:
    """The longest time from a deadline to the end of its work, less the work [ns]."""
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
    pipes = [on(cpu, duration_ns, work_ns(len(cpus))) for cpu in cpus]
    print(json.dumps({"longest_ns": max(int(os.read(pipe, 32)) for pipe in pipes)}))


if __name__ == "__main__":
    main()
