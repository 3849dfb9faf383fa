"""The carrier as one part of the controller: what is known of it, what it is asked for, what it does and says.

A drive setpoint is a request like the crane's: refused whole with a `Reason`, or obeyed until its lease is over.  Its
order and its refusals are counted apart from the crane's.  Crane and carrier move one at a time: no drive setpoint is
taken while the crane moves, and while the carrier goes faster than `CREEP_M_S` no setpoint that moves the crane; the
crane may be held in place by its own law meanwhile.  What ends a drive ramps the speed down and then brakes; what
latches (R1, R0) brakes at once.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

from can_dbc.codec import Database
from can_dbc.setpoint import encode
from can_dbc.vehicle_datagrams import VEHICLE_INPUTS, DriveSetpoint, Driving, Steering, VehicleReport
from controller.carrier.bus import MachineBus
from controller.carrier.dead_reckoning import Whereabouts
from controller.carrier.monitors import VehicleWatch
from controller.carrier.outputs import STANDING, CarrierCommand
from controller.config import Settings
from controller.estimator import JointEstimator
from controller.laws.drive import DriveLaw
from controller.laws.heading import AngleLaw, SteeringLimits, WaypointLaw
from controller.laws.suspension import Suspension
from controller.message_state import Slot, known
from controller.outputs import Every
from controller.requests import Order, Refused
from machine.encoder import position_from_counts
from machine.profile import Carrier, CarrierValve, Encoder
from machine.reasons import Reason, pack

CREEP_M_S: Final = 0.1
"""Faster than this nothing may move the crane."""
SITE_M: Final = 500.0
"""A waypoint is not farther away than this."""
UNSURE_SHARE: Final = 0.4
"""Share of the speed limit to a waypoint while the position is RTK float."""
RTK_FLOAT: Final = 5
REPORT_NS: Final = 50_000_000
SIGMA_M: Final = {1: 1.0, 2: 0.5, 4: 0.015, 5: 0.3}
"""Assumed horizontal error over the dilution of precision, by the method of the solution."""
_NAN: Final = math.nan


@dataclass(frozen=True, slots=True)
class Articulation:
    """What the estimator needs of the steering joint (`controller.estimator.Tracked`)."""

    encoder: Encoder
    valve: CarrierValve
    speed_limit: float
    acceleration_limit: float


class Vehicle:
    """All state of the carrier; one call of `estimate`, `judge` and `control` per tick, in this order."""

    __slots__ = (
        "_angle", "_articulation", "_carrier", "_elapsed_s", "_inputs", "_lease_end_ns", "_report_due",
        "_report_sequence", "_settings", "_waypoint", "arms", "bus", "drive", "driving", "estimator", "order",
        "setpoint", "steering", "watch", "where",
    )  # fmt: skip

    def __init__(
        self,
        settings: Settings,
        carrier: Carrier,
        articulation: Slot,
        databases: tuple[Database, Database] | None,
    ) -> None:
        """``articulation`` is the slot of its encoder on crane0; raises ConfigError."""
        period_s = settings.period_ns * 1e-9
        self.bus = MachineBus(databases)
        self._carrier, self._articulation = carrier, articulation
        rate = carrier.articulation_rate_limit_rad_s
        spec = Articulation(carrier.articulation_encoder, carrier.steer_valve, rate, rate / carrier.articulation_lag_s)
        self.estimator = JointEstimator(spec, period_s)
        self.where = Whereabouts(carrier, self.bus.received, self.estimator)
        self.watch = VehicleWatch(carrier, self.bus.received, self.where, spec, period_s)
        self.order = Order(settings.profile, settings.profile_hash)
        self.drive = DriveLaw(carrier)
        self.steering = SteeringLimits(carrier)
        self.arms = Suspension(carrier)
        self._waypoint, self._angle = WaypointLaw(carrier), AngleLaw(carrier, period_s)
        self.setpoint: DriveSetpoint | None = None
        """What is obeyed now."""
        self.driving = Driving.STANDING
        self._lease_end_ns, self._elapsed_s = 0, 0.0
        by_name = {slot.codec.name: slot for slot in (*self.bus.received.slots, articulation)}
        self._inputs = tuple(by_name[name] for name in VEHICLE_INPUTS)
        self._settings = settings
        self._report_due, self._report_sequence = Every(REPORT_NS, 25_000_000), 0

    # -- what is known

    def estimate(self, elapsed_ns: int, now_ns: int) -> None:
        """Articulation, place and heading at ``now_ns``."""
        self._elapsed_s = elapsed_ns * 1e-9
        slot, estimator = self._articulation, self.estimator
        estimator.predict(now_ns)
        if slot.fresh:
            counts = slot.get("Position")
            estimator.sample(position_from_counts(self._carrier.articulation_encoder, counts), slot.stamp_ns)
        elif slot.values is None:
            estimator.reset()
        self.where.step(self._elapsed_s)

    @property
    def moves(self) -> bool:
        """Whether it goes faster than the crane may bear, or is about to."""
        speed = self.where.speed_m_s
        asked = self.setpoint.speed_m_s if self.setpoint is not None else 0.0
        return max(abs(asked), abs(self.drive.speed_m_s), abs(speed) if speed == speed else 0.0) > CREEP_M_S

    # -- what it is asked for

    def take(self, setpoint: DriveSetpoint, crane_moves: bool, now_ns: int, late_ns: int) -> bool:
        """Obeys a setpoint from here on, True when it obeyed none before; raises Refused, and then nothing changed."""
        self.order.check(setpoint, now_ns, late_ns)
        self._check_ranges(setpoint)
        if crane_moves:
            raise Refused(Reason.CRANE_MOVES)
        waypoint = setpoint.steering is Steering.WAYPOINT
        reason = self.watch.ready(waypoint)
        if reason:
            raise Refused(reason)
        # Written so that an overflow to NaN is refused too.
        if waypoint and not math.hypot(*self.where.to_m(setpoint.latitude_deg, setpoint.longitude_deg)) <= SITE_M:
            raise Refused(Reason.DRIVE_WAYPOINT)
        began = self.setpoint is None
        if self.setpoint is None or self.setpoint.steering is not setpoint.steering:
            self._waypoint.reset()
            self._angle.reset()
        self.order.note_order(setpoint)
        self.setpoint = setpoint
        self._lease_end_ns = setpoint.stamp_ns + setpoint.lease_ns
        return began

    def _check_ranges(self, m: DriveSetpoint) -> None:
        c = self._carrier
        if m.float_front and m.float_rear:
            raise Refused(Reason.FLOAT_BOTH)
        slowest = 0.0 if m.steering is Steering.WAYPOINT else -c.speed_limit_m_s
        if not slowest <= m.speed_m_s <= c.speed_limit_m_s:
            raise Refused(Reason.DRIVE_SPEED)
        if not (abs(m.latitude_deg) <= 90.0 and abs(m.longitude_deg) <= 180.0):
            raise Refused(Reason.DRIVE_WAYPOINT)
        turns = abs(m.articulation_rate_rad_s) <= c.articulation_rate_limit_rad_s
        if not (turns and abs(m.articulation_rad) <= c.articulation_limit_rad):
            raise Refused(Reason.DRIVE_ARTICULATION)
        for i, height in enumerate(m.heights_m):
            if not 0.0 <= height <= c.arm_travel_m:
                raise Refused(Reason.DRIVE_HEIGHT, i)

    def over(self, now_ns: int) -> bool:
        """Whether the lease of what it obeyed is over; True also when it obeys nothing."""
        return self.setpoint is None or now_ns >= self._lease_end_ns

    @property
    def stands(self) -> bool:
        """Whether the lease may run out in peace: it was told to stand, and does."""
        return self.setpoint is not None and self.setpoint.speed_m_s == 0.0 and self.drive.brake

    def end(self) -> None:
        """Obeys nothing any more."""
        self.setpoint = None

    # -- what it does

    def judge(self, armed: bool, now_ns: int) -> tuple[Reason, int]:
        """What is wrong with it now."""
        if not armed:
            self.watch.reset(now_ns)
            return Reason.NONE, 0
        setpoint, drives = self.setpoint, self.driving is not Driving.STANDING
        waypoint = setpoint is not None and setpoint.steering is Steering.WAYPOINT
        told_m_s, told_rad_s = self.drive.speed_m_s, self.steering.rate_rad_s
        return self.watch.step(told_m_s, told_rad_s, drives, waypoint, self.arms, now_ns, self._elapsed_s)

    def control(self, active: bool, slowing: bool, cap: float, now_ns: int) -> None:
        """The command of this tick: obeys while ``active``, slows down while ``slowing`` (a stop that does not latch),
        and stands with its brake on otherwise; ``cap`` scales the speeds.
        """
        setpoint, speed = self.setpoint, self.where.speed_m_s
        if active and setpoint is not None:
            self.driving = Driving.DRIVING
            self._obey(setpoint, speed, cap, now_ns)
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

    def _obey(self, m: DriveSetpoint, speed: float, cap: float, now_ns: int) -> None:
        elapsed_s, where = self._elapsed_s, self.where
        unsure = m.steering is Steering.WAYPOINT and where.fix == RTK_FLOAT
        self.drive.step(m.speed_m_s, speed, UNSURE_SHARE * cap if unsure else cap, elapsed_s)
        rolls = self.drive.speed_m_s != 0.0
        self._steer(m, rolls, now_ns)
        floats = (m.float_front and rolls, m.float_rear and rolls)
        self.arms.step(m.heights_m, where.heights_m, m.level, where.tilt_rad, floats, cap, elapsed_s)
        self._command(*floats)

    def _steer(self, m: DriveSetpoint, rolls: bool, now_ns: int) -> None:
        angle, elapsed_s = self.estimator.position, self._elapsed_s
        if m.steering is Steering.WAYPOINT:
            east, north = self.where.to_m(m.latitude_deg, m.longitude_deg)
            # A front that stands would only scrub round to the waypoint.
            wanted = self._waypoint.step(east, north, self.where.yaw_rad) if rolls else 0.0
            self.steering.step(wanted, angle, elapsed_s)
            return
        rate = m.articulation_rate_rad_s
        limit = self._carrier.articulation_limit_rad
        ahead = min(max(m.articulation_rad + rate * (now_ns - m.stamp_ns) * 1e-9, -limit), limit)
        told = self.steering.step(self._angle.step(ahead, rate, angle), angle, elapsed_s)
        self._angle.told(told, rate, elapsed_s)

    def _command(self, float_front: bool, float_rear: bool) -> None:
        drive = self.drive
        self.bus.command = CarrierCommand(
            True, self.steering.rate_rad_s, drive.speed_m_s, 100.0 if drive.brake else 0.0,
            tuple(self.arms.spools_pct), float_front, float_rear,
        )  # fmt: skip

    # -- what it says

    def stale_mask(self) -> int:
        """Bits of `VEHICLE_INPUTS` of which nothing fresh is known."""
        mask = 0
        for bit, slot in enumerate(self._inputs):
            if slot.values is None:
                mask |= 1 << bit
        return mask

    def report(self, now_ns: int) -> bytes | None:
        """A vehicle report when one is due."""
        if not self._report_due.due(now_ns):
            return None
        machine, where, order = self.bus.received, self.where, self.order
        self._report_sequence = (self._report_sequence + 1) & 0xFFFF_FFFF
        vehicle, position, heading, fix = machine.vehicle, machine.position, machine.heading, machine.fix
        hdop, rate = fix.get("Hdop"), machine.rate_of_turn.get("Rate")
        roll, pitch = where.tilt_rad
        h1, h2, h3, h4 = where.heights_m
        # By place: CPython 3.11 never takes the names of 20 fields from its free list again (see `controller.reports`).
        report = VehicleReport(
            self._report_sequence, self._settings.profile_hash, now_ns, order.sequence, int(self.driving),
            pack(order.refusal, order.detail), order.refused, position.stamp_ns, known(position.get("Latitude")),
            known(position.get("Longitude")), known(fix.get("Altitude")), where.fix, int(fix.get("NumberOfSvs") or 0),
            _NAN if hdop is None else SIGMA_M.get(where.fix, _NAN) * hdop, heading.stamp_ns,
            known(where.heading_rad), _NAN if rate is None else -rate, vehicle.stamp_ns, where.speed_m_s,
            self.estimator.position, roll, pitch, (h1, h2, h3, h4), self.stale_mask(),
        )  # fmt: skip
        return encode(report, self._settings.key)
