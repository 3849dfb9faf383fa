"""The GNSS receiver (source address 1Ch): two antennas, RTK, NMEA 2000 with fast packets.

Every 50 ms it measures (its epoch); the messages due then are sent 50 to 100 ms later.  Position is that of the true
main antenna, heading the azimuth from main to auxiliary antenna minus its azimuth in the profile's front frame.
Velocity and rate of turn are means over the last epoch.  UTC is a fixed epoch plus virtual time, so equal runs give
equal bytes.
"""

from __future__ import annotations

import math
import random
from collections import deque
from collections.abc import Callable
from enum import IntEnum
from typing import Any, Final

from can_dbc.dbc.codec import Database
from can_dbc.protocols.nmea2000 import encode, frames
from machine.profile import Carrier
from sim.geometry import LocalFrame, Quaternion, Vector, quaternion_rpy
from sim.nodes import Outbox
from sim.nodes.mach0 import MARINE, J1939Node
from sim.nodes.messages import MS, PeriodicTimer
from sim.truth.sensors import GnssTruth

ADDRESS: Final = 0x1C
NAVIGATION_CLASS, POSITION_FUNCTION = 60, 145  # NMEA 2000 device class and function
EPOCH_DAY: Final = 20_605  # 2026-06-01, days since 1970
EPOCH_S: Final = 8 * 3600.0
DAY_S: Final = 86_400.0
CYCLE_NS: Final = 50 * MS
FAST_CYCLES, COURSE_CYCLES, SLOW_CYCLES = 2, 5, 20  # cycles between the messages of 100 ms, 250 ms and 1 s
TURN_RAD: Final = 2.0 * math.pi
GPS_GLONASS: Final = 2
NO_SOLUTION_SATELLITES: Final = 2


class Fix(IntEnum):
    """Quality of the position, numbered as GnssPositionData.Method."""

    NONE = 0
    SINGLE = 1
    DGNSS = 2
    RTK_FIXED = 4
    RTK_FLOAT = 5


