"""A recording opens in the page from the command line, at its newest stop with `timberhand why --page`."""

from __future__ import annotations

import json
import lzma
import signal
import subprocess
import sys
import urllib.request
from pathlib import Path

import pytest

KEPT = Path(__file__).parents[2] / "recordings"


@pytest.fixture
def run(tmp_path: Path) -> Path:
    (tmp_path / "run.mcap").write_bytes(lzma.decompress((KEPT / "palms.mcap.xz").read_bytes()))
    return tmp_path


def test_a_recording_is_served_and_named(run: Path) -> None:
    command = [sys.executable, "-m", "timberhand", "console", "--port", "0", "--replay", str(run)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            url = json.loads(process.stdout.readline())["url"]
            with urllib.request.urlopen(f"{url}api/machine", timeout=10) as answer:
                told = json.load(answer)
        finally:
            process.send_signal(signal.SIGINT)
    assert told["name"] == "palms_471" and str(run) in told["recording"]["name"]
    assert told["recording"]["end_s"] > told["recording"]["begin_s"]
