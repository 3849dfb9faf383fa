"""The nodes of mach0 but the receiver: engine, vehicle controller and swing-arm controller on one J1939 base."""

from __future__ import annotations

from collections.abc import Callable
from enum import IntEnum

from can_dbc.dbc.codec import Database
from can_dbc.protocols.nmea2000 import BROADCAST, encode, frames, split_id
from can_dbc.protocols.punctuality import Punctuality
from machine.profile import Carrier, CarrierValve, Valve
from sim.nodes import Outbox
from sim.nodes.messages import ARM_KEY, MS, PeriodicTimer, ProtectedInput, ProtectedMessage

# -- The base of the nodes of mach0: a fixed source address, claimed by NAME (J1939-81), and PGN-matched frames.
#
# A node claims at power-on (PGN 60928), answers requests for its claim (PGN 59904), defends its address against a
# NAME of lower priority (a greater number), and falls silent for good when it loses: it then reports so from
# address 254. Addresses below 128 need no waiting time after the claim (J1939-81, 4.4.3.3).

CLAIM_PGN, REQUEST_PGN = 60928, 59904
ADDRESS_FORMATS = (REQUEST_PGN >> 8, CLAIM_PGN >> 8)  # the byte of the identifier that marks these two
NULL_ADDRESS = 254
NO_MANUFACTURER = 2047  # none is assigned to this project
FORESTRY, MARINE = 2, 4  # industry groups


class J1939Node:
    """One node; ``address_lost`` is set once another node has its address."""

    def __init__(
        self,
        address: int,
        function: int,
        machine: Database,
        outbox: Outbox,
        *,
        industry: int = FORESTRY,
        system: int = 0,
    ) -> None:
        self.address, self.outbox = address, outbox
        self._claim, self._request = machine.message("AddressClaim"), machine.message("Request")
        self.name = encode(
            self._claim,
            IdentityNumber=address,
            ManufacturerCode=NO_MANUFACTURER,
            EcuInstance=0,
            FunctionInstance=0,
            Function=function,
            Reserved=0,
            VehicleSystem=system,
            VehicleSystemInstance=0,
            IndustryGroup=industry,
            ArbitraryAddress=0,
        )
        self._claimed = self.address_lost = False

    def _send_claim(self) -> None:
        self.outbox += frames(self._claim, self.name, NULL_ADDRESS if self.address_lost else self.address)

    def receive(self, key: int, data: bytes, now_ns: int) -> None:
        """Handle a frame of the bus."""
        if key >> 16 & 0xFF not in ADDRESS_FORMATS:
            return
        _, pgn, source, destination = split_id(key)
        if pgn == REQUEST_PGN:
            requested_pgn = self._request.receive(data)[0] if len(data) == 3 else None
            if requested_pgn == CLAIM_PGN and destination in (self.address, BROADCAST):
                self._send_claim()
        elif pgn == CLAIM_PGN and source == self.address and len(data) == 8:
            theirs, ours = (int.from_bytes(name, "little") for name in (data, self.name))
            self.address_lost = self.address_lost or theirs <= ours
            self._send_claim()

    def tick(self, now_ns: int) -> None:
        """Claim at power-on, then the periodic frames."""
        if not self._claimed:
            self._claimed = True
            self._send_claim()
        if not self.address_lost:
            self.cycle(now_ns)

    def cycle(self, now_ns: int) -> None:
        """Send the periodic frames of a node that has its address."""


# -- The swing-arm controller (source address 30h): spool commands of the four arms and the two float valves.
#
# The spools follow ArmCmdA and the float valves ArmCmdB while both (E2E valid, ArmKey 0xA) and GuardAlive (Enable
# 0xA) are at most 100 ms old, the commands are not late by their number (`can_dbc.protocols.punctuality`), and the
# emergency stop is released.  Otherwise the arms hold: spools neutral, float valves closed.  A loss while active,
# and a command that opens both float valves (which would let the machine roll), are a fault until fresh frames
# disarm.  The node reports the heights on which the controller closes its loop.

ARMS_ADDRESS = 0x30
SUSPENSION_FUNCTION = 21  # J1939 NAME function of a suspension system controller
ARMS_COMMAND_NS, ARMS_GUARD_NS = 90 * MS, 100 * MS
CYCLE_NS = 20 * MS
ARM_COUNT = 4


