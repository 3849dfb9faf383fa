"""Witness of the host's stalls on one processor: ``python -m experiments.common.stall_witness --period-us 2000``.

It wakes at absolute deadlines, does nothing, and prints a JSON line for every wake-up that was late by ``--least-us``
or more: ``{"stall_ns": ..., "end_ns": ...}``, on CLOCK_MONOTONIC.  Above the priority of everything else on its
processor only the kernel or the hypervisor can delay it, so a frame or a stop that was lost meanwhile is the host's.
Exit code 0, stopped by SIGTERM or SIGINT.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from typing import Final, Self

from controller.process.realtime import sleep_until
from hil.harness.processes import announce_ready

PERIOD_US: Final = 2000
LEAST_US: Final = 3000
"""The shortest stall that is told: shorter ones lose no frame and stop no machine, even at 1 kHz."""


@dataclass(frozen=True, slots=True)
class Stall:
    """The witness did not run for ``stall_ns``, until ``end_ns`` on CLOCK_MONOTONIC."""

    stall_ns: int
    end_ns: int


class Witness:
    """A witness process on processor ``cpu`` with SCHED_FIFO ``priority``, until the end of the context.

    ``real_time``: whether the system granted the priority; without it other processes delay the witness, too.
    """

    def __init__(self, cpu: int, priority: int, least_us: int = LEAST_US) -> None:
        self._out = tempfile.TemporaryFile("w+")  # noqa: SIM115  its reader outlives the process
        self._process = subprocess.Popen(
            [sys.executable, "-m", __name__, "--period-us", str(PERIOD_US), "--least-us", str(least_us)],
            stdin=subprocess.DEVNULL,
            stdout=self._out,
        )
        self.real_time = False
        with contextlib.suppress(OSError):
            os.sched_setaffinity(self._process.pid, {cpu})
            os.sched_setscheduler(self._process.pid, os.SCHED_FIFO, os.sched_param(priority))
            self.real_time = True

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.end()

    def stalls(self) -> list[Stall]:
        """Read the stalls so far."""
        output_text = os.pread(self._out.fileno(), os.fstat(self._out.fileno()).st_size, 0).decode()
        return [
            Stall(**json.loads(line))
            for line in output_text.splitlines()
            if line.startswith("{") and line.endswith("}")
        ]

    def end(self) -> None:
        """End the process; its stalls can still be read."""
        self._process.terminate()
        self._process.wait()


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m experiments.common.stall_witness", description="Tell when a processor stood still."
    )
    parser.add_argument("--period-us", type=int, default=PERIOD_US)
    parser.add_argument("--least-us", type=int, default=LEAST_US)
    options = parser.parse_args(arguments)
    period_ns, least_ns = 1000 * options.period_us, 1000 * options.least_us
    ended = announce_ready()
    deadline_ns = time.monotonic_ns() + period_ns
    while not ended:
        sleep_until(deadline_ns)
        now_ns = time.monotonic_ns()
        late_ns = now_ns - deadline_ns
        if late_ns >= least_ns:
            print(json.dumps({"stall_ns": late_ns, "end_ns": now_ns}), flush=True)
        deadline_ns += period_ns * (1 + late_ns // period_ns)
    return 0


if __name__ == "__main__":
    sys.exit(main())
