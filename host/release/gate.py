"""What a release must show before it stays: controller READY and in STANDBY, guard GOOD, for a while without a restart.

Pure: `Gate.step` takes what systemd says of the two services.  READY is the unit's state "active" (``Type=notify``);
mode and verdict are the first words of the status that the processes send (sd_notify(3), ``STATUS=``).
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Final

from controller.guard.verdicts import Verdict
from machine.status.modes import Mode

HOLD_NS: Final = 3_000_000_000
"""So long in one piece: six restarts of a service that dies at once would fit in (RestartSec=0.5)."""
LIMIT_NS: Final = 60_000_000_000
"""A start takes 2 s, encoders that boot with the machine some more."""
NOBODY: Final = (0, 0)
STANDBY_WORDS: Final = f"{Mode.STANDBY.name}. "
GOOD_WORDS: Final = f"Valves enabled: {Verdict.GOOD.name}. "


@dataclass(frozen=True, slots=True)
class ServiceReading:
    """One service: READY, its status line, its main process (0: none)."""

    ready: bool
    words: str
    pid: int


class Passage(Enum):
    """Where a release stands at the gate."""

    WAITING = "waiting"
    PASSED = "passed"
    REFUSED = "refused"


class Gate:
    """The gate of one start, opened at ``begin_ns`` (monotonic); ``lacking`` says what is missing."""

    def __init__(self, begin_ns: int, hold_ns: int = HOLD_NS, limit_ns: int = LIMIT_NS) -> None:
        self._limit_ns, self._hold_ns = begin_ns + limit_ns, hold_ns
        self._good_since_ns: int | None = None
        self._pids = NOBODY
        self._interruption = "it came up too late"
        self.lacking = "the services have said nothing"

    def step(self, controller: ServiceReading, guard: ServiceReading, now_ns: int) -> Passage:
        """Take a reading of both services."""
        self.lacking = lacking(controller, guard)
        pids = (controller.pid, guard.pid)
        if self.lacking:
            self._good_since_ns, self._interruption = None, self.lacking
        elif pids != self._pids:
            self._good_since_ns = None
            if self._pids != NOBODY:
                self._interruption = "controller and guard restart again and again"
        if not self.lacking:
            self._pids = pids
            if self._good_since_ns is None:
                self._good_since_ns = now_ns
            if now_ns - self._good_since_ns >= self._hold_ns:
                return Passage.PASSED
            self.lacking = f"it is not good for {self._hold_ns / 1e9:g} s in one piece: {self._interruption}"
        return Passage.REFUSED if now_ns >= self._limit_ns else Passage.WAITING


def lacking(controller: ServiceReading, guard: ServiceReading) -> str:
    """Say what keeps the gate shut; empty when nothing does."""
    if not controller.ready:
        return f"the controller is not READY{_said(controller)}"
    if not controller.words.startswith(STANDBY_WORDS):
        return f"the controller is not in STANDBY{_said(controller)}"
    if not guard.ready:
        return f"the guard is not READY{_said(guard)}"
    if not guard.words.startswith(GOOD_WORDS):
        return f"the guard is not GOOD{_said(guard)}"
    return ""


def _said(service: ServiceReading) -> str:
    return f": {service.words}" if service.words else ""
