"""Location from the controller's vehicle reports: dead reckoning, gates, loss and recovery.

``Localizer.step(report)`` accepts every ``VehicleReport`` and returns a ``Location`` at its stamp.  It holds no clock.
Positions and headings are used at their time of validity (``LATENCY_NS`` before their reception).  Without a matching
position and heading, the machine is located by its wheels for ``RECKONING_NS``; then it is lost, with a reason.  It
recovers after ``AGREEING_COUNT`` consecutive positions that match, or that agree with each other on another place;
headings likewise, at standstill only.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Final

import numpy as np

from autonomy.localization.local_plane import LocalPlane, wrapped, yaw_from_heading
from autonomy.localization.location import Location, Status
from autonomy.localization.vehicle_filter import (
    NoiseModel,
    Odometry,
    State,
    VehicleFilter,
    antenna_reach,
    drift_rad,
    front_attitude,
)
from can_dbc.messages.vehicle import VehicleReport
from machine.profile import Carrier

LATENCY_NS: Final = 75_000_000
"""From a measurement of the receiver to its reception: 50 to 100 ms (docs/reference/machines.md section 8, assumed)."""
TURN_OVER_NS: Final = 50_000_000
"""Averaging time of the receiver's rate of turn (assumed)."""
FRESH_NS: Final = 500_000_000
"""Greatest age of a position: five of its periods."""
RECKONING_NS: Final = 2_000_000_000
MOTION_NS: Final = 300_000_000
"""Greatest age of speed and articulation; until then the last values hold."""
CREEP_M_PER_M: Final = 0.8
"""A braked wheel turns with its swing arm and moves the machine without being measured: metres per metre of height
(measured on the plant: 0.14 m for 0.35 m).
"""
CREEP_RAD_PER_M: Final = 0.3
"""On uneven ground the wheels of one side creep farther than those of the other and turn the machine: 0.4 m for a metre
of height on one side only, over a track of 2.1 m, are 0.2 rad, and more where it slides.
"""
AGREEING_COUNT: Final = 5
AGREE_SIGMAS: Final = 4.0
MAX_TURN_RAD: Final = 0.5
"""Greatest turn caused by an external force, such as running into a log; a heading that is farther off is a fault."""
STANDSTILL_M_S: Final = 0.05
MAX_GAP_NS: Final = 1_000_000_000
"""After a longer gap between reports the motion meanwhile is unknown."""
INITIAL_SIGMA_M: Final = 3.0
SECOND_NS: Final = 1e9


