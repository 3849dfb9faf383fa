"""Queries systemd and the kernel about a service."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Sequence
from pathlib import Path


def systemctl(*words: str) -> subprocess.CompletedProcess[str]:
    """Run systemctl and return its output."""
    return subprocess.run(["systemctl", "--no-pager", *words], capture_output=True, text=True, check=False)


def show(unit: str, *names: str) -> dict[str, str]:
    """Return properties of one unit, by name."""
    return next(iter(show_all([unit], *names)), {})


def show_all(units: Sequence[str], *names: str) -> list[dict[str, str]]:
    """Return properties of several units, in the order of ``units``."""
    blocks = systemctl("show", *units, "--property", ",".join(names)).stdout.split("\n\n")
    return [dict(line.partition("=")[::2] for line in block.splitlines()) for block in blocks if block.strip()]


def main_pid(unit: str) -> int:
    """Return the main process of a unit; 0 when there is none."""
    return int(show(unit, "MainPID").get("MainPID") or 0)


def journal(unit: str) -> list[str]:
    """Return every journal line of the unit, including those of systemd about it."""
    subprocess.run(["journalctl", "--sync"], check=False)
    command = ["journalctl", "--no-pager", "--output", "cat", "--unit", unit]
    return subprocess.run(command, capture_output=True, text=True, check=False).stdout.splitlines()


def last_journal_line(unit: str) -> str:
    """Return the last journal line of the unit's processes; empty when this user may not read it."""
    command = ["journalctl", "--no-pager", "--quiet", "--output", "cat", "--lines", "1", f"_SYSTEMD_UNIT={unit}"]
    return subprocess.run(command, capture_output=True, text=True, check=False).stdout.strip()


def process_facts(pid: int) -> dict[str, object]:
    """Return scheduling, rights and locked memory of a running process."""
    status = dict(line.partition(":\t")[::2] for line in Path(f"/proc/{pid}/status").read_text().splitlines())
    return {
        "policy": {os.SCHED_OTHER: "other", os.SCHED_FIFO: "fifo"}.get(os.sched_getscheduler(pid), "another"),
        "priority": os.sched_getparam(pid).sched_priority,
        "processors": sorted(os.sched_getaffinity(pid)),
        "locked_kb": int(status["VmLck"].split()[0]),
        "user": int(status["Uid"].split()[1]),
        "capabilities": int(status["CapEff"], 16),
        "no_new_privileges": status["NoNewPrivs"] == "1",
        "seccomp": status["Seccomp"] == "2",
    }
