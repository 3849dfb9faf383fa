"""Runs of the vcan lab as a person starts them, for tests."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from host.vcan_lab.choose import choose, survey
from host.vcan_lab.spec import LabError, Request

ROOT = Path(__file__).parents[2]
LAB = [sys.executable, "-m", "host.vcan_lab"]
REQUEST = Request(
    argv=("true",), cwd="/", env={"A": "b"}, uid=1000, gid=100, groups=(100, 4), umask=0o22, mem_mb=256
)  # fmt: skip
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


def descendants(pid: int) -> set[int]:
    """Processes below ``pid``, whatever group or session they are in."""
    parents: dict[int, int] = {}
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = stat.read_text().rsplit(")", 1)[1].split()
        except (FileNotFoundError, ProcessLookupError):
            continue
        if fields[0] != "Z":
            parents[int(stat.parent.name)] = int(fields[1])
    found, grown = set(), {pid}
    while grown:
        grown = {child for child, parent in parents.items() if parent in grown} - found
        found |= grown
    return found


def wait_until(condition: Callable[[], object], what: str) -> None:
    deadline = time.monotonic() + TIMEOUT_S
    while not condition():
        assert time.monotonic() < deadline, what
        time.sleep(0.02)
