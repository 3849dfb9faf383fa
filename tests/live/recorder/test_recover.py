"""A recording survives the death of its writer at any byte (fault 37)."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import threading
import time

import can
import pytest
from mcap.reader import make_reader

from can_dbc.bus.factory import open_bus
from can_dbc.messages import tick_record
from can_dbc.messages.record_ring import RecordRing, RingReader
from recorder import manifest as manifests
from recorder.__main__ import FLUSH_PERIOD_S, InputCollector, udp_socket, write_all
from recorder.recorder import CHUNK_NS, TICK, Recorder
from recorder.recover import Stored, is_complete, recover, scan
from tests.operator_end import udp_end
from tests.recorder.recordings import PROFILE, T_NS, manifest


def ticks_of(path):
    """The tick records, read with the library's indexed reader."""
    with path.open("rb") as file:
        return [m.data for _, _, m in make_reader(file).iter_messages(topics=["/controller/tick"])]


# ---- the process ------------------------------------------------------------------------------------------------


def free_port():
    with udp_end(None) as s:
        return s.getsockname()[1]


class Process:
    """``python -m recorder`` on a private python-can bus of this machine, and a sender of ticks."""

    def __init__(self, out):
        self.out, self.ticks = out, out / "controller.ticks"
        self.process = subprocess.Popen(
            [
                sys.executable,
                "-m",
                "recorder",
                "--out",
                out,
                "--ticks",
                str(self.ticks),
                "--report-port",
                str(free_port()),
                "--bus",
                "crane0=virtual:recorder-test",
            ],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        assert "ready" in self.process.stdout.readline()
        self.ring = RecordRing(self.ticks)
        self.sent = []

    def send(self, seconds):
        """Ticks stamped and sent in real time."""
        start = time.monotonic_ns()
        while time.monotonic_ns() - start < seconds * 1e9:
            now = time.monotonic_ns()
            quiet = tick_record.BusReading()
            data = tick_record.encode(tick_record.TickRecord(now, 0, 0, 0, quiet, quiet, (), (), (), (), (), b""))
            self.ring.append(data)
            self.sent.append(data)
            time.sleep(T_NS / 1e9)

    def end(self, number):
        self.process.send_signal(number)
        return self.process.wait(10)

    def close(self):
        """Leaves no process behind, also when a test fails half-way."""
        if self.process.poll() is None:
            self.process.kill()
            self.process.wait()
        self.process.stdout.close()
        self.process.stderr.close()
        self.ring.close()


@pytest.fixture
def live(tmp_path):
    with contextlib.closing(Process(tmp_path)) as process:
        yield process


def test_a_killed_recorder_loses_only_the_last_moment(live, tmp_path):
    assert CHUNK_NS / 1e9 <= 0.25 and FLUSH_PERIOD_S <= 0.25
    live.send(0.4)
    path, first, limit = tmp_path / "run.mcap", len(live.sent), time.monotonic() + 20
    # The timer brings the last chunk to the file although nothing more comes.
    while (seen := sum(isinstance(r, Stored) for r in scan(path, {TICK}))) < first and time.monotonic() < limit:
        time.sleep(0.02)
    assert seen == first
    live.send(0.3)
    live.end(signal.SIGKILL)
    assert not is_complete(path)
    assert len(recover(tmp_path)) == 1
    kept = ticks_of(path)
    assert kept == live.sent[: len(kept)] and len(kept) >= first
    assert manifests.read(tmp_path).complete is False


def test_the_collector_records_what_is_on_a_bus(tmp_path):
    with open_bus("virtual:collector-test") as mine, open_bus("virtual:collector-test") as plant:
        inputs = InputCollector({"crane0": mine}, RingReader(tmp_path / "controller.ticks"), udp_socket(0))
        recorder = Recorder(tmp_path, PROFILE, manifest(live=True))
        writer = threading.Thread(target=write_all, args=(recorder, inputs))
        writer.start()
        receiver = threading.Thread(target=inputs.run)
        receiver.start()
        for k in range(50):
            assert plant.send(0x80, bytes([k]))
        limit = time.monotonic() + 20
        while mine.stats.received < 50 and time.monotonic() < limit:
            time.sleep(0.01)
        inputs.end()
        receiver.join(10)
        writer.join(10)
    got = list(can.CanutilsLogReader(tmp_path / "crane0.log"))
    assert [(m.arbitration_id, m.data[0]) for m in got] == [(0x80, k) for k in range(50)]
    assert manifests.read(tmp_path).complete


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_stopped_recorder_leaves_complete_files(live, tmp_path, number):
    live.send(0.3)
    assert live.end(number) == 0
    assert ticks_of(tmp_path / "run.mcap") == live.sent
    assert manifests.read(tmp_path).complete is True
    assert list(can.CanutilsLogReader(tmp_path / "crane0.log")) == []


@pytest.mark.parametrize(
    ("code", "arguments"),
    [
        (3, ["--out", "/proc/nowhere"]),
        (3, ["--out", "OUT", "--profile", "palms"]),
        (4, ["--out", "OUT", "--bus", "crane0=nonsense"]),
        (2, ["--out", "OUT", "--bus", "rail0=virtual:x"]),
    ],
)
def test_unusable_arguments_are_reported_at_once(tmp_path, code, arguments):
    arguments = [str(tmp_path) if a == "OUT" else a for a in arguments]
    done = subprocess.run(
        [sys.executable, "-m", "recorder", "--report-port", "0", *arguments],
        capture_output=True,
        text=True,
        timeout=30,
        env={**os.environ, "COLUMNS": "200"},
    )
    assert done.returncode == code and "Traceback" not in done.stderr
    assert done.stderr.strip().splitlines()[-1].count("recorder: ") >= 1
