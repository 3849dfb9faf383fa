"""Loss of the crane's bus while the crane moves: the interface goes down, or the adapter is unplugged, and returns.

The bus shows nothing meanwhile, so the emulated machine is asked for its motion.
"""

from __future__ import annotations

import json
import socket
import subprocess
import time
from dataclasses import dataclass
from typing import Any, Final

from host.service_lab.pilot import Pilot
from host.service_lab.trial import CONTROLLER, GUARD, observe_idle, prepare, release, slew_until_fast
from host.systemd import show
from machine.joints import Joint

INTERFACE: Final = "crane0"
AWAY_S: Final = 2.0
STOPPED_S: Final = 0.5
"""Time for the boom to come to rest after its valves have closed."""
BACK_S: Final = 15.0


@dataclass(frozen=True, slots=True)
class Loss:
    """The commands that remove and restore the interface; the installed udev rule sets up a new adapter."""

    name: str
    lose: tuple[str, ...]
    restore: tuple[str, ...]


LOSSES: Final = (
    Loss("down", ("ip", "link", "set", INTERFACE, "down"), ("ip", "link", "set", INTERFACE, "up")),
    Loss("unplugged", ("ip", "link", "del", INTERFACE), ("ip", "link", "add", INTERFACE, "type", "vcan")),
)


def lose(loss: Loss, pilot: Pilot, plant_port: int) -> dict[str, Any]:
    """Run one trial and return its figures.

    Raises:
        LabError: the crane does not move before or after the loss.
    """
    processes = _processes()
    losing = prepare(*loss.lose)
    slew_until_fast(pilot)
    opening_pct = pilot.opening_pct()
    release(losing)
    losing.wait()
    pilot.until(lambda: False, STOPPED_S)
    stopped_rad = _slew(plant_port)
    pilot.until(lambda: False, AWAY_S)
    status = {unit: show(unit, "StatusText")["StatusText"] for unit in (CONTROLLER, GUARD)}
    moved_rad = abs(_slew(plant_port) - stopped_rad)
    pilot.clear()
    begin_s = time.monotonic()
    subprocess.run(loss.restore, check=True)
    back = pilot.until(lambda: pilot.valves and pilot.guarded_ns and pilot.commands, BACK_S)
    back_s = time.monotonic() - begin_s
    figures = observe_idle(pilot)
    same = _processes() == processes
    if back:
        slew_until_fast(pilot)
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
    """The true slew angle [rad]."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as client:
        client.settimeout(5.0)
        client.sendto(json.dumps({"op": "state"}).encode(), ("127.0.0.1", port))
        return float(json.loads(client.recv(65536))["joints"][Joint.SLEW])
