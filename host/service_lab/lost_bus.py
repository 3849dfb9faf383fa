"""The crane's bus lost under the moving crane: its interface goes down, or its adapter is unplugged, and comes back.

Nothing on the bus can be watched meanwhile, so the emulated machine itself is asked whether it moves.
"""

from __future__ import annotations

import json
import socket
import subprocess
import time
from dataclasses import dataclass
from typing import Any, Final

from host.service_lab.pilot import Pilot
from host.service_lab.trial import CONTROLLER, GUARD, go, prepared, quiet, swinging
from host.systemd import show
from machine.joints import Joint

INTERFACE: Final = "crane0"
AWAY_S: Final = 2.0
STOPPED_S: Final = 0.5
"""The boom has come to rest this long after its valves closed."""
BACK_S: Final = 15.0


@dataclass(frozen=True, slots=True)
class Loss:
    """How the interface goes and what brings it back; an adapter that is plugged in again is set up by nobody but the
    installed rule for udev.
    """

    name: str
    lose: tuple[str, ...]
    give_back: tuple[str, ...]


LOSSES: Final = (
    Loss("down", ("ip", "link", "set", INTERFACE, "down"), ("ip", "link", "set", INTERFACE, "up")),
    Loss("unplugged", ("ip", "link", "del", INTERFACE), ("ip", "link", "add", INTERFACE, "type", "vcan")),
)


def lose(loss: Loss, pilot: Pilot, plant_port: int) -> dict[str, Any]:
    """Figures of one trial; raises `host.service_lab.trial.Stuck` when the crane does not swing, before or after."""
    processes = _processes()
    losing = prepared(*loss.lose)
    swinging(pilot)
    opening_pct = pilot.opening_pct()
    go(losing)
    losing.wait()
    pilot.until(lambda: False, STOPPED_S)
    stopped_rad = _slew(plant_port)
    pilot.until(lambda: False, AWAY_S)
    status = {unit: show(unit, "StatusText")["StatusText"] for unit in (CONTROLLER, GUARD)}
    moved_rad = abs(_slew(plant_port) - stopped_rad)
    pilot.forget()
    begin_s = time.monotonic()
    subprocess.run(loss.give_back, check=True)
    back = pilot.until(lambda: pilot.valves and pilot.guarded_ns and pilot.commands, BACK_S)
    back_s = time.monotonic() - begin_s
    figures = quiet(pilot)
    same = _processes() == processes
    if back:
        swinging(pilot)
        pilot.rest()
    return figures | {
        "way": loss.name,
        "opening_pct": opening_pct,
        "moved_mrad": moved_rad * 1e3,
        "status": status,
        "back_s": back_s if back else None,
        "same_processes": same,
    }


def _processes() -> list[dict[str, str]]:
    return [show(unit, "MainPID", "NRestarts", "ActiveState") for unit in (CONTROLLER, GUARD)]


def _slew(port: int) -> float:
    """Where the column truly is [rad]."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as asking:
        asking.settimeout(5.0)
        asking.sendto(json.dumps({"op": "state"}).encode(), ("127.0.0.1", port))
        return float(json.loads(asking.recv(65536))["joints"][Joint.SLEW])
