"""Counts what one compiled tick executes and touches, by valgrind's callgrind: figures that no other load changes.

A tick after 5 ms of other work pays for every cache line that it touches, and a shared host hides how many those are
behind its own noise.  callgrind simulates a processor with 2 MB of last-level cache, in which a buffer three times as
large is written before each tick.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any, Final

from hil.tick import worker
from host.exit_codes import CommandFailed, ExitCode
from runtime.compiled import source_root

_COUNTED: Final = re.compile(r"Collected : ([\d ]+)")
_EVENTS: Final = re.compile(r"Events    : ([\w ]+)")
_TICKS: Final = re.compile(r'"counted": (\d+)')


def count(recording: Path, ticks: int, folder: Path) -> dict[str, Any]:
    """Count instructions and cold cache lines (64 bytes; of code, read, written) of a recording's average tick.

    Raises:
        CommandFailed: valgrind is missing or fails.
    """
    if shutil.which("valgrind") is None:
        sentence = "counting needs valgrind: apt-get install valgrind"
        raise CommandFailed("tick.no-valgrind", sentence, ExitCode.CONFIGURATION)
    done = subprocess.run(
        [
            "valgrind",
            "--tool=callgrind",
            f"--callgrind-out-file={folder / 'callgrind'}",
            "--cache-sim=yes",
            "--I1=32768,8,64",
            "--D1=32768,8,64",
            f"--LL={worker.COUNTED_CACHE_BYTES},16,64",
            "--collect-atstart=no",
            "--toggle-collect=CPyDef_step___step",
            sys.executable,
            "-P",
            worker.__file__,
            "counted",
            str(recording),
            str(ticks),
        ],
        capture_output=True,
        text=True,
        env={**os.environ, "PYTHONPATH": str(source_root()), "PYTHONHASHSEED": "0", "OMP_NUM_THREADS": "1"},
    )
    return {"recording": recording.parent.name, **_per_tick(done.stdout, done.stderr)}


def _per_tick(said: str, told: str) -> dict[str, float]:
    """Compute the figures from what worker and valgrind wrote."""
    counted, events, ran = _COUNTED.search(told), _EVENTS.search(told), _TICKS.search(said)
    if counted is None or events is None or ran is None:
        raise CommandFailed(
            "tick.not-counted", f"valgrind did not count: {told.strip()[-300:]}", ExitCode.CONFIGURATION
        )
    totals = dict(zip(events[1].split(), map(int, counted[1].split()), strict=True))
    if not totals["Ir"]:
        raise CommandFailed(
            "tick.not-counted", "valgrind saw no compiled tick; run timberhand compile", ExitCode.CONFIGURATION
        )
    n = int(ran[1])
    return {
        "ticks": n,
        "instructions": round(totals["Ir"] / n),
        "code_lines": round(totals["ILmr"] / n),
        "read_lines": round(totals["DLmr"] / n),
        "written_lines": round(totals["DLmw"] / n),
    }
