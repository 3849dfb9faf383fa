"""The console's server: permissions, guards and the page's state."""

from __future__ import annotations

import socket
import subprocess
import sys
from pathlib import Path

import pytest

from console.console import Console
from machine.loading.profile_file import load_profile, profile_hash
from tests.operator_end import OperatorEnd

PROFILE = load_profile("palms_471")


@pytest.fixture
def operator_socket(tmp_path):
    """The controller's end of the operator's commands."""
    with OperatorEnd(tmp_path / "operator") as s:
        s.settimeout(5)
        yield s


@pytest.fixture
def console(operator_socket):
    return Console(PROFILE, profile_hash(PROFILE), Path(operator_socket.getsockname()), clock=lambda: 10**10)


# ---- the pure part ----------------------------------------------------------------------------------------------


# ---- the process ------------------------------------------------------------------------------------------------


def run_console(*arguments):
    return subprocess.run(
        [sys.executable, "-m", "console", *map(str, arguments)], capture_output=True, text=True, timeout=30
    )


def test_start_errors_are_one_sentence_with_an_exit_code():
    with socket.socket() as page, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as reports:
        page.bind(("127.0.0.1", 0))
        page.listen()
        reports.bind(("127.0.0.1", 0))
        busy, port = page.getsockname()[1], reports.getsockname()[1]
        cases = [
            (4, "--port", busy, "--report-port", 0),
            (4, "--port", 0, "--report-port", port),
            (3, "--port", 0, "--report-port", 0, "--profile", "palms"),
            (2, "--port", 0, "--report-port", 0, "--planner", "nowhere"),
            (2, "--port", 0, "--report-port", 0, "--bus", "crane9=wire:crane9"),
        ]
        for code, *arguments in cases:
            done = run_console(*arguments)
            assert (done.returncode, done.stderr.count("\n"), "Traceback" in done.stderr) == (code, 1, False)
