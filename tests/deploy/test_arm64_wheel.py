"""The arm64 wheel, cross-compiled here, gives the bytes of arm64's interpreter on the kept recordings, in emulation."""

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


def test_the_arm64_wheel_gives_the_bytes_of_the_interpreter_there(tmp_path: Path) -> None:
    run("build.sh", tmp_path)
    (wheel,) = tmp_path.glob("*-linux_aarch64.whl")
    names = zipfile.ZipFile(wheel).namelist()
    assert "can_dbc/dbc/compiled_codecs.cpython-311-aarch64-linux-gnu.so" in names
    found = [json.loads(line) for line in run("replay.sh", wheel).splitlines()]
    assert [(row["tick"], row["machine"], row["ticks"]) for row in found] == [
        (tick, "aarch64", ticks) for ticks in (1600, 2200) for tick in ("interpreter", "compiled installed")
    ]
    for interpreter, compiled in zip(found[::2], found[1::2], strict=True):
        assert interpreter["digest"] == compiled["digest"]
    assert found[0]["differing"] == 0  # the fixed crane; the forwarder's differs from amd64 on both
