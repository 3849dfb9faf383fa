"""One live run on SocketCAN, as a user types it, and what its output, its summary and the host say about it."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

from experiments.common import host_activity
from experiments.common.pool import Job
from experiments.common.stall_witness import Witness
from machine.status.explanation import describe
from machine.status.reasons import Reason

MISSION: Final = "docs/examples/paper_b.geojson"
MISSION_LOGS: Final = 3
LIMIT_S: Final = 1800.0
"""Of the host; a run that takes longer is ended and counts as not done."""
PROBE_PRIORITY: Final = 99
LATE_US: Final = 500
"""Ordinary wake-ups are earlier."""
_CLOCK: Final = re.compile(r"^vcan lab: (real|simulated) time: (.*)$", re.MULTILINE)
_MODE: Final = re.compile(r"^ *[0-9.]+ s +(STOP|FAULT): (.*)$", re.MULTILINE)


def command(kind: str, seed: int, out: Path) -> list[str]:
    """The user's command line for one run."""
    mission = ["mission", "run", MISSION, "--logs", str(MISSION_LOGS), "--detector", "perfect"]
    job = mission if kind == "mission" else ["demo", "--detector", "perfect"]
    return [
        sys.executable,
        "-m",
        "timberhand",
        *job,
        "--bus",
        "vcan",
        "--seed",
        str(seed),
        "--no-console",
        "--out",
        str(out),
    ]


def perform(job: Job) -> dict[str, Any]:
    """Run it; the outcome as plain data.

    A witness beside it on the lab's processor, which is the last one, tells what the hypervisor took, also where
    /proc/stat reports none; without real-time priority other processes delay it, too.
    """
    out = Path(job.options["out"]) / job.name
    first = host_activity.sample()
    with Witness(max(os.sched_getaffinity(0)), PROBE_PRIORITY, LATE_US) as witness:
        told, said, code = run(command(job.kind, job.seed, out))
    host = host_activity.between(first, host_activity.sample())
    late_ms = [stall.stall_ns * 1e-6 for stall in witness.stalls()]
    summary = out / "summary.json"
    return {
        "kind": job.kind,
        "seed": job.seed,
        "exit": code,
        "wall_s": host.seconds,
        "steal_ms": host.steal_ms,
        "lost_ms": sum(late_ms),
        "longest_ms": max(late_ms, default=0.0),
        "probe_real_time": witness.real_time,
        **read_output(told, said),
        **read_summary(json.loads(summary.read_text()) if summary.exists() else {}),
    }


def run(words: Sequence[str]) -> tuple[str, str, int]:
    """Standard output, standard error and exit code of a command; 124 when it took too long."""
    with subprocess.Popen(
        words, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        try:
            told, said = process.communicate(timeout=LIMIT_S)
        except subprocess.TimeoutExpired:
            process.terminate()  # the lab forwards it; killed, the lab would go on beside the next run
            told, said = process.communicate()
            return told, said, 124
        except BaseException:  # Ctrl-C that reached this process alone
            process.terminate()
            process.wait()
            raise
        return told, said, process.returncode


def read_output(told: str, said: str) -> dict[str, Any]:
    """Clock with its reason, reasons of the stops, ended leases."""
    clock = _CLOCK.search(said)
    reasons = [reason for _, reason in _MODE.findall(told)]
    return {
        "clock": clock[1] if clock else "native",
        "clock_reason": clock[2] if clock else "",
        "stop_reasons": reasons,
        "leases_lost": reasons.count(describe(Reason.LEASE_LOST)),
    }


def read_summary(summary: dict[str, Any]) -> dict[str, Any]:
    """Whether the job is done by the plant's physics, stops, refused setpoints, missed ticks, machine time [s]."""
    missions = summary.get("finished", False) and summary.get("in_bunk") == summary.get("loaded")
    return {
        "done": bool(missions if "finished" in summary else summary.get("in_bunk", False)),
        "stops": int(summary.get("stops", 0)),
        "refused": int(summary.get("refused_setpoints", summary.get("refused", 0))),
        "missed_ticks": int(summary.get("missed_ticks", 0)),
        "seconds": float(summary.get("seconds", 0.0)),
    }
