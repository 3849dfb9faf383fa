"""Whether this computer holds the period of a live run: a look of two seconds before it begins.

The processes of a live run depend on each other within milliseconds, with the real-time priority that the system
grants them.  A processor that stands still for long silences an input, and the machine stops although nothing is wrong
with it.  So the longest lateness of a process with deadlines of 1 ms (`host.lateness`) is held against the shortest
time-out of an input.  ``look`` measures, ``holds`` decides (pure).
"""

from __future__ import annotations

import subprocess
import sys
from typing import Any, Final

import msgspec

from host import lateness

LOOK_S: Final = 2.0
SHORTEST_TIMEOUT_NS: Final = 15_000_000
"""An encoder sends every 5 ms and is missed after three (docs/reference/frames.md)."""
BEARABLE_NS: Final = SHORTEST_TIMEOUT_NS // 2
"""The other half is the period and the way over the bus, which pass in any case."""
_TIMEOUT_S: Final = 30.0


def holds(longest_ns: int) -> bool:
    """Whether a live run bears that a process of it is late by ``longest_ns`` [ns]."""
    return longest_ns <= BEARABLE_NS


def look(seconds: float = LOOK_S) -> int:
    """The longest lateness on any processor within ``seconds`` [ns].

    Raises:
        subprocess.CalledProcessError: the probe fails.
    """
    try:
        return int(run_probe(lateness.__file__, seconds)["longest_ns"])
    except subprocess.TimeoutExpired:
        return int(_TIMEOUT_S * 1e9)


def run_probe(file: str, seconds: float) -> dict[str, Any]:
    """Run a script that observes this computer for ``seconds``, in a session of its own; the object that it prints.

    Raises:
        subprocess.SubprocessError: it fails.
    """
    done = subprocess.run(
        [sys.executable, "-ISB", file, str(seconds)],
        stdin=subprocess.DEVNULL, capture_output=True, text=True, check=True, timeout=_TIMEOUT_S + seconds,
        start_new_session=True,
    )  # fmt: skip
    found: dict[str, Any] = msgspec.json.decode(done.stdout)
    return found
