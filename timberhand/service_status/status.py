"""The status of the installed services: systemd's state of each unit, and the controller's timing page.

Read-only, for any user.  `read_status` returns everything; its ``named`` is the JSON of ``service status``.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

from can_dbc.timing.page import InputAge, Timing, TimingRefused, default_path, read_timing
from host.exit_codes import ExitCode
from host.systemd import last_journal_line, show_all

NAMES: Final = ("controller", "guard", "autonomy", "recorder", "console", "plc", "can@crane0", "can@mach0", "update")
PROPERTIES: Final = (
    "Id", "Type", "LoadState", "ActiveState", "SubState", "Result", "ExecMainStatus", "NRestarts", "StatusText",
    "StateChangeTimestampMonotonic", "ExecMainExitTimestampMonotonic",
)  # fmt: skip
SYSTEMD: Final = Path("/run/systemd/system")
SERVICE_PAGE: Final = Path("/run/timberhand/controller.timing")
STALE_NS: Final = 3_000_000_000
"""The page is written once per second; at this age the controller hangs or has ended."""


@dataclass(frozen=True, slots=True)
class Unit:
    """One service.

    ``state`` is one of running, starting, ending, done (a one-shot that succeeded), stopped, failed, restarting, not
    configured, not installed.  ``why`` tells how it ended if it failed; ``since_s`` is the time in this state.
    """

    name: str
    state: str
    why: str
    since_s: float | None
    restarts: int
    words: str


@dataclass(frozen=True, slots=True)
class Status:
    """Units and timing; ``notes`` are sentences about what is unavailable."""

    units: tuple[Unit, ...]
    timing: Timing | None
    notes: tuple[str, ...]

    @property
    def silent(self) -> bool:
        """Whether the controller writes no timing page, or has stopped writing it."""
        return self.timing is None or self.timing.age_ns > STALE_NS

    def named(self) -> dict[str, Any]:
        """As plain values for JSON."""
        timing = None
        if self.timing is not None:
            timing = self.timing.named() | {"age_ns": self.timing.age_ns, "silent": self.silent}
        return {"units": [asdict(unit) for unit in self.units], "timing": timing, "notes": list(self.notes)}


def read_status(page: Path | None = None) -> Status:
    """The status now; ``page`` is the controller's timing page (default: that of the service, else of this user)."""
    notes = []
    units: tuple[Unit, ...] = ()
    if SYSTEMD.is_dir():
        units = tuple(read_unit(found, time.monotonic()) for found in _systemd_properties())
    else:
        notes.append("systemd does not run here, so no service is shown.")
    timing = None
    try:
        timing = read_timing(page or (SERVICE_PAGE if SERVICE_PAGE.exists() else default_path()))
    except TimingRefused as refused:
        notes.append(str(refused))
    return Status(units, timing, tuple(notes))


def _systemd_properties() -> list[dict[str, str]]:
    return show_all([f"timberhand-{name}.service" for name in NAMES], *PROPERTIES)


def read_unit(found: dict[str, str], now_s: float) -> Unit:
    """A unit from its systemd properties; ``now_s`` is the monotonic clock."""
    name = found["Id"].removeprefix("timberhand-").removesuffix(".service")
    state = _state(found)
    changed_s = int(found.get("StateChangeTimestampMonotonic") or 0) * 1e-6
    why = _why(found) if state in ("failed", "restarting", "stopped") else ""
    words = found.get("StatusText", "")
    if state in ("failed", "restarting") and not words:
        words = last_journal_line(found["Id"])
    since_s = now_s - changed_s if changed_s else None
    return Unit(name, state, why, since_s, int(found.get("NRestarts") or 0), words)


def _state(found: dict[str, str]) -> str:
    active = found.get("ActiveState", "")
    if found.get("LoadState") == "not-found":
        return "not installed"
    if found.get("SubState") == "auto-restart":
        return "restarting"
    if active == "inactive" and found.get("Result") == "exec-condition":
        return "not configured"
    if active == "inactive" and found.get("Result") == "success" and found.get("ExecMainExitTimestampMonotonic") != "0":
        return "done" if found.get("Type") == "oneshot" else "stopped"
    words = {"active": "running", "activating": "starting", "deactivating": "ending", "inactive": "stopped"}
    return words.get(active, active)


def _why(found: dict[str, str]) -> str:
    return ending(found.get("Result", ""), found.get("ExecMainStatus") or "0")


def ending(result: str, status: str) -> str:
    """How a service ended, from systemd's result and the exit status or signal of its main process."""
    match result:
        case "success":
            return ""
        case "exit-code":
            known = int(status) in set(ExitCode) if status.isdecimal() else False
            return f"exit status {status}" + (f", {ExitCode(int(status)).words}" if known else "")
        case "signal":
            return f"killed by signal {status}"
        case "watchdog":
            return "hung, ended by the watchdog"
        case "timeout":
            return "timeout of starting or stopping"
        case _:
            return result


def oldest_first(inputs: Sequence[tuple[str, InputAge]]) -> list[tuple[str, InputAge]]:
    """Inputs sorted by the longest age at which they were used."""
    return sorted(inputs, key=lambda item: -item[1].longest_ns)
