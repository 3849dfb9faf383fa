"""Witness of the host's stalls on one processor: ``python -m experiments.timing.stall_witness --period-us 2000``.

It wakes at absolute deadlines, does nothing, and prints a JSON line for every wake-up that was late by `LEAST_NS` or
more: ``{"stall_ns": ..., "end_ns": ...}``, on CLOCK_MONOTONIC.  Above the priority of everything else on its processor
only the kernel or the hypervisor can delay it, so a frame or a stop that was lost meanwhile is the host's.
Exit code 0, stopped by SIGTERM or SIGINT.
"""

from __future__ import annotations

import argparse
import gc
import json
import signal
import sys
import time
from typing import Final

from controller.process.realtime import sleep_until

LEAST_NS: Final = 3_000_000
"""The shortest stall that is told: shorter ones lose no frame and stop no machine, even at 1 kHz."""


def main(arguments: list[str] | None = None) -> int:
    """Command line; returns the exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m experiments.timing.stall_witness", description="Tell when a processor stood still."
    )
    parser.add_argument("--period-us", type=int, required=True)
    period_ns = 1000 * parser.parse_args(arguments).period_us
    ended: list[int] = []
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda which, _frame: ended.append(which))
    gc.collect()
    gc.freeze()
    print("ready", flush=True)
    deadline_ns = time.monotonic_ns() + period_ns
    while not ended:
        sleep_until(deadline_ns)
        now_ns = time.monotonic_ns()
        late_ns = now_ns - deadline_ns
        if late_ns >= LEAST_NS:
            print(json.dumps({"stall_ns": late_ns, "end_ns": now_ns}), flush=True)
        deadline_ns += period_ns * (1 + late_ns // period_ns)
    return 0


if __name__ == "__main__":
    sys.exit(main())
