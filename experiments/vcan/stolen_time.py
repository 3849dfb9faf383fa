"""Time that the host took during a run: a probe beside the run, and /proc/stat.

The probe is a thread that sleeps to absolute deadlines on the lab's processor with the highest priority: no process of
this computer delays it, so what it wakes late is time that the hypervisor took, also where /proc/stat reports none.
Without the right to that priority its figures contain other processes too; ``real_time`` tells.
"""

from __future__ import annotations

import os
import threading
import time
from pathlib import Path
from typing import Final

PERIOD_NS: Final = 2_000_000
LATE_NS: Final = 500_000
"""Ordinary wake-ups are earlier."""
_PRIORITY: Final = 99
_STEAL: Final = 8
"""Index of steal in a line of /proc/stat: name user nice system idle iowait irq softirq steal."""


class StolenTime:
    """Measures while used as a context manager; afterwards the figures, in ms.

    ``lost_ms``: sum of the probe's delays; ``longest_ms``: the longest; ``steal_ms``: /proc/stat, all processors.
    """

    def __init__(self) -> None:
        self.lost_ms = self.longest_ms = self.steal_ms = 0.0
        self.real_time = False
        self._running = True
        self._thread = threading.Thread(target=self._run, name="probe")

    def __enter__(self) -> StolenTime:
        self._before_ms = steal_ms(Path("/proc/stat").read_text())
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._running = False
        self._thread.join()
        self.steal_ms = steal_ms(Path("/proc/stat").read_text()) - self._before_ms

    def _run(self) -> None:
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})  # 0: this thread; the lab claims the last one first
        try:
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(_PRIORITY))
            self.real_time = True
        except OSError:
            pass
        deadline_ns = time.monotonic_ns() + PERIOD_NS
        while self._running:
            time.sleep(max(0, deadline_ns - time.monotonic_ns()) * 1e-9)
            late_ns = time.monotonic_ns() - deadline_ns
            if late_ns > LATE_NS:
                self.lost_ms += late_ns * 1e-6
                self.longest_ms = max(self.longest_ms, late_ns * 1e-6)
                deadline_ns += late_ns // PERIOD_NS * PERIOD_NS
            deadline_ns += PERIOD_NS


def steal_ms(stat: str) -> float:
    """Steal of all processors since boot, from the text of /proc/stat; 0 where it is not reported."""
    words = stat.partition("\n")[0].split()
    return float(words[_STEAL]) * 1e3 / os.sysconf("SC_CLK_TCK") if len(words) > _STEAL else 0.0
