"""The log detector takes pictures while the crane is at rest, and reports problems."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

CAMERA = "stick"


def test_the_process_refuses_a_camera_that_the_machine_does_not_have() -> None:
    done = run("--camera", "moon", "--frames", "127.0.0.1:1")
    assert done.returncode == 3
    assert "moon" in done.stderr and CAMERA in done.stderr


def test_the_process_refuses_damaged_weights(tmp_path: Path) -> None:
    bad = tmp_path / "bad.onnx"
    bad.write_bytes(b"nothing")
    done = run("--camera", CAMERA, "--frames", "127.0.0.1:1", "--weights", bad)
    assert done.returncode == 3
    assert str(bad) in done.stderr and "Traceback" not in done.stderr


def run(*arguments: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "autonomy.perception", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=False, timeout=60)
