"""A mission as processes with the machine's own camera, in simulated time: the plant serves pictures, a detector of its
own measures the logs in them while the machine drives, and the planner works from memory.
"""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from tests.hil.short_missions import mission_file
from tests.live.host.lab_runs import in_simulated_time

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
    path, out = mission_file(tmp_path / "mission.geojson", *LOGS), tmp_path / "run"
    words = f"-m timberhand mission run {path} --bus {bus} --seed {seed} --detector own --no-console --out {out}"
    lines, told = in_simulated_time(out, *words.split(), memory_mb=3072)
    assert told["finished"] and told["in_bunk"] == told["loaded"] == told["logs"] == len(LOGS)
    assert told["stops"] == told["refused"] == 0 and not told["given_up"] and not told["remarks"]
    assert any("'front'" in line for line in lines)
    assert not any("detector:" in line for line in lines), "every picture could be used"
    assert not (out / "detector.err").read_text() and "cameras.front" in (out / "surveyed.toml").read_text()
