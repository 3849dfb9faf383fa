"""Whether this computer holds the period of a live run: a look of two seconds before it begins.

The processes of a live run depend on each other within milliseconds, with the real-time priority that the system
grants them.  A processor that stands still for long silences an input, and the machine stops although nothing is wrong
with it.  So the longest lateness of a process with deadlines of 1 ms (`host.lateness`) is held against the shortest
time-out of an input.  Two seconds do not see what happens once in ten, so the look also asks what share of its time
a virtual machine lost since it started, and how many processors are free.  ``look`` measures, ``obstacle`` decides
(pure).
"""

from __future__ import annotations

import subprocess
import sys
from typing import Any, Final

import msgspec

from host import lateness

LOOK_S: Final = 2.0
SHORTEST_TIMEOUT_NS: Final = 15_000_000
"""An encoder sends every 5 ms and is missed after three (can_dbc/crane.dbc)."""
BEARABLE_NS: Final = SHORTEST_TIMEOUT_NS // 2
"""The other half is the period and the way over the bus, which pass in any case."""
BEARABLE_STOLEN: Final = 0.001
"""A host that takes 5 to 15 ms at a time, and this share of the time, does it about once in ten seconds."""
_TIMEOUT_S: Final = 30.0


class Finding(msgspec.Struct, frozen=True):
    """What a look found.

    ``longest_ns``: longest lateness on any processor; ``free``: processors that idled before; ``stolen``: share of
    its busy time that a virtual machine lost to its host since it started.
    """

    longest_ns: int
    free: float
    stolen: float


STANDS_STILL: Final = Finding(int(_TIMEOUT_S * 1e9), 0.0, 0.0)
"""A probe that does not come to its end."""


def obstacle(finding: Finding, more: float = 0.0) -> str:
    """Say what stands in the way of a live run on this computer, as the beginning of a sentence; empty: nothing.

    ``more``: processors that the run needs besides, as its detector does.
    """
    if finding.longest_ns > BEARABLE_NS:
        return (
            f"This computer stood still for up to {finding.longest_ns / 1e6:.1f} ms in a look of {LOOK_S:.0f} s, "
            f"and a live run bears {BEARABLE_NS / 1e6:.1f} ms"
        )
    if finding.free < (need := lateness.NEED + more):
        return f"A live run needs {need} processors, and this computer has {finding.free:.1f} free"
    if finding.stolen > BEARABLE_STOLEN:
        return (
            "This computer is a virtual machine whose host took its processors away for "
            f"{100 * finding.stolen:.1f} % of the time, and a live run bears {100 * BEARABLE_STOLEN} %"
        )
    return ""


def look(seconds: float = LOOK_S) -> Finding:
    """Look at this computer for ``seconds``, and half a second before.

    Raises:
        subprocess.CalledProcessError: the probe fails.
    """
    try:
        return msgspec.convert(run_probe(lateness.__file__, seconds), Finding)
    except subprocess.TimeoutExpired:
        return STANDS_STILL


def run_probe(file: str, seconds: float) -> dict[str, Any]:
    """Run a script that observes this computer for ``seconds``, in a session of its own; the object that it prints.

    Raises:
        subprocess.SubprocessError: it fails.
    """
    done = subprocess.run(
        [sys.executable, "-ISB", file, str(seconds)],
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        check=True,
        timeout=_TIMEOUT_S + seconds,
        start_new_session=True,
    )
    result: dict[str, Any] = msgspec.json.decode(done.stdout)
    return result
