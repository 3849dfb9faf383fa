"""The fixture that runs the vcan lab."""

from __future__ import annotations

import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.live.host.lab_runs import LAB, ROOT, Run, environment, require_lab


@pytest.fixture(scope="module")
def lab() -> Iterator[Run]:
    """Runs ``python -m host.vcan_lab *arguments``; skips where this machine has no way to a lab."""
    require_lab()

    def run(*arguments: str, cwd: Path = ROOT, **env: str) -> subprocess.CompletedProcess[bytes]:
        return subprocess.run(
            [*LAB, *arguments], cwd=cwd, env=environment(**env), capture_output=True, timeout=100, check=False
        )

    yield run