class ArmState(IntEnum):
    """ArmHeightA.State."""

    HOLD = 0
    ACTIVE = 1
    FAULT = 3


class ArmNode(J1939Node):
    """The present outputs are ``spools`` (-1..1, + raises the frame; fl fr rl rr), ``float_front`` and ``float_rear``.

    The plant sets ``heights_mm`` relative to mid travel, ``roll_deg`` (+ right side down), ``pitch_deg`` (+ nose up).
    """

    def __init__(self, machine: Database, outbox: Outbox, pilot_on: Callable[[], bool]) -> None:
        super().__init__(ARMS_ADDRESS, SUSPENSION_FUNCTION, machine, outbox)
        self._pilot_on = pilot_on
        self._a, self._b = (
            ProtectedInput(machine, name, Punctuality(CYCLE_NS, ARMS_COMMAND_NS)) for name in ("ArmCmdA", "ArmCmdB")
        )
        self._guard = ProtectedInput(machine, "GuardAlive")
        self._inputs = {i.key: i for i in (self._a, self._b, self._guard)}
        self._height_a, self._height_b = (
            ProtectedMessage(machine, "ArmHeightA"),
            ProtectedMessage(machine, "ArmHeightB"),
        )
        self._period = PeriodicTimer(CYCLE_NS, phase_ns=5 * MS)
        self.heights_mm = (0.0,) * ARM_COUNT
        self.roll_deg = self.pitch_deg = 0.0
        self.state = ArmState.HOLD
        self._hold()

    def _hold(self) -> None:
        self.spools = [0.0] * ARM_COUNT
        self.float_front = self.float_rear = False

    def receive(self, key: int, data: bytes, now_ns: int) -> None:
        source = self._inputs.get(key)
        if source is None:
            super().receive(key, data, now_ns)
        elif source.accept(data, now_ns) and source is not self._guard and source.get("ArmKey") != ARM_KEY:
            self.state = ArmState.HOLD

    def decide(self, now_ns: int) -> None:
        """Set the outputs for this physics step."""
        a, b = self._a, self._b
        guarded = self._guard.fresh(now_ns, ARMS_GUARD_NS) and self._guard.get("Enable") == ARM_KEY
        commanded = a.fresh(now_ns, ARMS_COMMAND_NS) and b.fresh(now_ns, ARMS_COMMAND_NS) and not (a.late or b.late)
        ready = commanded and guarded and self._pilot_on() and not self.address_lost
        armed = a.get("ArmKey") == b.get("ArmKey") == ARM_KEY
        front, rear = b.get("FloatFront") == 1, b.get("FloatRear") == 1
        if (self.state is ArmState.ACTIVE and not ready) or (ready and armed and front and rear):
            self.state = ArmState.FAULT
        elif self.state is not ArmState.FAULT:
            self.state = ArmState.ACTIVE if ready and armed else ArmState.HOLD
        if self.state is not ArmState.ACTIVE:
            self._hold()
            return
        self.spools = [(percent or 0.0) / 100.0 for percent in a.last(ARM_COUNT)]
        self.float_front, self.float_rear = front, rear

    def cycle(self, now_ns: int) -> None:
        if self._period.due(now_ns):
            self.outbox.append(self._height_a.frame(self.state, *self.heights_mm))
            floats = (int(self.float_front), int(self.float_rear))
            self.outbox.append(self._height_b.frame(self.state, *floats, self.roll_deg, self.pitch_deg))


# -- The diesel engine (source address 00h): EEC1, CCVS and DM1 in the layout of J1939-71/73.
#
# It runs at one working speed and droops under the hydraulic load.  ``set_trouble`` puts a code into DM1.

ENGINE_ADDRESS = 0x00
WORKING_RPM = 1500.0
DROOP_SHARE = 0.05  # of the speed, at full power
FULL_POWER_W = 110e3
IDLE_TORQUE_PCT = 12.0
LAG_S = 0.25
KM_H_PER_M_S = 3.6


