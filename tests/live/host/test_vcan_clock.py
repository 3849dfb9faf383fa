"""The clock of a live run in user-mode Linux: measured, chosen, announced."""

from __future__ import annotations

import os

from host.vcan_lab import choose


def test_the_probe_sees_a_processor_that_others_use() -> None:
    alone = choose.measure(0.3)
    assert 0.0 <= alone.share < 1.0 and alone.longest_ns >= 0
    last = max(os.sched_getaffinity(0))
    rivals = []
    try:
        for _ in range(3):
            pid = os.fork()
            if pid == 0:
                os.setsid()
                os.sched_setaffinity(0, {last})
                os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(1)) if os.geteuid() == 0 else None
                while True:
                    pass
            rivals.append(pid)
        assert choose.measure(0.5).share > alone.share
    finally:
        for pid in rivals:
            os.kill(pid, 9)
            os.waitpid(pid, 0)
