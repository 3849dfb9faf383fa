"""Every stop has a file of its own: 10 s before it and 5 s after it, whole whatever happens to the writer."""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path

import msgspec

from can_dbc.messages.tick_record import decode
from hil.replay.recording import messages
from recorder.recorder import TICK
from recorder.stop_recorder import TOPIC, Stop, files_in, parts_in
from tests.recorder.stopped_run import run_with_a_stop


def stop_of(path: Path) -> Stop:
    (data,) = messages([path], TOPIC)
    return msgspec.json.decode(data, type=Stop)


def times_s(path: Path) -> list[float]:
    """Times of the ticks in a file, relative to its stop."""
    at_ns = stop_of(path).at_ns
    return [(decode(data).now_ns - at_ns) / 1e9 for data in messages([path], TICK)]


# ---- the ring of files --------------------------------------------------------------------------------------------


# ---- a writer that dies -------------------------------------------------------------------------------------------


KILLED = """
import os, signal, sys
from pathlib import Path
from tests.recorder.stopped_run import RecordedBench, recorder_in
recorder = recorder_in(Path(sys.argv[1]), stops=Path(sys.argv[2]))
bench = RecordedBench([recorder])
bench.active(ticks=200)
bench.lose("EncLift", int(sys.argv[3]))
os.kill(os.getpid(), signal.SIGKILL)
"""


def test_a_killed_recorder_leaves_the_stop_and_the_next_one_repairs_it(tmp_path: Path) -> None:
    stops = tmp_path / "stops"
    run_with_a_stop(tmp_path / "first", after=20, stops=stops)
    (earlier,) = files_in(stops)
    before = earlier.read_bytes()
    command = [sys.executable, "-c", KILLED, str(tmp_path / "second"), str(stops), "120"]
    done = subprocess.run(command, cwd=Path(__file__).parents[3], check=False)
    assert done.returncode == -signal.SIGKILL and len(parts_in(stops)) == 1
    run_with_a_stop(tmp_path / "third", after=20, stops=stops)
    assert [stop_of(path).number for path in files_in(stops)] == [1, 2, 3] and not parts_in(stops)
    assert earlier.read_bytes() == before
    killed = files_in(stops)[1]
    assert times_s(killed)[-1] > 0.3, "what was committed after the stop is there too"
