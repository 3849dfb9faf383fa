"""The services of this computer as an update sees and moves them, through systemd."""

from __future__ import annotations

from pathlib import Path
from typing import Final, Protocol

from can_dbc.timing.page import read_timing
from host.exit_codes import CommandFailed, ExitCode
from host.release.gate import ServiceReading
from host.systemd import show, systemctl
from machine.status.modes import Mode
from runtime.errors import InputRefused

PAGE: Final = Path("/run/timberhand/controller.timing")
STALE_NS: Final = 3_000_000_000
"""The controller writes its page once per second; an older one is of a controller that hangs or has ended."""
CONTROLLER: Final = "timberhand-controller.service"
GUARD: Final = "timberhand-guard.service"
JUDGED: Final = (CONTROLLER, GUARD)
"""What the gate looks at."""
TARGET: Final = "timberhand.target"
RESUME: Final = "timberhand-update.service"
"""It runs an update's last steps after a power cut, so these steps must not stop it."""


UNARMED: Final = frozenset(mode.name for mode in Mode) - {Mode.ARMED.name, Mode.ACTIVE.name}


def service_mode() -> str | None:
    """Return the mode of the controller that runs as a service; None when none runs."""
    try:
        timing = read_timing(PAGE)
    except InputRefused:
        return None
    return timing.facts.mode if timing.age_ns < STALE_NS else None


def refuse_while_armed(mode: str | None) -> None:
    """Raise CommandFailed when a controller in ``mode`` may move the machine."""
    if mode is not None and mode not in UNARMED:
        raise CommandFailed(
            "update.armed", f"the machine is {mode}; bring it to rest and disarm it first", ExitCode.SAFETY_STOP
        )


class Services(Protocol):
    """What the steps need of the services."""

    def mode(self) -> str | None:
        """Return the controller's mode; None when none runs."""

    def stop(self) -> None:
        """Stop every service; raises CommandFailed."""

    def reload(self) -> None:
        """Let systemd read the units again; raises CommandFailed."""

    def start(self) -> None:
        """Start controller and guard, as far as they are enabled."""

    def start_others(self) -> None:
        """Start whatever else is enabled, and do not wait for it."""

    def readings(self) -> tuple[ServiceReading, ServiceReading]:
        """Read controller and guard."""


class SystemdServices:
    """The services of the running system; ``units`` is the folder with the unit files of the release in use."""

    def __init__(self, units: Path) -> None:
        self._units = units

    def mode(self) -> str | None:
        """See `Services`."""
        return service_mode()

    def stop(self) -> None:
        """See `Services`.  By name: stopping the target would end the service that runs an update's last steps."""
        names = sorted(path.name for path in self._units.glob("*.service") if "@" not in path.name)
        _order("stop", *[name for name in names if name != RESUME])

    def reload(self) -> None:
        """See `Services`."""
        _order("daemon-reload")

    def start(self) -> None:
        """See `Services`.  Whether they come up is the gate's to find; nothing else takes processor time until then."""
        systemctl("reset-failed", "timberhand-*")
        systemctl("start", *(name for name in _enabled() if name in JUDGED))

    def start_others(self) -> None:
        """See `Services`.  By name, too: an update has stopped them by name, and left the target as it is."""
        systemctl("--no-block", "start", *(name for name in _enabled() if name not in (*JUDGED, RESUME)))
        systemctl("--no-block", "start", TARGET)

    def readings(self) -> tuple[ServiceReading, ServiceReading]:
        """See `Services`."""
        return _reading(CONTROLLER), _reading(GUARD)


def _enabled() -> list[str]:
    return show(TARGET, "Wants").get("Wants", "").split()


def _reading(unit: str) -> ServiceReading:
    properties = show(unit, "ActiveState", "StatusText", "MainPID")
    return ServiceReading(
        properties.get("ActiveState") == "active", properties.get("StatusText", ""), int(properties.get("MainPID") or 0)
    )


def _order(*words: str) -> None:
    done = systemctl(*words)
    if done.returncode:
        reason = (done.stderr.strip().splitlines() or ["no message"])[-1]
        raise CommandFailed("update.systemd", f"systemctl {words[0]} failed: {reason}; see journalctl -b")
