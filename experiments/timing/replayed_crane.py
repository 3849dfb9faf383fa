"""One controller in real time on recorded inputs: ``python -m experiments.timing.replayed_crane RECORDING --cpu 1``.

It shows how many controllers one processor carries, where no computer could emulate as many machines.  Every period it
makes the system calls of the controller's loop on sockets of its own (both buses, setpoints, record), and runs the tick
on the recorded inputs, so that every tick must come out as it was recorded.  The stand-in for the machine, which fills
the sockets and empties them, runs on the same processor outside the measured tick: the count of controllers that fit
is therefore a little too small, never too large.

``--start-at NS`` is the first deadline (CLOCK_MONOTONIC).  At the end it prints one JSON object.
"""

from __future__ import annotations

import argparse
import contextlib
import gc
import json
import socket
import sys
import time
from collections.abc import Sequence
from itertools import islice
from pathlib import Path

from runtime.compiled import activate

activate()

from can_dbc.bus.frame_socket import FrameSocket  # noqa: E402
from can_dbc.frame import Frame, RawFrame  # noqa: E402
from controller.process.realtime import prepare, sleep_until  # noqa: E402
from controller.process.tick_recording import record, restore_inputs, transmitted  # noqa: E402
from controller.step import Controller, step  # noqa: E402
from controller.tick import Inputs  # noqa: E402
from hil.replay.recording import files_of, manifest_of  # noqa: E402
from hil.replay.replay import profile_beside, recorded_ticks, settings_for  # noqa: E402

PRIORITY = 80


class BusPair:
    """A bus whose far end is in this process."""

    def __init__(self) -> None:
        self.near, self._far = map(FrameSocket, socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM))
        self._frames: list[Frame] = []

    def exchange(self, frames: Sequence[Frame]) -> None:
        """Take what was sent, and offer the frames of the next tick."""
        self.receive(self._far)
        self._far.send([(key, data) for _, key, data in frames])

    def receive(self, end: FrameSocket) -> None:
        """Receive as the controller does; the tick then runs on the recorded stamps."""
        self._frames.clear()
        end.receive(self._frames, 1024, lambda _key, _data: False)

    def send(self, frames: Sequence[RawFrame]) -> None:
        """Send as the controller does."""
        if frames:
            self.near.send(frames)


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    parser = argparse.ArgumentParser(prog="python -m experiments.timing.replayed_crane")
    parser.add_argument("recording", type=Path)
    parser.add_argument("--ticks", type=int, required=True)
    parser.add_argument("--cpu", type=int, required=True)
    parser.add_argument("--start-at", type=int, required=True, metavar="NS", help="first deadline")
    options = parser.parse_args(arguments)
    files = files_of(options.recording)
    ticks = list(islice(recorded_ticks(files), options.ticks))
    settings = settings_for(manifest_of(files), ticks[:64], profile_beside(files))
    controller, inputs, buses = Controller(settings), Inputs(), (BusPair(), BusPair())
    sink, setpoints = (socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2))
    sink.bind(("127.0.0.1", 0))
    setpoints.setblocking(False)
    address, period_ns, deadline_ns = sink.getsockname(), settings.period_ns, options.start_at
    missed = differing = process_ns = 0
    gc.collect()
    gc.freeze()
    gc.disable()
    prepare(PRIORITY, options.cpu)
    for tick in ticks:
        buses[0].exchange(tick.frames_in)
        buses[1].exchange(tick.machine_frames_in)
        sleep_until(deadline_ns)
        late_ns = time.monotonic_ns() - deadline_ns
        begin_ns = time.thread_time_ns()
        for bus in buses:
            bus.receive(bus.near)
        with contextlib.suppress(OSError):  # nothing waits
            setpoints.recv(2048)
        restore_inputs(inputs, tick)
        outputs = step(controller, inputs, tick.now_ns)
        buses[0].send(outputs.frames)
        buses[1].send(outputs.machine_frames)
        setpoints.sendto(record(inputs, outputs, tick.now_ns), address)
        process_ns += time.thread_time_ns() - begin_ns
        sink.recv(65_536)
        made = transmitted(outputs)
        differing += made != (tick.frames_out, tick.machine_frames_out, tick.report, tick.vehicle_report)
        missed += late_ns >= period_ns
        deadline_ns += period_ns * (1 + max(0, late_ns // period_ns))
    cpu_us = process_ns / len(ticks) / 1e3
    summary = {"ticks": len(ticks), "missed": missed, "differing": differing, "cpu_us": cpu_us}
    print(json.dumps(summary), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