class GnssNode(J1939Node):
    """``front_pose`` gives the true pose of link ``front`` in the world.

    Faults: ``set_fix``; ``silent`` (no frame at all); ``heading_lost`` (not available); ``heading_frozen``;
    ``heading_error_rad`` (math.pi: antennas swapped); ``jump_m`` (east, north).
    """

    def __init__(
        self,
        machine: Database,
        gnss: Database,
        outbox: Outbox,
        carrier: Carrier,
        truth: GnssTruth,
        seed: int,
        front_pose: Callable[[], tuple[Vector, Quaternion]],
    ) -> None:
        super().__init__(ADDRESS, POSITION_FUNCTION, machine, outbox, industry=MARINE, system=NAVIGATION_CLASS)
        self._truth, self._front_pose = truth, front_pose
        self._rng = random.Random(f"gnss {seed}")
        self._messages = gnss
        self._local_frame = LocalFrame(carrier.site_lat_deg, carrier.site_lon_deg, truth.datum_m)
        self._main = _sum(carrier.antenna_main_m, truth.main_offset_m)
        self._aux = _sum(carrier.antenna_aux_m, truth.aux_offset_m)
        nominal = _difference(carrier.antenna_aux_m, carrier.antenna_main_m)
        self._baseline_rad = math.atan2(nominal[1], nominal[0])
        self._heading_noise_rad = math.sqrt(2.0) * truth.phase_noise_m / math.hypot(*nominal)
        self._cycle = PeriodicTimer(CYCLE_NS)
        self._epochs = 0
        self._sequence = 0
        self._pending: deque[tuple[int, list[tuple[int, bytes]]]] = deque()
        self._keep = math.exp(-CYCLE_NS * 1e-9 / truth.wander_s)
        self._wander = [self._rng.gauss(0.0, 1.0) for _ in range(3)]
        self._last: tuple[Vector, float] | None = None
        self._heading: float | None = None
        self.fix = Fix.RTK_FIXED
        self.silent = self.heading_lost = self.heading_frozen = False
        self.heading_error_rad = 0.0
        self.jump_m = (0.0, 0.0)

    def set_fix(self, fix: Fix) -> None:
        """Set the quality that sky and corrections allow; NONE: no position, velocity or heading."""
        self.fix = fix

    def cycle(self, now_ns: int) -> None:
        if self._cycle.due(now_ns):
            self._measure(now_ns)
        while self._pending and now_ns >= self._pending[0][0]:
            sent = self._pending.popleft()[1]
            if not self.silent:
                self.outbox += sent

    def _measure(self, now_ns: int) -> None:
        """Measure the antennas for one epoch, and queue the messages that are due."""
        gauss, t = self._rng.gauss, self._truth
        position_m, orientation = self._front_pose()
        main, aux = (
            _sum(position_m, _turned(orientation, self._main)),
            _sum(position_m, _turned(orientation, self._aux)),
        )
        azimuth = math.atan2(aux[1] - main[1], aux[0] - main[0]) - self._baseline_rad
        last, self._last = self._last or (main, azimuth), (main, azimuth)
        driven = math.sqrt(1.0 - self._keep * self._keep)
        self._wander = [self._keep * w + driven * gauss(0.0, 1.0) for w in self._wander]
        self._epochs += 1
        due = self._epochs
        if not (due % FAST_CYCLES == 0 or due % COURSE_CYCLES == 0):
            return
        heading = None
        if self.fix and not self.heading_lost:
            heading = (math.pi / 2 - azimuth + gauss(0.0, self._heading_noise_rad) + self.heading_error_rad) % TURN_RAD
            if self.heading_frozen and self._heading is not None:
                heading = self._heading
            self._heading = heading
        out: list[tuple[int, bytes]] = []
        stamp = {"SID": due % 253}
        if due % FAST_CYCLES == 0:
            lat, lon, height = self._position(main)
            self._put(out, "PositionRapidUpdate", Latitude=lat, Longitude=lon)
            self._put(out, "VesselHeading", Heading=heading, Reference=0, **stamp)
            rate = -_wrapped(azimuth - last[1]) / (CYCLE_NS * 1e-9) + gauss(0.0, t.rate_noise_rad_s)
            self._put(out, "RateOfTurn", Rate=rate, **stamp)
            roll, pitch, _ = quaternion_rpy(orientation)
            noise = t.attitude_noise_rad
            yaw = None if heading is None else _wrapped(heading)
            attitude = {"Yaw": yaw, "Pitch": gauss(-pitch, noise), "Roll": gauss(roll, noise)}
            self._put(out, "Attitude", **attitude, **stamp)
            if due % SLOW_CYCLES == 0:
                self._put_slow(out, now_ns, lat, lon, height, stamp)
        if due % COURSE_CYCLES == 0:
            east, north = ((now - then) / (CYCLE_NS * 1e-9) for now, then in zip(main[:2], last[0][:2], strict=True))
            east, north = gauss(east, t.speed_noise_m_s), gauss(north, t.speed_noise_m_s)
            motion: dict[str, Any] = {"Cog": math.atan2(east, north) % TURN_RAD, "Sog": math.hypot(east, north)}
            self._put(out, "CogSogRapidUpdate", CogReference=0, **stamp, **(motion if self.fix else {}))
        self._pending.append((now_ns + round(self._rng.uniform(*t.latency_s) * 1e9), out))

    def _position(self, antenna: Vector) -> tuple[float, float, float] | tuple[None, None, None]:
        """Measure latitude, longitude and height; draw the same random numbers for every fix."""
        noise = [self._rng.gauss(0.0, 1.0) for _ in range(3)]
        if not self.fix:
            return None, None, None
        quality = self._truth.fixes[self.fix.name.lower()]
        axis = math.sqrt(0.5)  # a horizontal error has two axes
        error = [axis * (quality.noise_m * n + quality.wander_m * w) for n, w in zip(noise, self._wander, strict=True)]
        east, north, up = antenna
        return self._local_frame.geodetic(
            east + error[0] + self.jump_m[0],
            north + error[1] + self.jump_m[1],
            up + error[2] / axis * self._truth.height_factor,
        )

    def _put_slow(
        self, out: list[tuple[int, bytes]], now_ns: int, lat: Any, lon: Any, height: Any, stamp: dict[str, int]
    ) -> None:
        days, seconds = divmod(EPOCH_S + now_ns * 1e-9, DAY_S)
        utc = {"Date": EPOCH_DAY + int(days), "Time": seconds}
        self._put(out, "SystemTime", Source=0, **utc, **stamp)
        fields: dict[str, Any] = {"NumberOfSvs": NO_SOLUTION_SATELLITES, "Integrity": 2}
        if self.fix:
            quality = self._truth.fixes[self.fix.name.lower()]
            fields = {"NumberOfSvs": quality.satellites, "Hdop": quality.hdop, "Pdop": 1.6 * quality.hdop}
            fields["Integrity"] = 1 if self.fix is Fix.RTK_FIXED else 2
        position_fields = {
            "Latitude": lat,
            "Longitude": lon,
            "Altitude": height,
            "GeoidalSeparation": self._truth.geoid_m,
        }
        kind = {"GnssType": GPS_GLONASS, "Method": int(self.fix), "ReferenceStations": 0}
        self._put(out, "GnssPositionData", **utc, **position_fields, **kind, **fields, **stamp)

    def _put(self, out: list[tuple[int, bytes]], message: str, **fields: Any) -> None:
        codec = self._messages.message(message)
        out += frames(codec, encode(codec, **fields), ADDRESS, self._sequence)
        self._sequence = (self._sequence + (codec.length > 8)) & 7


def _sum(a: Vector, b: Vector) -> Vector:
    return (a[0] + b[0], a[1] + b[1], a[2] + b[2])


def _difference(a: Vector, b: Vector) -> Vector:
    return (a[0] - b[0], a[1] - b[1], a[2] - b[2])


def _wrapped(angle: float) -> float:
    return (angle + math.pi) % TURN_RAD - math.pi


def _turned(q: Quaternion, v: Vector) -> Vector:
    """Turn ``v`` by the unit quaternion (x, y, z, w)."""
    x, y, z, w = q
    tx, ty, tz = 2 * (y * v[2] - z * v[1]), 2 * (z * v[0] - x * v[2]), 2 * (x * v[1] - y * v[0])
    return (
        v[0] + w * tx + y * tz - z * ty,
        v[1] + w * ty + z * tx - x * tz,
        v[2] + w * tz + x * ty - y * tx,
    )
