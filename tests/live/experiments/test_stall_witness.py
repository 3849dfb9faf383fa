"""The witness of the host's stalls, as the vcan experiment and the live tests use it."""

from __future__ import annotations

import os
import time

from experiments.common.stall_witness import Witness


def test_a_witness_tells_every_wake_up_that_was_late_enough() -> None:
    begin_ns = time.monotonic_ns()
    with Witness(max(os.sched_getaffinity(0)), priority=0, least_us=0) as witness:
        while not witness.stalls():
            time.sleep(0.01)
    assert all(stall.stall_ns >= 0 and stall.end_ns > begin_ns for stall in witness.stalls())
