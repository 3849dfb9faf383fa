"""Planners, an operator and eyes that do one simple thing, for machines in lockstep."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from can_dbc.messages.crane import OperatorAction, OperatorCommand, StateReport
from can_dbc.messages.datagrams import encode
from can_dbc.messages.vehicle import DriveSetpoint, Steering, VehicleReport
from controller.config import load as load_settings
from controller.guard.__main__ import build as build_guard
from controller.guard.__main__ import profile_path
from hil.harness.lockstep import Lockstep, Observer
from hil.harness.operator import MAX_STOPS, Operator
from machine.status.modes import Mode

MS = 1_000_000
SETTINGS = load_settings("aoro_fc8")
assert SETTINGS.profile.carrier is not None
CARRIER = SETTINGS.profile.carrier


class Idle:
    """A planner that wants nothing."""

    def step(self, *_: object) -> None:
        return None


class Nobody(Operator):
    """An operator who presses nothing."""

    def __init__(self) -> None:
        super().__init__(0, lambda *_: None)

    def step(self, report: StateReport) -> None:
        return None


class Blind:
    """Eyes that see no logs."""

    def detect(self, q: object, now_ns: int) -> None:
        return None


def in_lockstep(
    machine: str | Path,
    plant: Any,
    planner: Any,
    operator: Operator | None = None,
    observer: Observer | None = None,
    eyes: Any = None,
    *,
    max_stops: int = MAX_STOPS,
) -> Lockstep:
    """A machine with its real controller and guard; somebody arms it unless another operator is given."""
    settings = load_settings(machine)
    operator = operator or Operator(settings.profile_hash, lambda *_: None, max_stops)
    guard = build_guard(profile_path(str(machine)))
    return Lockstep(settings, guard, plant, planner, operator, observer or Observer(), eyes)


def advance(system: Lockstep, seconds: float, until: Callable[[], bool] = lambda: False) -> bool:
    """Go on for so long; True when the condition came true before."""
    end_ns = system.now_ns + round(seconds * 1e9)
    while system.now_ns < end_ns:
        system.advance()
        if until():
            return True
    return False


def press(system: Lockstep, action: OperatorAction) -> None:
    """One press of a person beside the emulated operator."""
    system.press(encode(OperatorCommand(1000, system._settings.profile_hash, system.now_ns, action)))


class Drives:
    """A planner that asks for what ``say`` gives every 50 ms, as long as it gives something."""

    def __init__(self, say: Callable[[VehicleReport, int], dict[str, object] | None]) -> None:
        self.vehicle: VehicleReport | None = None
        self.heard: list[VehicleReport] = []
        self._say, self._sequence, self._sent_ns, self._begin_ns = say, 0, 0, 0

    def hear(self, report: VehicleReport) -> None:
        self.vehicle = report
        self.heard.append(report)

    def step(self, now_ns: int, report: StateReport | None, logs: tuple) -> bytes | None:
        armed = report is not None and report.mode in (Mode.ARMED, Mode.ACTIVE)
        if not armed or self.vehicle is None or now_ns - self._sent_ns < 50 * MS:
            return None
        self._begin_ns = self._begin_ns or now_ns
        asked = self._say(self.vehicle, now_ns - self._begin_ns)
        if asked is None:
            return None
        self._sequence, self._sent_ns = self._sequence + 1, now_ns
        values = {
            "sequence": self._sequence,
            "profile_hash": SETTINGS.profile_hash,
            "stamp_ns": now_ns,
            "lease_ns": 200 * MS,
            "steering": Steering.WAYPOINT,
            "latitude_deg": CARRIER.site_lat_deg,
            "longitude_deg": CARRIER.site_lon_deg,
            "articulation_rad": 0.0,
            "articulation_rate_rad_s": 0.0,
            "speed_m_s": 0.0,
            "heights_m": (CARRIER.arm_transport_m,) * 4,
            "float_front": False,
            "float_rear": False,
        } | asked
        return encode(DriveSetpoint(**values))  # type: ignore[arg-type]
