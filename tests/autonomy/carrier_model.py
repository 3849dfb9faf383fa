"""A small carrier for design and tests: the articulated kinematics, slip, late and noisy sensors, the laws of the tick.

Three seconds of a drive cost a hundredth of a second.  It knows nothing of forces: slip is what ``Ground`` says.
The laws are the controller's own, at its rate; the reports are those it would send.
"""

from __future__ import annotations

import math
import random
from collections import deque
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from autonomy.localization.local_plane import LocalPlane
from autonomy.localization.location import Location, Status
from autonomy.localization.vehicle_filter import antenna_reach, front_attitude
from can_dbc.messages.vehicle import DriveSetpoint, Driving, Steering, VehicleReport
from controller.laws.drive import AngleLaw, DriveLaw, SteeringLimits, WaypointLaw, east_north_m
from machine.loading.profile_file import load_profile
from machine.profile import Carrier
from tests.console.vehicle_reports import VEHICLE

TICK_NS: Final = 5_000_000
TICK_S: Final = 0.005
REPORT_TICKS: Final = 10
FIX_TICKS: Final = 20
DEAD_TICKS: Final = 16
DRIVE_LAG_S: Final = 0.25
STEER_LAG_S: Final = 0.06
START_NS: Final = 1_000_000_000


def heading_from_yaw(yaw_rad: float) -> float:
    """Heading, clockwise from north 0..2 pi, of a yaw, counter-clockwise from east."""
    return (0.5 * math.pi - yaw_rad) % (2.0 * math.pi)


@dataclass(frozen=True, slots=True)
class Ground:
    """Slip of a kind of ground.  ``understeer``: share of the curvature that is lost; ``spin``: share of the wheels'
    way; ``drift_rad``: by how much the machine slides downhill on the slope, across its way; ``loose``: standard
    deviation of what all three do at random, as a share, over a few metres.  ``slope_rad`` rises to the north.
    """

    understeer: float = 0.02
    spin: float = 0.01
    drift_rad: float = 0.0
    loose: float = 0.3
    slope_rad: float = 0.0


FIRM: Final = Ground()
MUD: Final = Ground(0.12, 0.12, 0.0, 0.5)
SLOPE: Final = Ground(0.03, 0.03, 0.04, 0.3, math.radians(10.0))


@dataclass(frozen=True, slots=True)
class Individual:
    """What a machine has that its profile does not know; drawn by ``individual``."""

    main_off_m: tuple[float, float] = (0.0, 0.0)
    heading_off_rad: float = 0.0
    articulation_off_rad: float = 0.0
    deadband: float = 1.0
    """Of the steering valve, over the profile's."""
    gain: float = 1.0
    latency_s: tuple[float, float] = (0.05, 0.10)
    white_m: float = 0.008
    wander_m: float = 0.006
    fix: int = 4


def individual(seed: int) -> Individual:
    """A machine as the plant draws them (docs/reference/machines.md section 14)."""
    rng = random.Random(f"vehicle {seed}")

    def within(bound: float) -> float:
        return bound * max(-1.0, min(1.0, rng.gauss(0.0, 0.5)))

    return Individual(
        (within(0.03), within(0.03)),
        (within(0.03) - within(0.03)) / 1.8,
        within(0.005),
        1.0 + within(0.3),
        1.0 + within(0.1),
    )


