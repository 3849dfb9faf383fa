"""Runs of the labs as a person starts them, for tests."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from host.vcan_lab import uml
from host.vcan_lab.choose import choose, survey
from host.vcan_lab.spec import LabError
from tests.host.vcan_request import REQUEST

ROOT = Path(__file__).parents[3]
LAB = [sys.executable, "-m", "host.vcan_lab"]
TIMEOUT_S = 30.0
Run = Callable[..., subprocess.CompletedProcess[bytes]]


def require_lab() -> str:
    try:
        return choose(survey(replace(REQUEST, uid=os.getuid()))).kind
    except LabError as reason:
        pytest.skip(str(reason))


def environment(**changed: str) -> dict[str, str]:
    paths = os.pathsep.join(filter(None, (str(ROOT), os.environ.get("PYTHONPATH"))))
    return {**os.environ, "PYTHONPATH": paths, **changed}


def eldest_child(pid: int) -> int:
    """The child of ``pid`` that was started first, once there is one.  Numbers wrap around: the least says nothing."""

    def born(child: int) -> int:
        return int(Path(f"/proc/{child}/stat").read_text().rsplit(")", 1)[1].split()[19])

    wait_until(lambda: [child for child, parent in parents().items() if parent == pid], f"{pid} has no child")
    return min((child for child, parent in parents().items() if parent == pid), key=born)


def parents() -> dict[int, int]:
    """The parent of every process that lives."""
    found: dict[int, int] = {}
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = stat.read_text().rsplit(")", 1)[1].split()
        except (FileNotFoundError, ProcessLookupError):
            continue
        if fields[0] != "Z":
            found[int(stat.parent.name)] = int(fields[1])
    return found


def descendants(pid: int) -> set[int]:
    """Processes below ``pid``, whatever group or session they are in."""
    below = parents()
    found, grown = set(), {pid}
    while grown:
        grown = {child for child, parent in below.items() if parent in grown} - found
        found |= grown
    return found


def wait_until(condition: Callable[[], object], what: str) -> None:
    deadline = time.monotonic() + TIMEOUT_S
    while not condition():
        assert time.monotonic() < deadline, what
        time.sleep(0.02)


def completed(module: str, timeout_s: int) -> dict[str, Any]:
    """The result of a lab whose checks all passed."""
    done = subprocess.run(
        [sys.executable, "-m", module, "--timeout", str(timeout_s)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.stdout, done.stderr
    result = json.loads(done.stdout)
    assert result["failed"] == [], done.stderr
    assert done.returncode == 0
    return dict(result)


def in_simulated_time(out: Path, *command: object, memory_mb: int = 0) -> tuple[list[str], dict[str, Any]]:
    """The lines and the summary in ``out`` of a mission that a Python command drove in the lab; skips without one."""
    if uml.find(uml.user_cache()) is None:
        pytest.skip(uml.MISSING)
    memory = ["--mem", str(memory_mb)] if memory_mb else []
    done = subprocess.run(
        [*LAB, "--time-travel", *memory, "--", sys.executable, *map(str, command)],
        cwd=ROOT,
        env=environment(),
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, (done.stdout[-3000:], done.stderr[-3000:])
    return done.stdout.splitlines(), json.loads((out / "summary.json").read_text())
