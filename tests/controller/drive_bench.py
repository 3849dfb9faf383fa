"""Test bench with a driving carrier: rigid geometry behind VehCmd and ArmCmd, and a GNSS receiver on the front half."""

from __future__ import annotations

import math
from collections import deque
from typing import Any

from can_dbc.messages.datagrams import encode
from can_dbc.messages.vehicle import DriveSetpoint, Driving, Steering, VehicleReport
from machine.geometry.carrier import heading_rate_rad_s
from machine.profile import Carrier
from machine.status.modes import Mode
from sim.geometry import LocalFrame
from tests.controller.bench import AORO, MS, Bench, T

CARRIER = AORO.profile.carrier
assert isinstance(CARRIER, Carrier)
ARM_NAMES = ("Arm1", "Arm2", "Arm3", "Arm4")
LATENCY_NS = 70 * MS
TRANSPORT = (CARRIER.arm_transport_m,) * 4


class DriveBench(Bench):
    """Adds a moving carrier.  ``east_m``, ``north_m`` and ``yaw_rad`` are of the front axle; values in ``lies`` are
    sent in place of the true ones.
    """

    def __init__(self) -> None:
        super().__init__(AORO)
        self.east_m = self.north_m = self.yaw_rad = self.speed_m_s = self.bend_rad = self.bend_rate = 0.0
        self.roll_rad = self.pitch_rad = 0.0
        self.heights_m = list(TRANSPORT)
        self.lies: dict[str, dict[str, float | None]] = {}
        self.site = LocalFrame(CARRIER.site_lat_deg, CARRIER.site_lon_deg, 260.0)
        self.drive_sequence = 0
        self.slip = 1.0
        self.blocked = False
        self.steering_gain, self.steering_drift = 1.0, 0.0
        self._rates = deque([0.0] * (round(CARRIER.steer_valve.delay_s * 1e9) // T))
        self._spools = deque([(0.0,) * 4] * (round(CARRIER.arm_valve.delay_s * 1e9) // T))
        self._epochs: deque[tuple[int, dict[str, dict[str, Any]]]] = deque()
        self._update_nodes()

    def tick(self, datagrams=(), **measured):
        self._move()
        self._update_nodes()
        return super().tick(datagrams, **measured)

    def _move(self) -> None:
        dt, c = T * 1e-9, CARRIER
        command = self.machine_commands.get("VehCmd", {"ArmKey": 0, "ArticRate": 0.0, "Speed": 0.0, "Brake": 100.0})
        arms = self.machine_commands.get("ArmCmdA", {"ArmKey": 0} | dict.fromkeys(ARM_NAMES, 0.0))
        moving = command["ArmKey"] == 0xA
        wanted = 0.0 if not moving or command["Brake"] > 0.0 or self.blocked else command["Speed"]
        change = (5.0 if wanted == 0.0 else 1.0) * dt
        self.speed_m_s += max(-change, min(change, wanted - self.speed_m_s))
        self._rates.append(command["ArticRate"] * self.steering_gain + self.steering_drift if moving else 0.0)
        self.bend_rate += dt / 0.1 * (self._rates.popleft() - self.bend_rate)
        self.bend_rad += self.bend_rate * dt
        self.yaw_rad += heading_rate_rad_s(c, self.speed_m_s, self.bend_rad, self.bend_rate) * self.slip * dt
        self.east_m += self.speed_m_s * math.cos(self.yaw_rad) * dt
        self.north_m += self.speed_m_s * math.sin(self.yaw_rad) * dt
        self._spools.append(tuple(arms[n] for n in ARM_NAMES) if arms["ArmKey"] == 0xA else (0.0,) * 4)
        for i, spool in enumerate(self._spools.popleft()):
            plus, valve = spool > 0.0, c.arm_valve
            dead = valve.deadband_plus_pct if plus else valve.deadband_minus_pct
            full = valve.full_speed_plus if plus else -valve.full_speed_minus
            self.heights_m[i] += full * max(0.0, abs(spool) - dead) / (100.0 - dead) * dt

    def _update_nodes(self) -> None:
        """Update the values that the nodes send."""
        self.articulation_rad = self.bend_rad
        middle = CARRIER.arm_travel_m / 2
        # The epoch is measured now and sent 70 ms later.
        if self.count % 20 == 0:
            ahead = CARRIER.antenna_main_m[0] - CARRIER.front_axle_m
            up = -CARRIER.antenna_main_m[2] - CARRIER.arm_drop_low_m - self.heights_m[0]
            ahead += up * math.sin(self.pitch_rad)
            left = up * math.sin(self.roll_rad)
            cos, sin = math.cos(self.yaw_rad), math.sin(self.yaw_rad)
            east, north = self.east_m + cos * ahead - sin * left, self.north_m + sin * ahead + cos * left
            latitude, longitude, _ = self.site.geodetic(east, north, 0.0)
            rate = heading_rate_rad_s(CARRIER, self.speed_m_s, self.bend_rad, self.bend_rate) * self.slip
            cog = {"Cog": (math.pi / 2 - self.yaw_rad) % math.tau, "Sog": abs(self.speed_m_s)}
            epoch = {
                "PositionRapidUpdate": {"Latitude": latitude, "Longitude": longitude},
                "VesselHeading": {"Heading": (math.pi / 2 - self.yaw_rad) % math.tau},
                "RateOfTurn": {"Rate": -rate},
                "CogSogRapidUpdate": cog,
            }
            self._epochs.append((self.now_ns + LATENCY_NS, epoch))
        while self._epochs and self._epochs[0][0] <= self.now_ns:
            self.changed.update(self._epochs.popleft()[1])
        self.changed["VehStat"] = {"Speed": self.speed_m_s, "Articulation": self.bend_rad}
        self.changed["ArmHeightA"] = {n: 1e3 * (h - middle) for n, h in zip(ARM_NAMES, self.heights_m, strict=True)}
        self.changed["ArmHeightB"] = {"Roll": math.degrees(self.roll_rad), "Pitch": math.degrees(self.pitch_rad)}
        self.changed["GnssPositionData"] = {"Method": 4, "NumberOfSvs": 19, "Hdop": 0.7, "Altitude": 260.0}
        for name, values in self.lies.items():
            self.changed[name] = self.changed.get(name, {}) | values

    # -- messages of the planner

    def to(self, east_m: float, north_m: float, speed_m_s: float = 0.6, **fields) -> bytes:
        """A drive setpoint to a waypoint."""
        latitude, longitude, _ = self.site.geodetic(east_m, north_m, 0.0)
        return self.drive_setpoint(latitude_deg=latitude, longitude_deg=longitude, speed_m_s=speed_m_s, **fields)

    def bend(self, angle_rad: float, rate_rad_s: float = 0.0, speed_m_s: float = 0.6, **fields) -> bytes:
        """A drive setpoint to an angle of the articulation."""
        wanted = {"articulation_rad": angle_rad, "articulation_rate_rad_s": rate_rad_s, "speed_m_s": speed_m_s}
        return self.drive_setpoint(steering=Steering.ARTICULATION, **wanted, **fields)

    def drive_setpoint(self, lease_ms: int = 200, **fields) -> bytes:
        self.drive_sequence += 1
        values = {
            "sequence": self.drive_sequence,
            "profile_hash": self.settings.profile_hash,
            "stamp_ns": self.now_ns,
            "lease_ns": lease_ms * MS,
            "steering": Steering.WAYPOINT,
            "latitude_deg": CARRIER.site_lat_deg,
            "longitude_deg": CARRIER.site_lon_deg,
            "articulation_rad": 0.0,
            "articulation_rate_rad_s": 0.0,
            "speed_m_s": 0.0,
            "heights_m": TRANSPORT,
            "float_front": False,
            "float_rear": False,
        } | fields
        return encode(DriveSetpoint(**values))

    def go(self, ticks: int, *place: float, **fields) -> DriveBench:
        """Drive to a waypoint with a setpoint every 50 ms."""
        for k in range(ticks):
            self.tick([self.to(*(place or (50.0, 0.0)), **fields)] if k % 10 == 0 and self.operating else ())
        return self

    def under_way(self, ticks: int = 400, *place: float, **fields) -> DriveBench:
        """Arm and drive for a while."""
        self.armed()
        self.run(40)
        self.go(ticks, *place, **fields)
        assert self.mode is Mode.ACTIVE and self.vehicle.driving is Driving.DRIVING, self.vehicle.gate.refusal
        return self

    @property
    def operating(self) -> bool:
        return self.mode in (Mode.ARMED, Mode.ACTIVE)

    @property
    def vehicle(self):
        return self.controller.vehicle

    @property
    def drive_command(self) -> dict[str, Any]:
        return self.machine_commands["VehCmd"]

    @property
    def braked(self) -> bool:
        """Whether the last command stands with the brake on."""
        return self.drive_command["Brake"] == 100.0 and self.drive_command["Speed"] == 0.0

    @property
    def last_report(self) -> VehicleReport:
        return self.vehicle_reports[-1]