class Vehicle:
    """The machine on its ground; ``step`` is one tick of 5 ms.  Lengths in m, angles counter-clockwise from east.

    ``x``, ``y``, ``yaw`` of the front axle, ``bend`` and ``speed`` are the truth.
    """

    def __init__(
        self,
        carrier: Carrier,
        pose: tuple[float, float, float] = (0.0, 0.0, 0.0),
        ground: Ground = FIRM,
        own: Individual | None = None,
        seed: int = 0,
        plane: LocalPlane | None = None,
    ) -> None:
        self.x, self.y, self.yaw = pose
        self.bend = self.speed = 0.0
        self.now_ns = START_NS
        self.plane = plane or LocalPlane(carrier.site_lat_deg, carrier.site_lon_deg, 260.0)
        self.sky = True
        """Whether the receiver sees satellites."""
        self.jump_m = (0.0, 0.0)
        self.frozen = False
        """The receiver repeats its last position and heading for ever."""
        self._c, self._ground, self._own = carrier, ground, own or Individual()
        self._rng = random.Random(f"drive {seed}")
        self._tick = 0
        self._waypoint, self._angle = WaypointLaw(carrier), AngleLaw(carrier, TICK_S)
        self._limits, self._drive = SteeringLimits(carrier), DriveLaw(carrier)
        self._setpoint: DriveSetpoint | None = None
        self._spools: deque[float] = deque([0.0] * DEAD_TICKS, maxlen=DEAD_TICKS)
        self._rate = 0.0
        self._random = [0.0, 0.0, 0.0]
        self._wander = [self._rng.gauss(0.0, 1.0) for _ in range(2)]
        self._sent: deque[tuple[int, tuple[float, float, float, float]]] = deque()
        self._shown = (0, math.nan, math.nan, math.nan, math.nan)
        self._before = (self.yaw, 0)

    def order(self, setpoint: DriveSetpoint | None) -> None:
        """What the planner wants from now on."""
        if setpoint is not None:
            self._setpoint = setpoint

    def step(self) -> VehicleReport | None:
        """One tick; a report every tenth."""
        self.now_ns += TICK_NS
        self._tick += 1
        self._control()
        self._move()
        self._receive()
        return self._report() if self._tick % REPORT_TICKS == 0 else None

    def _control(self) -> None:
        s, measured = self._setpoint, self._measured_bend()
        if s is None or self.now_ns > s.stamp_ns + s.lease_ns:
            self._drive.stop(self._wheel_speed(), TICK_S)
            self._waypoint.reset()
            self._angle.reset()
            wanted = feed = 0.0
        else:
            self._drive.step(s.speed_m_s, self._wheel_speed(), 1.0, TICK_S)
            feed = 0.0
            if s.steering is Steering.WAYPOINT:
                east, north = east_north_m(self._shown[1], self._shown[2], s.latitude_deg, s.longitude_deg)
                wanted = self._waypoint.step(east, north, 0.5 * math.pi - self._shown[3])
            else:
                feed = s.articulation_rate_rad_s
                goal = s.articulation_rad + feed * (self.now_ns - s.stamp_ns) * 1e-9
                wanted = self._angle.step(goal, feed, measured)
        if self._drive.brake:
            wanted = 0.0
        rate = self._limits.step(wanted, measured, TICK_S)
        self._angle.note_command(rate, feed, TICK_S)
        self._spools.append(rate)

    def _move(self) -> None:
        c, g, own = self._c, self._ground, self._own
        wanted = self._spools[0]
        valve = c.steer_valve
        dead = valve.deadband_plus_pct / 100.0
        share = abs(wanted) / valve.full_speed_plus
        spool = 0.0 if abs(wanted) < 5e-4 else dead + (1.0 - dead) * share
        flow = max(0.0, spool - own.deadband * dead) / (1.0 - own.deadband * dead)
        rate = math.copysign(own.gain * flow * valve.full_speed_plus, wanted)
        self._rate += TICK_S / (TICK_S + STEER_LAG_S) * (rate - self._rate)
        self.bend = max(-c.articulation_limit_rad, min(c.articulation_limit_rad, self.bend + self._rate * TICK_S))
        self.speed += TICK_S / (TICK_S + DRIVE_LAG_S) * (0.96 * self._drive.speed_m_s - self.speed)
        if self._drive.brake:
            self.speed = 0.0
        way = self.speed * TICK_S
        keep = math.exp(-abs(way) / 4.0)
        for k in range(3):
            self._random[k] = keep * self._random[k] + math.sqrt(1.0 - keep * keep) * self._rng.gauss(0.0, g.loose)
        understeer = g.understeer * (1.0 + self._random[0])
        self._spin = max(0.0, g.spin * (1.0 + self._random[1]))
        side = -g.drift_rad * math.cos(self.yaw) + 0.01 * self._random[2]
        turned = (way * math.sin(self.bend) + c.rear_axle_m * self._rate * TICK_S) / (
            c.front_axle_m * math.cos(self.bend) + c.rear_axle_m
        )
        turned *= 1.0 - understeer
        course = self.yaw + 0.5 * turned + side
        level = math.cos(self._lean()[1])
        self.x += way * level * math.cos(course)
        self.y += way * level * math.sin(course)
        self.yaw += turned

    def _lean(self) -> tuple[float, float]:
        """Roll and pitch of the rear half on the slope."""
        rear = self.yaw - self.bend
        rise = math.tan(self._ground.slope_rad)
        up = math.atan(rise * math.sin(rear))
        return math.atan(rise * math.cos(rear) * math.cos(up)), up

    def _wheel_speed(self) -> float:
        return self.speed / (1.0 - self._spin) if self._tick > 1 else 0.0

    def _measured_bend(self) -> float:
        return self.bend + self._own.articulation_off_rad + self._rng.gauss(0.0, 3.5e-4)

    def _receive(self) -> None:
        own, rng = self._own, self._rng
        if self._tick % FIX_TICKS == 0:
            keep = math.exp(-FIX_TICKS * TICK_S / 60.0)
            drive = math.sqrt(1.0 - keep * keep)
            self._wander = [keep * w + drive * rng.gauss(0.0, 1.0) for w in self._wander]
            roll, pitch = front_attitude(*self._lean(), self.bend)
            reach = antenna_reach(self._c, roll, pitch, self._c.arm_transport_m)
            ahead, left = reach[0] + own.main_off_m[0], reach[1] + own.main_off_m[1]
            c, s = math.cos(self.yaw), math.sin(self.yaw)
            axis = math.sqrt(0.5)
            east, north = (
                at + axis * (own.white_m * rng.gauss(0.0, 1.0) + own.wander_m * w) + jump
                for at, w, jump in zip(
                    (self.x + c * ahead - s * left, self.y + s * ahead + c * left),
                    self._wander,
                    self.jump_m,
                    strict=True,
                )
            )
            lat, lon, _ = self.plane.geodetic(east, north, 0.0)
            seconds = (self.now_ns - self._before[1]) * 1e-9
            rate = (self.yaw - self._before[0]) / seconds if self._before[1] else 0.0
            heading = heading_from_yaw(self.yaw) - own.heading_off_rad + rng.gauss(0.0, 0.0024)
            values = (round(lat, 7), round(lon, 7), heading, rate + rng.gauss(0.0, 0.002))
            late = round(rng.uniform(*own.latency_s) * 1e9)
            if self.sky:
                if self.frozen and self._shown[0]:
                    values = self._shown[1:]
                self._sent.append((self.now_ns + late, values))
        if self._tick % FIX_TICKS == FIX_TICKS // 2:
            self._before = (self.yaw, self.now_ns)
        while self._sent and self._sent[0][0] <= self.now_ns:
            self._shown = (self.now_ns, *self._sent.popleft()[1])

    def _report(self) -> VehicleReport:
        at, lat, lon, heading, rate = self._shown
        roll, pitch = self._lean()
        driving = Driving.STANDING
        s = self._setpoint
        if s is not None and self.now_ns <= s.stamp_ns + s.lease_ns:
            driving = Driving.DRIVING
        elif not self._drive.brake:
            driving = Driving.BRAKING
        return replace(
            VEHICLE,
            sequence=self._tick,
            profile_hash=0,
            stamp_ns=self.now_ns,
            drive_sequence=s.sequence if s else 0,
            driving=driving,
            position_ns=at,
            latitude_deg=lat,
            longitude_deg=lon,
            altitude_m=262.5,
            fix=self._own.fix,
            sigma_m=math.nan,
            heading_ns=at,
            heading_rad=heading % math.tau,
            yaw_rate_rad_s=rate,
            motion_ns=self.now_ns,
            speed_m_s=self._wheel_speed(),
            articulation_rad=self._measured_bend(),
            roll_rad=roll + self._rng.gauss(0.0, 0.001),
            pitch_rad=pitch + self._rng.gauss(0.0, 0.001),
            heights_m=(self._c.arm_transport_m,) * 4,
        )


CARRIER = load_profile("aoro_fc8").carrier
SQUARE = [(0.0, 0.0), (25.0, 0.0), (25.0, 20.0)]


def at(x_m: float, y_m: float, yaw_rad: float, **values: float) -> Location:
    """A machine that is tracked there, straight and level, at cruising speed."""
    base = {
        "course_rad": yaw_rad,
        "speed_m_s": 0.6,
        "articulation_rad": 0.0,
        "roll_rad": 0.0,
        "pitch_rad": 0.0,
        "covariance": np.eye(3) * 1e-4,
        "front_height_m": 0.35,
    }
    stamp = int(values.pop("stamp_ns", 10**9))
    return Location(stamp, Status.TRACKING, "", x_m, y_m, 0.0, yaw_rad, **(base | values))
