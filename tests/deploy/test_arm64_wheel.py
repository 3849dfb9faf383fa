"""The arm64 wheel, cross-compiled here, replays the kept recordings to the same bytes in emulation."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

pytestmark = [pytest.mark.slow, pytest.mark.computed, pytest.mark.timeout(1800)]
ROOT = Path(__file__).parents[2]
TOOL_MISSING = 3


def run(script: str, *arguments: object) -> str:
    """A script's answer; skips by its own sentence when a tool or the network is missing."""
    done = subprocess.run(
        ["sh", ROOT / "deploy" / "arm64" / script, *map(str, arguments)],
        env={**os.environ, "PYTHON": sys.executable}, capture_output=True, text=True,
    )  # fmt: skip
    if done.returncode == TOOL_MISSING:
        pytest.skip(done.stderr.strip().splitlines()[-1])
    assert done.returncode == 0, done.stdout + done.stderr[-2000:]
    return done.stdout


def test_the_arm64_wheel_gives_the_recorded_bytes(tmp_path: Path) -> None:
    run("build.sh", tmp_path)
    (wheel,) = tmp_path.glob("*-linux_aarch64.whl")
    names = zipfile.ZipFile(wheel).namelist()
    assert "can_dbc/dbc/compiled_codecs.cpython-311-aarch64-linux-gnu.so" in names
    found = [json.loads(line) for line in run("replay.sh", wheel).splitlines()]
    assert [row | {"ticks": 0} for row in found] == [
        {"tick": "compiled installed", "machine": "aarch64", "ticks": 0, "differing": 0}
    ] * 2
    assert [row["ticks"] for row in found] == [1600, 2200]
