"""What tests of several folders need."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable
from typing import Any

import pytest
from hypothesis import settings

from can_dbc.timing.durations import Durations
from can_dbc.timing.page import STAGES, BusCounters, Facts, InputAge, ProcessCounters, Timing

settings.register_profile("no clock", deadline=None)  # how long an example takes is the host's affair, and no failure
settings.load_profile("no clock")

# The tests keep every processor busy, so a compiler of the lowest priority beside them would never be ready.
os.environ.setdefault("TIMBERHAND_NO_WAIT", "1")

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    # A shell starts so what it runs in the background, and the children of the tests would inherit it.
    signal.signal(signal.SIGINT, signal.default_int_handler)


def a_timing(count: int = 100, **facts: Any) -> Timing:
    """A controller's timing page after ``count`` ticks, told just now; the i-th stage took from 10 (i + 1) us on."""
    made = {name: Durations() for name in STAGES}
    for i, found in enumerate(made.values()):
        for k in range(count):
            found.add((i + 1) * 10_000 + k)
    now_ns = time.monotonic_ns()
    inputs = {f"Input{i}": InputAge(1_000_000, (10 + i) * 1_000_000, 1000) for i in range(7)}
    usual = {
        "pid": 4711, "started_ns": now_ns - 8000 * 10**9, "written_ns": now_ns, "period_ns": 5_000_000, "ticks": count,
        "missed": 0, "late": 0, "mode": "STANDBY", "words": "STANDBY. All is well.",
        "buses": (BusCounters("crane0", "ACTIVE", 12_345_678, 2_345_678, 0, 0, 2, 1),
                  BusCounters("mach0", "DOWN", 5, 6, 7, 0, 0, 0)),
        "process": ProcessCounters(800 * 10**9, 100, 2, 3, 4, 5, 6, 61_440),
        "inputs": inputs | {"Never": InputAge()},
        "longest_ns": tuple(made[n].longest_ns for n in STAGES), "total_ns": tuple(made[n].total_ns for n in STAGES),
    }  # fmt: skip
    return Timing(Facts(**(usual | facts)), made)


@pytest.fixture
def timing() -> Callable[..., Timing]:
    """`a_timing`."""
    return a_timing
