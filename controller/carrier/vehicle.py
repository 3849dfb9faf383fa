"""The carrier as one part of the controller: its estimates, accepted setpoints, commands and reports.

A drive setpoint is a request like the crane's: refused whole with a `Reason`, or in force until its lease ends.  Its
order and its refusals are counted apart from the crane's.  Crane and carrier move one at a time: no drive setpoint is
accepted while the crane moves, and while the carrier is faster than `MAX_CREEP_M_S` no setpoint that moves the crane;
the crane's law may hold it in place meanwhile.  The end of a drive ramps the speed down and then brakes; a latching
reaction (R1, R0) brakes at once.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

from can_dbc.dbc.codec import Database
from can_dbc.messages.datagrams import encode
from can_dbc.messages.vehicle import VEHICLE_INPUTS, DriveSetpoint, Driving, Steering, VehicleReport
from controller.bus_io import MessageState, PeriodicTimer, or_nan
from controller.carrier.bus import STANDING, CarrierBus, CarrierCommand
from controller.carrier.dead_reckoning import DeadReckoning
from controller.carrier.monitors import VehicleMonitor
from controller.config import Settings
from controller.estimation.joint_estimator import JointEstimator, SensedJoint
from controller.laws.drive import AngleLaw, DriveLaw, SteeringLimits, WaypointLaw
from controller.laws.suspension import Suspension
from controller.requests import RequestRefused, SetpointGate
from machine.profile import Carrier, CarrierValve, Encoder
from machine.status.reasons import Reason, pack

MAX_CREEP_M_S: Final = 0.1
"""While the carrier is faster than this, the crane may not move."""
MAX_WAYPOINT_M: Final = 500.0
"""Greatest distance to a waypoint."""
RTK_FLOAT_SPEED_SHARE: Final = 0.4
"""Share of the speed limit to a waypoint while the position is RTK float."""
RTK_FLOAT: Final = 5
REPORT_NS: Final = 50_000_000
SIGMA_PER_HDOP_M: Final = {1: 1.0, 2: 0.5, 4: 0.015, 5: 0.3}
"""Assumed horizontal error over the dilution of precision, by the method of the solution."""
_NAN: Final = math.nan


@dataclass(frozen=True, slots=True)
class SteeringJoint:
    """The articulation as a joint for estimator and monitor (`controller.estimation.joint_estimator.TrackedJoint`)."""

    encoder: Encoder
    valve: CarrierValve
    speed_limit: float
    acceleration_limit: float


class Vehicle:
    """All state of the carrier; `estimate`, `check` and `control` once per tick, in this gate."""

    __slots__ = (
        "_angle",
        "_carrier",
        "_elapsed_s",
        "_inputs",
        "_lease_end_ns",
        "_report_due",
        "_report_sequence",
        "_sensed",
        "_settings",
        "_waypoint",
        "arms",
        "bus",
        "drive",
        "driving",
        "estimator",
        "gate",
        "monitor",
        "reckoning",
        "setpoint",
        "steering",
    )

    def __init__(
        self,
        settings: Settings,
        carrier: Carrier,
        articulation: MessageState,
        databases: tuple[Database, Database] | None,
    ) -> None:
        """``articulation`` is its encoder's message on crane0; raises ConfigError."""
        period_s = settings.period_ns * 1e-9
        self.bus = CarrierBus(databases)
        self._carrier = carrier
        rate = carrier.articulation_rate_limit_rad_s
        spec = SteeringJoint(carrier.articulation_encoder, carrier.steer_valve, rate, rate / carrier.articulation_lag_s)
        self.estimator = JointEstimator(spec, period_s)
        self._sensed = SensedJoint(articulation, carrier.articulation_encoder, self.estimator)
        self.reckoning = DeadReckoning(carrier, self.bus.inputs, self.estimator)
        self.monitor = VehicleMonitor(carrier, self.bus.inputs, self.reckoning, spec, period_s)
        self.gate = SetpointGate(settings.profile, settings.profile_hash)
        self.drive = DriveLaw(carrier)
        self.steering = SteeringLimits(carrier)
        self.arms = Suspension(carrier)
        self._waypoint, self._angle = WaypointLaw(carrier), AngleLaw(carrier, period_s)
        self.setpoint: DriveSetpoint | None = None
        """The setpoint in force."""
        self.driving = Driving.STANDING
        self._lease_end_ns, self._elapsed_s = 0, 0.0
        by_name = {state.codec.name: state for state in (*self.bus.inputs.messages, articulation)}
        self._inputs = tuple(by_name[name] for name in VEHICLE_INPUTS)
        self._settings = settings
        self._report_due, self._report_sequence = PeriodicTimer(REPORT_NS, 25_000_000), 0

    # -- estimate

    def estimate(self, elapsed_ns: int, now_ns: int) -> None:
        """Estimate articulation, position and heading at ``now_ns``."""
        self._elapsed_s = elapsed_ns * 1e-9
        self.estimator.predict(now_ns)
        self._sensed.update()
        self.reckoning.step(self._elapsed_s)

    @property
    def is_moving(self) -> bool:
        """Whether it is, or is about to be, too fast for the crane to move."""
        speed = self.reckoning.speed_m_s
        requested = self.setpoint.speed_m_s if self.setpoint is not None else 0.0
        return max(abs(requested), abs(self.drive.speed_m_s), abs(speed) if speed == speed else 0.0) > MAX_CREEP_M_S

    # -- accept

    def accept(self, setpoint: DriveSetpoint, crane_moves: bool, now_ns: int, late_ns: int) -> bool:
        """Put a setpoint in force; True when none was in force before.

        Raises:
            RequestRefused: the setpoint does not pass; nothing has changed then.
        """
        self.gate.check(setpoint, now_ns, late_ns)
        self._check_ranges(setpoint)
        if crane_moves:
            raise RequestRefused(Reason.CRANE_MOVES)
        waypoint = setpoint.steering is Steering.WAYPOINT
        reason = self.monitor.ready(waypoint)
        if reason:
            raise RequestRefused(reason)
        # The comparison also refuses a NaN from an overflow.
        if waypoint:
            offset_m = self.reckoning.offset_m(setpoint.latitude_deg, setpoint.longitude_deg)
            if not math.hypot(*offset_m) <= MAX_WAYPOINT_M:
                raise RequestRefused(Reason.DRIVE_WAYPOINT)
        began = self.setpoint is None
        if self.setpoint is None or self.setpoint.steering is not setpoint.steering:
            self._waypoint.reset()
            self._angle.reset()
        self.gate.mark_accepted(setpoint)
        self.setpoint = setpoint
        self._lease_end_ns = setpoint.stamp_ns + setpoint.lease_ns
        return began

    def _check_ranges(self, m: DriveSetpoint) -> None:
        c = self._carrier
        if m.float_front and m.float_rear:
            raise RequestRefused(Reason.FLOAT_BOTH)
        slowest = 0.0 if m.steering is Steering.WAYPOINT else -c.speed_limit_m_s
        if not slowest <= m.speed_m_s <= c.speed_limit_m_s:
            raise RequestRefused(Reason.DRIVE_SPEED)
        if not (abs(m.latitude_deg) <= 90.0 and abs(m.longitude_deg) <= 180.0):
            raise RequestRefused(Reason.DRIVE_WAYPOINT)
        turns = abs(m.articulation_rate_rad_s) <= c.articulation_rate_limit_rad_s
        if not (turns and abs(m.articulation_rad) <= c.articulation_limit_rad):
            raise RequestRefused(Reason.DRIVE_ARTICULATION)
        for i, height in enumerate(m.heights_m):
            if not 0.0 <= height <= c.arm_travel_m:
                raise RequestRefused(Reason.DRIVE_HEIGHT, i)

    def lease_over(self, now_ns: int) -> bool:
        """Tell whether the lease of the setpoint is over; True without a setpoint."""
        return self.setpoint is None or now_ns >= self._lease_end_ns

    @property
    def stands(self) -> bool:
        """Whether it was told to stand and does, so that the lease may end without a fault."""
        return self.setpoint is not None and self.setpoint.speed_m_s == 0.0 and self.drive.brake

    def drop_setpoint(self) -> None:
        """Drop the setpoint: none is in force any more."""
        self.setpoint = None

    # -- supervise

    def check(self, armed: bool, now_ns: int) -> tuple[Reason, int]:
        """Return the fault of this tick, (NONE, 0) without one."""
        if not armed:
            self.monitor.reset(now_ns)
            return Reason.NONE, 0
        setpoint, drives = self.setpoint, self.driving is not Driving.STANDING
        waypoint = setpoint is not None and setpoint.steering is Steering.WAYPOINT
        speed_m_s, rate_rad_s = self.drive.speed_m_s, self.steering.rate_rad_s
        return self.monitor.step(speed_m_s, rate_rad_s, drives, waypoint, self.arms, now_ns, self._elapsed_s)

    # -- control

    def control(self, active: bool, slowing: bool, cap: float, now_ns: int) -> None:
        """Compute the command of this tick; ``cap`` scales the speeds.

        It follows the setpoint while ``active``, slows down while ``slowing`` (a stop that does not latch), and stands
        with the brake on otherwise.
        """
        setpoint, speed = self.setpoint, self.reckoning.speed_m_s
        if active and setpoint is not None:
            self.driving = Driving.DRIVING
            self._execute(setpoint, speed, cap, now_ns)
        elif slowing and self.driving is not Driving.STANDING and not self.drive.brake:
            self.driving = Driving.BRAKING
            self.setpoint = None
            self.drive.stop(speed, self._elapsed_s)
            self.steering.reset()
            self.arms.hold()
            self._command(False, False)
        else:
            self._stand()

    def _stand(self) -> None:
        self.driving = Driving.STANDING
        self.setpoint = None
        self.drive.reset()
        self.steering.reset()
        self.arms.hold()
        self.bus.command = STANDING

    def _execute(self, m: DriveSetpoint, speed: float, cap: float, now_ns: int) -> None:
        elapsed_s, reckoning = self._elapsed_s, self.reckoning
        slow = m.steering is Steering.WAYPOINT and reckoning.fix == RTK_FLOAT
        self.drive.step(m.speed_m_s, speed, RTK_FLOAT_SPEED_SHARE * cap if slow else cap, elapsed_s)
        rolls = self.drive.speed_m_s != 0.0
        self._steer(m, rolls, now_ns)
        floats = (m.float_front and rolls, m.float_rear and rolls)
        self.arms.step(m.heights_m, reckoning.heights_m, m.level, reckoning.tilt_rad, floats, cap, elapsed_s)
        self._command(floats[0], floats[1])

    def _steer(self, m: DriveSetpoint, rolls: bool, now_ns: int) -> None:
        angle, elapsed_s = self.estimator.position, self._elapsed_s
        if m.steering is Steering.WAYPOINT:
            east, north = self.reckoning.offset_m(m.latitude_deg, m.longitude_deg)
            # While the machine stands, turning the front half would only scrub the tyres.
            rate_rad_s = self._waypoint.step(east, north, self.reckoning.yaw_rad) if rolls else 0.0
            self.steering.step(rate_rad_s, angle, elapsed_s)
            return
        rate = m.articulation_rate_rad_s
        limit = self._carrier.articulation_limit_rad
        ahead = min(max(m.articulation_rad + rate * (now_ns - m.stamp_ns) * 1e-9, -limit), limit)
        command = self.steering.step(self._angle.step(ahead, rate, angle), angle, elapsed_s)
        self._angle.note_command(command, rate, elapsed_s)

    def _command(self, float_front: bool, float_rear: bool) -> None:
        drive = self.drive
        self.bus.command = CarrierCommand(
            True,
            self.steering.rate_rad_s,
            drive.speed_m_s,
            100.0 if drive.brake else 0.0,
            tuple(self.arms.spools_pct),
            float_front,
            float_rear,
        )

    # -- encode

    def stale_mask(self) -> int:
        """Collect the stale inputs: one bit per message of `VEHICLE_INPUTS`."""
        mask = 0
        for bit, state in enumerate(self._inputs):
            if state.values is None:
                mask |= 1 << bit
        return mask

    def report(self, now_ns: int) -> bytes | None:
        """Build a vehicle report when one is due."""
        if not self._report_due.due(now_ns):
            return None
        inputs, reckoning, gate = self.bus.inputs, self.reckoning, self.gate
        self._report_sequence = (self._report_sequence + 1) & 0xFFFF_FFFF
        vehicle, position, heading, fix = inputs.vehicle, inputs.position, inputs.heading, inputs.fix
        hdop, rate = fix.get("Hdop"), inputs.rate_of_turn.get("Rate")
        roll, pitch = reckoning.tilt_rad
        h1, h2, h3, h4 = reckoning.heights_m
        # By place: CPython 3.11 never reuses a tuple of 20 field names (see `controller.state_report`).
        report = VehicleReport(
            self._report_sequence,
            self._settings.profile_hash,
            now_ns,
            gate.sequence,
            int(self.driving),
            pack(gate.refusal, gate.detail),
            gate.refused,
            position.stamp_ns,
            or_nan(position.get("Latitude")),
            or_nan(position.get("Longitude")),
            or_nan(fix.get("Altitude")),
            reckoning.fix,
            int(fix.get("NumberOfSvs") or 0),
            _NAN if hdop is None else SIGMA_PER_HDOP_M.get(reckoning.fix, _NAN) * hdop,
            heading.stamp_ns,
            or_nan(reckoning.heading_rad),
            _NAN if rate is None else -rate,
            vehicle.stamp_ns,
            reckoning.speed_m_s,
            self.estimator.position,
            roll,
            pitch,
            (h1, h2, h3, h4),
            self.stale_mask(),
        )
        return encode(report)
