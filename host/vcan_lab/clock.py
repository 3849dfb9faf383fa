"""Real or simulated time for a live run in user-mode Linux, by the processor time that the lab would get.

The guest has one processor and needs nearly all of it for a live machine (about nine tenths, measured), so a host that
takes more than a tenth leaves the processes of lowest priority, the planner among them, with too little: setpoints come
late and leases end.  The controller does nothing wrong then, and a faster host does not have the problem; so the run
takes place in simulated time, which shows what the processes do and not what the host does.

``measure`` looks at the host for a moment, ``choose_clock`` decides (pure), ``clock_here`` does both.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Final, Literal

from host.real_time import LOOK_S, run_probe
from host.vcan_lab import choose, lab_kernel, lost_time, shim
from host.vcan_lab.spec import LabError, Request

MAX_LOST_SHARE: Final = 0.08
"""The guest has about a tenth to spare."""
MAX_GAP_NS: Final = 25_000_000
"""Half of a motion input's time-out of 50 ms: the guest needs the other half to catch up."""


@dataclass(frozen=True, slots=True)
class LostTime:
    """What a process with the lab's share did not get of its processor.

    ``share``: of the time, in gaps; ``longest_ns``: the longest gap; ``steal_share``: of the time, taken by the
    hypervisor according to /proc/stat (a part of ``share``; the rest went to other processes of this computer).
    """

    share: float
    longest_ns: int
    steal_share: float

    def words(self) -> str:
        """For a person."""
        return (
            f"{100 * self.share:.0f} % of its processor's time lost, at most {self.longest_ns / 1e6:.0f} ms at once "
            f"(steal by the hypervisor: {100 * self.steal_share:.1f} %)"
        )


@dataclass(frozen=True, slots=True)
class Clock:
    """The chosen clock, and why."""

    kind: Literal["real", "simulated"]
    reason: str
    enough: bool = True
    """Whether the run may be expected to take place without a stop."""


def choose_clock(lost: LostTime, kernel: str | None) -> Clock:
    """Real time where the host leaves enough; else simulated time, if the lab's own kernel ``kernel`` is there."""
    if lost.share <= MAX_LOST_SHARE and lost.longest_ns <= MAX_GAP_NS:
        return Clock("real", f"the host leaves the lab enough: {lost.words()}")
    busy = f"the host is too busy for a live run in user-mode Linux: {lost.words()}"
    if kernel is None:
        return Clock("real", f"{busy}; expect stops, or use simulated time: {lab_kernel.MISSING}", enough=False)
    return Clock("simulated", busy)


def measure(seconds: float = LOOK_S) -> LostTime:
    """Spin beside everything else on the processor and with the share that the lab would get.

    Raises:
        subprocess.SubprocessError: the probe fails.
    """
    found = run_probe(lost_time.__file__, seconds)
    return LostTime(found["share"], found["longest_ns"], found["steal_share"])


def clock_here() -> Clock | None:
    """The clock for a live run in the lab now; None where the lab is not user-mode Linux, or there is none."""
    request = Request((), os.getcwd(), {}, os.getuid(), os.getgid(), (), 0o022)
    try:
        if choose.choose(choose.survey(request)).kind != "uml":
            return None
    except LabError:
        return None  # the lab itself says why
    return choose_clock(measure(), lab_kernel.find(shim.user_cache()))
