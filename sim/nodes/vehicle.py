"""The vehicle controller (source address 03h): receives VehCmd, drives, steers and brakes; without it the brake is on.

It follows only while VehCmd (E2E valid, ArmKey 0xA, every value available) and GuardAlive (Enable 0xA) are at most
100 ms old, VehCmd is not late by its number (`can_dbc.protocols.punctuality`), and the emergency stop is released.
Otherwise the brake is on and the steering spool neutral, at once; a loss while driving remains a fault until a fresh
frame disarms.  The node's own dead-band map turns the articulation rate into a spool command.
"""

from __future__ import annotations

from collections.abc import Callable
from enum import IntEnum

from can_dbc.dbc.codec import Database
from can_dbc.protocols.punctuality import Punctuality
from machine.profile import Carrier, CarrierValve, Valve
from sim.nodes import Outbox
from sim.nodes.j1939 import J1939Node
from sim.nodes.messages import ARM_KEY, MS, PeriodicTimer, ProtectedInput, ProtectedMessage

ADDRESS = 0x03
DRIVE_FUNCTION = 23  # J1939 NAME function of a propulsion controller
COMMAND_NS, GUARD_NS = 90 * MS, 100 * MS
CYCLE_NS = 20 * MS
STANDSTILL_M_S = 0.02
MIN_RATE_RAD_S = 5e-4


class VehicleFault(IntEnum):
    """VehStat.Fault."""

    NONE = 0
    COMMAND_TIMEOUT = 1
    SAFETY_STOP = 2
    GUARD_MISSING = 3


class Gear(IntEnum):
    """VehStat.Gear."""

    NEUTRAL = 0
    FORWARD = 1
    REVERSE = 2
    PARK = 3


def spool_for(valve: CarrierValve | Valve, speed: float, least: float = 0.0) -> float:
    """Spool command -1..1 that gives ``speed`` by the profile; speeds up to ``least`` leave the spool neutral."""
    if abs(speed) <= least:
        return 0.0
    plus = speed > 0.0
    dead = (valve.deadband_plus_pct if plus else valve.deadband_minus_pct) / 100.0
    share = min(1.0, abs(speed) / (valve.full_speed_plus if plus else valve.full_speed_minus))
    return (dead + (1.0 - dead) * share) * (1.0 if plus else -1.0)


class VehicleNode(J1939Node):
    """``drive_m_s``, ``brake`` and ``steer`` (spool -1..1, + bends left) are its present outputs; the plant sets
    ``speed_m_s`` and ``articulation_rad``, the readings of its own sensors.
    """

    def __init__(self, machine: Database, outbox: Outbox, carrier: Carrier, pilot_on: Callable[[], bool]) -> None:
        super().__init__(ADDRESS, DRIVE_FUNCTION, machine, outbox)
        self._carrier, self._pilot_on = carrier, pilot_on
        self._command = ProtectedInput(machine, "VehCmd", Punctuality(CYCLE_NS, COMMAND_NS))
        self._guard = ProtectedInput(machine, "GuardAlive")
        self._stat = ProtectedMessage(machine, "VehStat")
        self._period = PeriodicTimer(CYCLE_NS)
        self.speed_m_s = self.articulation_rad = 0.0
        self.fault = VehicleFault.NONE
        self.active = False
        self._stop()

    def _stop(self) -> None:
        self.drive_m_s, self.brake, self.steer = 0.0, True, 0.0

    def receive(self, key: int, data: bytes, now_ns: int) -> None:
        if key == self._guard.key:
            self._guard.accept(data, now_ns)
        elif key != self._command.key:
            super().receive(key, data, now_ns)
        elif self._command.accept(data, now_ns) and self._command.get("ArmKey") != ARM_KEY:
            self.fault = VehicleFault.NONE

    def decide(self, now_ns: int) -> None:
        """Set the outputs for this physics step."""
        command = self._command
        fresh = command.fresh(now_ns, COMMAND_NS) and not command.late
        guarded = self._guard.fresh(now_ns, GUARD_NS) and self._guard.get("Enable") == ARM_KEY
        if not self._pilot_on():
            self.fault = VehicleFault.SAFETY_STOP
        elif self.active and not fresh:
            self.fault = VehicleFault.COMMAND_TIMEOUT
        elif self.active and not guarded:
            self.fault = VehicleFault.GUARD_MISSING
        values = command.values
        self.active = (
            not self.fault
            and not self.address_lost
            and fresh
            and guarded
            and values is not None
            and None not in values
            and command.get("ArmKey") == ARM_KEY
        )
        if not self.active:
            self._stop()
            return
        c = self._carrier
        rate, speed, brake = command.last(3)
        self.brake = brake > 0.0
        self.drive_m_s = 0.0 if self.brake else _clamped(speed, c.speed_limit_m_s)
        rate = _clamped(rate, c.articulation_rate_limit_rad_s)
        outward = rate * self.articulation_rad > 0.0 and abs(self.articulation_rad) >= c.articulation_limit_rad
        self.steer = 0.0 if outward else spool_for(c.steer_valve, rate, MIN_RATE_RAD_S)

    def cycle(self, now_ns: int) -> None:
        if self._period.due(now_ns):
            parked = self.brake and abs(self.speed_m_s) < STANDSTILL_M_S
            gear = Gear.PARK if parked else Gear.NEUTRAL
            if self.drive_m_s:
                gear = Gear.FORWARD if self.drive_m_s > 0.0 else Gear.REVERSE
            state = (int(self.brake), int(parked and not self.active), self.fault, self._command.counter)
            self.outbox.append(self._stat.frame(gear, self.speed_m_s, self.articulation_rad, *state))


def _clamped(value: float, limit: float) -> float:
    return max(-limit, min(limit, value))
