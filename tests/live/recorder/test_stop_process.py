"""``python -m recorder`` writes stops from the controller's ring, is killed, and the next one completes the file."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from typer.testing import CliRunner

from can_dbc.messages.record_ring import RecordRing
from controller.process.tick_recording import record
from recorder.stop_recorder import files_in, parts_in
from tests.controller.bench import Bench
from timberhand.cli import app


class RingBench(Bench):
    """A controller on the clock of this computer, whose ticks go into the ring."""

    def __init__(self, ring: RecordRing) -> None:
        super().__init__(start_ns=time.monotonic_ns())
        self.ring = ring

    def tick_with(self, *datagrams, **measured):
        outputs = super().tick_with(*datagrams, **measured)
        self.ring.append(record(self.inputs, outputs, self.now_ns))
        return outputs


@contextmanager
def recorder_process(directory: Path, name: str) -> Iterator[subprocess.Popen[str]]:
    words = ["--out", directory / name, "--ticks", directory / "ticks", "--report-port", "0"]
    words += ["--stops", directory / "stops"]
    with subprocess.Popen(
        [sys.executable, "-m", "recorder", *map(str, words)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        assert process.stdout is not None and "ready" in process.stdout.readline()
        try:
            yield process
        finally:
            process.kill()


def wait_for(done: object, seconds: float = 20.0) -> None:
    limit = time.monotonic() + seconds
    while not done():  # type: ignore[operator]
        assert time.monotonic() < limit
        time.sleep(0.02)


def explained(directory: Path) -> dict[str, object]:
    done = CliRunner().invoke(app, ["why", str(directory / "stops"), "--json"], catch_exceptions=False)
    return json.loads(done.stdout)["stops"][-1]


def test_a_killed_process_leaves_a_stop_that_can_be_read_and_the_next_one_completes_it(tmp_path: Path) -> None:
    ring = RecordRing(tmp_path / "ticks")
    try:
        with recorder_process(tmp_path, "first") as process:
            bench = RingBench(ring)
            bench.active(ticks=100)
            bench.dropped.add("EncLift")
            bench.run(40)
            wait_for(lambda: parts_in(tmp_path / "stops") and parts_in(tmp_path / "stops")[0].stat().st_size > 1000)
            process.send_signal(signal.SIGKILL)
            process.wait(10)
        stop = explained(tmp_path)
        assert (stop["code"], stop["mode_before"]) == ("ENCODER_LOST", "ACTIVE") and stop["utc_ns"] is not None
        with recorder_process(tmp_path, "second") as process:
            (path,) = files_in(tmp_path / "stops")
            assert not parts_in(tmp_path / "stops")
            process.send_signal(signal.SIGTERM)
            assert process.wait(20) == 0
        assert explained(tmp_path) == stop | {"recording": str(path)}
    finally:
        ring.close()