class EngineNode(J1939Node):
    """The plant sets ``energy_j`` (hydraulic, since the start), ``speed_m_s``, ``brake``."""

    def __init__(self, machine: Database, outbox: Outbox) -> None:
        super().__init__(ENGINE_ADDRESS, 0, machine, outbox)
        self._eec1, self._ccvs, self._dm1 = (machine.message(n) for n in ("EEC1", "CCVS", "DM1"))
        self._fast, self._medium, self._slow = (
            PeriodicTimer(CYCLE_NS),
            PeriodicTimer(100 * MS, 10 * MS),
            PeriodicTimer(1000 * MS, 30 * MS),
        )
        self.energy_j = self.speed_m_s = 0.0
        self.brake = True
        self._last_j = self._load = 0.0
        self._trouble = (0, 0)

    def set_trouble(self, spn: int, fmi: int) -> None:
        """Set a suspect parameter number and failure mode, with the amber lamp; (0, 0): none."""
        self._trouble = (spn, fmi)

    def cycle(self, now_ns: int) -> None:
        if self._fast.due(now_ns):
            power_w = (self.energy_j - self._last_j) / (CYCLE_NS * 1e-9)
            self._last_j = self.energy_j
            self._load += CYCLE_NS * 1e-9 / LAG_S * (min(1.0, max(0.0, power_w / FULL_POWER_W)) - self._load)
            torque = IDLE_TORQUE_PCT + (100.0 - IDLE_TORQUE_PCT) * self._load
            payload = encode(
                self._eec1,
                TorqueMode=1,
                ActualTorqueFine=0,
                DemandTorque=torque,
                ActualTorque=torque,
                EngineSpeed=WORKING_RPM * (1.0 - DROOP_SHARE * self._load),
                SourceAddress=ENGINE_ADDRESS,
                StarterMode=0,
                Reserved=0xF,
                EngineDemandTorque=torque,
            )
            self.outbox += frames(self._eec1, payload, ENGINE_ADDRESS)
        if self._medium.due(now_ns):
            speed = KM_H_PER_M_S * abs(self.speed_m_s)
            brake = int(self.brake)
            payload = encode(
                self._ccvs, WheelSpeed=speed, BrakeSwitch=brake, ParkingBrake=int(self.brake and speed < 0.1)
            )
            self.outbox += frames(self._ccvs, payload, ENGINE_ADDRESS)
        if self._slow.due(now_ns):
            spn, fmi = self._trouble
            lamps = dict.fromkeys(("ProtectLamp", "RedLamp", "MalfunctionLamp"), 0)
            code = {
                "SpnLow": spn & 0xFFFF,
                "SpnHigh": spn >> 16,
                "Fmi": fmi,
                "Occurrence": int(spn != 0),
                "Conversion": 0,
            }
            self.outbox += frames(
                self._dm1, encode(self._dm1, AmberLamp=int(spn != 0), **lamps, **code), ENGINE_ADDRESS
            )


# -- The vehicle controller (source address 03h): receives VehCmd, drives, steers and brakes; without it the brake is
# on.
#
# It follows only while VehCmd (E2E valid, ArmKey 0xA, every value available) and GuardAlive (Enable 0xA) are at
# most 100 ms old, VehCmd is not late by its number (`can_dbc.protocols.punctuality`), and the emergency stop is
# released. Otherwise the brake is on and the steering spool neutral, at once; a loss while driving remains a fault
# until a fresh frame disarms.  The node's own dead-band map turns the articulation rate into a spool command.

VEHICLE_ADDRESS = 0x03
DRIVE_FUNCTION = 23  # J1939 NAME function of a propulsion controller
VEHICLE_COMMAND_NS, VEHICLE_GUARD_NS = 90 * MS, 100 * MS
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
    """Find the spool command -1..1 that gives ``speed`` by the profile; speeds up to ``least`` leave it neutral."""
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
        super().__init__(VEHICLE_ADDRESS, DRIVE_FUNCTION, machine, outbox)
        self._carrier, self._pilot_on = carrier, pilot_on
        self._command = ProtectedInput(machine, "VehCmd", Punctuality(CYCLE_NS, VEHICLE_COMMAND_NS))
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
        fresh = command.fresh(now_ns, VEHICLE_COMMAND_NS) and not command.late
        guarded = self._guard.fresh(now_ns, VEHICLE_GUARD_NS) and self._guard.get("Enable") == ARM_KEY
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