class Localizer:
    """Locates one machine.  ``plane`` None: the first position becomes its origin.

    ``rejected`` counts measurements outside their gates.
    """

    def __init__(self, carrier: Carrier, plane: LocalPlane | None = None, noise: NoiseModel | None = None) -> None:
        self.plane = plane
        self.rejected = 0
        self._carrier, self._noise = carrier, noise or NoiseModel()
        self._filter = VehicleFilter(carrier, self._noise)
        self._status = Status.STARTING
        self._last: VehicleReport | None = None
        self._position_ns = self._heading_ns = 0
        self._fitting = 0
        self._strays: list[np.ndarray] = []
        self._turned: list[float] = []
        """Innovations of the last headings outside the gate."""
        self._jumps = 0
        self._z = (math.nan, math.inf)

    def step(self, report: VehicleReport) -> Location:
        """Compute the location at ``report.stamp_ns``."""
        last = self._last
        if last is not None and report.stamp_ns <= last.stamp_ns:
            return self._location(last)
        if last is not None and not _finite(report.speed_m_s, report.articulation_rad):
            report = replace(report, speed_m_s=last.speed_m_s, articulation_rad=last.articulation_rad)
            if report.motion_ns > last.motion_ns:
                report = replace(report, motion_ns=last.motion_ns)
        self._last = report
        moving = report.stamp_ns - report.motion_ns <= MOTION_NS and _finite(report.speed_m_s, report.articulation_rad)
        if self._status is not Status.STARTING:
            gap = report.stamp_ns - last.stamp_ns if last else 0
            if not moving or gap > MAX_GAP_NS:
                self._status = Status.STARTING
            else:
                self._predict(report, last, gap)
        new = last is None or report.position_ns != last.position_ns
        if moving and new and _finite(report.latitude_deg, report.longitude_deg) and report.fix in self._noise.fixes:
            self._update_position(report)
        self._update_status(report, moving)
        return self._location(report)

    def _predict(self, report: VehicleReport, last: VehicleReport | None, gap: int) -> None:
        """Predict with wheels and articulation since the last report."""
        assert last is not None
        roll, pitch = self._front_roll_pitch(report)
        wheels = 0.5 * (report.speed_m_s + last.speed_m_s) * gap / SECOND_NS
        distance = wheels * math.cos(pitch)
        odometry = Odometry(gap / SECOND_NS, distance, last.articulation_rad, report.articulation_rad, roll)
        self._filter.predict_motion(odometry, report.stamp_ns)
        if changed := max(abs(now - valid_ns) for now, valid_ns in zip(report.heights_m, last.heights_m, strict=True)):
            changed = changed if math.isfinite(changed) else 0.0
            self._filter.add_creep(CREEP_M_PER_M * changed, CREEP_RAD_PER_M * changed)
        z, spread = self._z
        self._z = z + wheels * math.sin(pitch), math.hypot(spread, 0.02 * math.sqrt(abs(wheels)))
        if report.heading_ns != last.heading_ns and math.isfinite(report.heading_rad):
            valid_ns = report.heading_ns - LATENCY_NS
            if self._filter.heading(yaw_from_heading(report.heading_rad), valid_ns):
                self._heading_ns = report.heading_ns
                self._turned.clear()
            else:
                self.rejected += 1
                self._recover_heading(report, valid_ns)
            if math.isfinite(report.yaw_rate_rad_s):
                self._filter.turn(report.yaw_rate_rad_s, report.speed_m_s, TURN_OVER_NS, valid_ns)

    def _update_position(self, report: VehicleReport) -> None:
        """Update with a new position."""
        if self.plane is None:
            altitude = report.altitude_m if math.isfinite(report.altitude_m) else 0.0
            self.plane = LocalPlane(report.latitude_deg, report.longitude_deg, altitude)
        east, north, _ = self.plane.local(report.latitude_deg, report.longitude_deg)
        roll, pitch = self._front_roll_pitch(report)
        reach = antenna_reach(self._carrier, roll, pitch, self._front_height(report))
        valid_ns = report.position_ns - LATENCY_NS
        if self._status is Status.STARTING and self._fitting == 0:
            if not math.isfinite(report.heading_rad) or report.stamp_ns - report.heading_ns > FRESH_NS:
                return
            yaw = yaw_from_heading(report.heading_rad)
            c, s = math.cos(yaw), math.sin(yaw)
            x, y = east - c * reach[0] + s * reach[1], north - s * reach[0] - c * reach[1]
            self._filter.initialize(x, y, yaw, report.fix, INITIAL_SIGMA_M, report.stamp_ns)
            self._heading_ns = report.heading_ns
            self._z = math.nan, math.inf
        fits = self._filter.position(east, north, reach, report.fix, report.sigma_m, valid_ns)
        self._height(report, reach[2])
        if fits:
            self._position_ns = report.position_ns
            self._fitting += 1
            self._strays.clear()
            return
        self.rejected += 1
        self._fitting = 0
        if self._status is Status.LOST:
            self._strays.append(np.array([east, north]) - self._filter.predicted_position(reach, valid_ns))
            self._recover_position(report)

    def _recover_position(self, report: VehicleReport) -> None:
        """Re-initialize the position when the last ones agree on another place."""
        del self._strays[:-AGREEING_COUNT]
        sigma = self._noise.fixes[report.fix][0]
        middle = np.mean(self._strays, axis=0)
        apart = max(math.dist(offset, middle) for offset in self._strays)
        if len(self._strays) < AGREEING_COUNT or apart > AGREE_SIGMAS * sigma:
            return
        at = self._filter.x[[State.X, State.Y]] + middle
        self._filter.reset_position(float(at[0]), float(at[1]), sigma + self._noise.fixes[report.fix][1])
        self._position_ns, self._fitting = report.position_ns, AGREEING_COUNT
        self._jumps += 1
        self._strays.clear()

    def _recover_heading(self, report: VehicleReport, valid_ns: int) -> None:
        """Re-initialize the heading of a standing machine when the last ones agree on another one."""
        if self._status is not Status.LOST or abs(report.speed_m_s) > STANDSTILL_M_S:
            self._turned.clear()
            return
        self._turned.append(self._filter.heading_off(yaw_from_heading(report.heading_rad), valid_ns))
        del self._turned[:-AGREEING_COUNT]
        turn = sum(self._turned) / len(self._turned)
        apart = max(abs(t - turn) for t in self._turned)
        agree = len(self._turned) == AGREEING_COUNT and apart <= AGREE_SIGMAS * self._filter.heading_sigma_rad
        if agree and abs(turn) <= MAX_TURN_RAD:
            roll, pitch = self._front_roll_pitch(report)
            reach = antenna_reach(self._carrier, roll, pitch, self._front_height(report))
            self._filter.reset_yaw(turn, math.hypot(reach[0], reach[1]))
            self._heading_ns = report.heading_ns
            self._jumps += 1
            self._turned.clear()

    def _height(self, report: VehicleReport, reach_m: float) -> None:
        """Estimate the height of the axle: the receiver's altitudes, smoothed by their scatter."""
        assert self.plane is not None
        if not math.isfinite(report.altitude_m):
            return
        seen, spread = report.altitude_m - self.plane.altitude_m - reach_m, 2.0 * self._noise.fixes[report.fix][0]
        z, sigma = self._z
        gain = 1.0 if not math.isfinite(z) else sigma**2 / (sigma**2 + spread**2)
        self._z = (
            (seen if not math.isfinite(z) else z + gain * (seen - z)),
            (spread if not math.isfinite(sigma) else sigma * math.sqrt(1.0 - gain)),
        )

    def _update_status(self, report: VehicleReport, moving: bool) -> None:
        """Update the status from the ages of the last accepted measurements."""
        if self._status is Status.STARTING or not moving:
            self._status = Status.TRACKING if moving and self._fitting >= AGREEING_COUNT else Status.STARTING
            if not moving:
                self._fitting = 0
            return
        age = report.stamp_ns - min(self._position_ns, self._heading_ns)
        if self._status is Status.LOST:
            if age <= FRESH_NS and self._fitting >= AGREEING_COUNT:
                self._status = Status.TRACKING
        elif age > RECKONING_NS:
            self._status, self._fitting = Status.LOST, 0
        else:
            self._status = Status.TRACKING if age <= FRESH_NS else Status.DEAD_RECKONING

    def _reason(self, report: VehicleReport) -> str:
        """Tell why the machine is not tracked."""
        if self._status is Status.TRACKING:
            return ""
        stamp = report.stamp_ns
        if stamp - report.motion_ns > MOTION_NS or not _finite(report.speed_m_s, report.articulation_rad):
            return "speed and articulation are not known"
        for quantity, seen, fitted, value in (
            ("position", report.position_ns, self._position_ns, report.latitude_deg),
            ("heading", report.heading_ns, self._heading_ns, report.heading_rad),
        ):
            if not seen or not math.isfinite(value) or stamp - seen > FRESH_NS:
                return f"no {quantity} from the receiver"
            if quantity == "position" and report.fix not in self._noise.fixes:
                return "the receiver has no fix"
            if self._status is not Status.STARTING and stamp - fitted > FRESH_NS:
                return f"the receiver's {quantity} does not match the wheels"
        return "not enough matching positions yet"

    def _location(self, report: VehicleReport) -> Location:
        reason = self._reason(report)
        if self._status is Status.STARTING:
            return Location(report.stamp_ns, self._status, reason, jumps=self._jumps)
        x, p = self._filter.x, self._filter.P
        roll, pitch = (v if math.isfinite(v) else 0.0 for v in (report.roll_rad, report.pitch_rad))
        seen = [State.X, State.Y, State.YAW]
        yaw = wrapped(float(x[State.YAW]))
        return Location(
            report.stamp_ns,
            self._status,
            reason,
            float(x[State.X]),
            float(x[State.Y]),
            self._z[0],
            yaw,
            p[np.ix_(seen, seen)],
            self._z[1],
            wrapped(yaw + drift_rad(x, self._front_roll_pitch(report)[0])),
            report.speed_m_s * (1.0 + float(x[State.SCALE])),
            float(x[State.CURVE]),
            report.articulation_rad,
            roll,
            pitch,
            self._front_height(report),
            self._jumps,
        )

    def _front_roll_pitch(self, report: VehicleReport) -> tuple[float, float]:
        """Return roll and pitch of the front half; level while unknown."""
        if not _finite(report.roll_rad, report.pitch_rad):
            return 0.0, 0.0
        return front_attitude(report.roll_rad, report.pitch_rad, report.articulation_rad)

    def _front_height(self, report: VehicleReport) -> float:
        height = 0.5 * (report.heights_m[0] + report.heights_m[1])
        return height if math.isfinite(height) else self._carrier.arm_transport_m


def _finite(*values: float) -> bool:
    return all(map(math.isfinite, values))
