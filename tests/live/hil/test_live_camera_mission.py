"""A mission as processes with the machine's own camera, in simulated time: the plant serves pictures, a detector of its
own measures the logs in them while the machine drives, and the planner works from memory.
"""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
from pathlib import Path

import pytest

from host.vcan_lab import uml
from tests.hil.short_missions import mission_file

ROOT = Path(__file__).parents[3]
LOGS = (
    (7.0, 3.6, 80.0),
    (8.5, -3.7, 100.0),
    (10.0, 3.7, 75.0),
    (11.5, -3.5, 95.0),
    (13.0, 3.5, 110.0),
    (14.5, -3.6, 70.0),
)


@pytest.mark.timeout(3600)
@pytest.mark.bears(math.inf)
@pytest.mark.parametrize(("bus", "seed"), [("wire", 1), ("vcan", 2), ("vcan", 3)])  # each takes 4 to 12 minutes
def test_six_logs_are_loaded_by_the_machines_own_camera(tmp_path: Path, bus: str, seed: int) -> None:
    if uml.find(uml.user_cache()) is None:
        pytest.skip(uml.MISSING)
    path, out = mission_file(tmp_path / "mission.geojson", *LOGS), tmp_path / "run"
    done = subprocess.run(
        [
            sys.executable,
            "-m",
            "host.vcan_lab",
            "--time-travel",
            "--mem",
            "3072",
            "--",
            sys.executable,
            "-m",
            "timberhand",
            "mission",
            "run",
            path,
            "--bus",
            bus,
            "--seed",
            str(seed),
            "--detector",
            "own",
            "--no-console",
            "--out",
            out,
        ],
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, (done.stdout[-3000:], done.stderr[-3000:])
    told = json.loads((out / "summary.json").read_text())
    assert told["finished"] and told["in_bunk"] == told["loaded"] == told["logs"] == len(LOGS)
    assert told["stops"] == told["refused"] == 0 and not told["given_up"] and not told["remarks"]
    lines = done.stdout.splitlines()
    assert any("'front'" in line for line in lines)
    assert not any("detector:" in line for line in lines), "every picture could be used"
    assert not (out / "detector.err").read_text() and "cameras.front" in (out / "surveyed.toml").read_text()
