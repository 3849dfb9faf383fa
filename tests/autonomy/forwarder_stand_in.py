"""A forwarder without mass on level ground: it executes drive setpoints and frame heights, with the crane of
`crane_stand_in`; a perfect detector lists the logs near it.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import replace

import numpy as np

from autonomy.localization.local_plane import LocalPlane
from autonomy.localization.localizer import LATENCY_NS
from autonomy.manager.activity_manager import ActivityManager
from autonomy.manager.loading_stops import base_on_path
from autonomy.manager.log_map import MappedLog
from autonomy.perception.camera.frame import Pose
from autonomy.perception.log_list import LogObservation
from can_dbc.messages.crane import CraneSetpoint
from can_dbc.messages.datagrams import decode
from can_dbc.messages.vehicle import DriveSetpoint, Driving, Steering, VehicleReport
from machine.geometry.carrier import heading_rate_rad_s
from machine.profile import Profile
from machine.status.modes import Mode
from tests.autonomy.carrier_model import heading_from_yaw
from tests.autonomy.crane_stand_in import TICK_NS, StandIn, over_bunk
from tests.console.vehicle_reports import VEHICLE

TICK_S = TICK_NS * 1e-9
RANGE_M = 14.0
ACCELERATION_M_S2 = 0.5
RATE_M_S = 0.1


class Forwarder:
    """Machine, controller and field; ``step`` is one tick of 50 ms."""

    def __init__(
        self, profile: Profile, plane: LocalPlane, logs: list[MappedLog], at: tuple[float, float, float]
    ) -> None:
        self.profile, self.plane, self.carrier = profile, plane, profile.carrier
        self.crane = StandIn(profile, [], q=(0.0, 0.9, -1.6, 0.5, 0.0))
        self.x_m, self.y_m, self.yaw_rad = at
        self.articulation_rad = self.speed_m_s = 0.0
        self.heights_m = [0.1] * 4
        self.field = {log.number: log for log in logs}
        self.drive: DriveSetpoint | None = None
        self.blind: set[int] = set()
        """Logs that the detector does not see."""
        self.driven_m = 0.0
        self._past: deque[tuple[float, float, float]] = deque([at] * 3, maxlen=3)
        self._turn_rad_s = 0.0
        here, there = plane.geodetic(0.0, 0.0), plane.geodetic(1.0, 1.0)  # straight enough for a small site
        self._degrees = (there[0] - here[0], there[1] - here[1])
        self._base = self.base()

    def base(self) -> Pose:
        """The crane's base in the plane."""
        lf, lr = self.carrier.front_axle_m, self.carrier.rear_axle_m
        yaw = self.yaw_rad - self.articulation_rad
        joint = np.array([self.x_m - lf * math.cos(self.yaw_rad), self.y_m - lf * math.sin(self.yaw_rad)])
        rear = joint - lr * np.array([math.cos(yaw), math.sin(yaw)])
        height = sum(self.heights_m) / 4
        return base_on_path(self.carrier, (self.x_m, self.y_m, self.yaw_rad), (float(rear[0]), float(rear[1])), height)

    @property
    def in_bunk(self) -> int:
        """Logs that lie in the bunk."""
        held = self.crane.held
        return sum(over_bunk(self.profile, o.center_m) for o in self.crane.logs if o.id != held)

    def vehicle(self) -> VehicleReport:
        """The controller's vehicle report."""
        now_ns = self.crane.now_ns
        x, y, yaw = (0.5 * (a + b) for a, b in zip(self._past[0], self._past[1], strict=True))
        assert LATENCY_NS == 75_000_000  # between those two
        ahead = self.carrier.antenna_main_m[0] - self.carrier.front_axle_m
        side = self.carrier.antenna_main_m[1]
        c, s = math.cos(yaw), math.sin(yaw)
        east, north = x + c * ahead - s * side, y + s * ahead + c * side
        return replace(
            VEHICLE,
            profile_hash=self.crane.profile_hash,
            stamp_ns=now_ns,
            drive_sequence=self.drive.sequence if self.drive else 0,
            driving=Driving.DRIVING if self.drive else Driving.STANDING,
            position_ns=now_ns,
            latitude_deg=self.plane.latitude_deg + north * self._degrees[0],
            longitude_deg=self.plane.longitude_deg + east * self._degrees[1],
            altitude_m=102.5,
            heading_ns=now_ns,
            heading_rad=heading_from_yaw(yaw),
            yaw_rate_rad_s=self._turn_rad_s,
            motion_ns=now_ns,
            speed_m_s=self.speed_m_s,
            articulation_rad=self.articulation_rad,
            roll_rad=0.0,
            pitch_rad=0.0,
            heights_m=tuple(self.heights_m),
        )

    def seen(self) -> tuple[LogObservation, ...] | None:
        """What lies near, in the base frame, four times a second."""
        if self.crane.now_ns % (5 * TICK_NS):
            return None
        near = [o for o in self.crane.logs if math.hypot(*o.center_m[:2]) < RANGE_M and o.id not in self.blind]
        return tuple(near)

    def step(self, manager: ActivityManager) -> None:
        """One tick."""
        crane = self.crane
        self._lie()
        for data in manager.step(crane.now_ns, crane.report(), self.vehicle(), self.seen()):
            setpoint = decode(data)
            if isinstance(setpoint, CraneSetpoint):
                assert self.speed_m_s == 0.0, "the crane works while the machine drives"
                crane._judge(setpoint)
                crane.setpoint, crane.mode = setpoint, Mode.ACTIVE
            else:
                assert isinstance(setpoint, DriveSetpoint)
                assert setpoint.profile_hash == self.crane.profile_hash
                assert not (setpoint.float_front and setpoint.float_rear)
                self.drive = setpoint
        crane.now_ns += TICK_NS
        if crane.setpoint is not None and crane.now_ns > crane.setpoint.stamp_ns + crane.setpoint.lease_ns:
            crane.setpoint = None
        if self.drive is not None and crane.now_ns > self.drive.stamp_ns + self.drive.lease_ns:
            self.drive = None
        if crane.mode in (Mode.ARMED, Mode.ACTIVE):
            crane.mode = Mode.ACTIVE if crane.setpoint or self.drive else Mode.ARMED
        if crane.setpoint is not None and crane.mode is Mode.ACTIVE:
            crane.q = crane._knot_at(crane.now_ns).position
            crane._grapple(crane.setpoint.grapple)
        crane._carry()
        self._move()

    def run(self, manager: ActivityManager, done, limit_s: float = 600.0) -> float:
        """Until ``done(manager)``; the time it took [s]."""
        begin = self.crane.now_ns
        while not done(manager):
            self.step(manager)
            assert self.crane.now_ns - begin < limit_s * 1e9, (manager.state.name, manager.paused, manager.failure)
        return (self.crane.now_ns - begin) * 1e-9

    def steps(self, manager: ActivityManager, count: int) -> None:
        """So many ticks."""
        for _ in range(count):
            self.step(manager)

    def _lie(self) -> None:
        """The logs of the field as they lie in the base frame now; those on board and in the grapple go with it."""
        base = self.base()
        aboard = {o.id for o in self.crane.logs if over_bunk(self.profile, o.center_m) or o.id == self.crane.held}
        kept = [o for o in self.crane.logs if o.id in aboard]
        for o in self.crane.logs:
            if o.id not in aboard and o.id in self.field:  # laid down elsewhere: where it is now in the plane
                center = self._base.to_base(np.asarray(o.center_m))
                was = self.field[o.id]
                self.field[o.id] = MappedLog(
                    o.id, center, self._base.rotation @ np.asarray(o.axis), was.length_m, was.diameter_m, 0.1, 1, 0
                )
        lying = [log.observation(base) for log in self.field.values() if log.number not in aboard]
        self.crane.logs = kept + lying
        self._base = base

    def _move(self) -> None:
        d = self.drive
        wanted = d.speed_m_s if d is not None else 0.0
        self.speed_m_s += min(max(wanted - self.speed_m_s, -ACCELERATION_M_S2 * TICK_S), ACCELERATION_M_S2 * TICK_S)
        if abs(self.speed_m_s) < 1e-9:
            self.speed_m_s = 0.0
        rate = self._rate(d) if d is not None and self.speed_m_s else 0.0
        limit = self.carrier.articulation_limit_rad
        bend = min(max(self.articulation_rad + rate * TICK_S, -limit), limit)
        rate, self.articulation_rad = (bend - self.articulation_rad) / TICK_S, bend
        turn = heading_rate_rad_s(self.carrier, self.speed_m_s, bend, rate) if self.speed_m_s else 0.0
        self._turn_rad_s = turn
        middle = self.yaw_rad + 0.5 * turn * TICK_S
        self.x_m += self.speed_m_s * math.cos(middle) * TICK_S
        self.y_m += self.speed_m_s * math.sin(middle) * TICK_S
        self.yaw_rad += turn * TICK_S
        self.driven_m += abs(self.speed_m_s) * TICK_S
        if d is not None:
            for i, wanted_m in enumerate(d.heights_m):
                change = min(max(wanted_m - self.heights_m[i], -RATE_M_S * TICK_S), RATE_M_S * TICK_S)
                self.heights_m[i] += change
        self._past.append((self.x_m, self.y_m, self.yaw_rad))

    def _rate(self, d: DriveSetpoint) -> float:
        most = self.carrier.articulation_rate_limit_rad_s
        if d.steering is Steering.ARTICULATION:
            wanted = d.articulation_rate_rad_s + 4.0 * (d.articulation_rad - self.articulation_rad)
        else:
            x, y, _ = self.plane.local(d.latitude_deg, d.longitude_deg)
            error = math.remainder(math.atan2(y - self.y_m, x - self.x_m) - self.yaw_rad, 2.0 * math.pi)
            wanted = self.carrier.heading_kp_1_s * error
        return min(max(wanted, -most), most)
