"""Executes a drive, path or waypoints, with a lease on every setpoint; pause, resume, stop with a reason.

``Navigator.step`` accepts a vehicle report and its location and returns the setpoint to send, or None.  A stopped drive
stays stopped until ``resume`` or another ``drive``.  Setpoints with zero speed are sent until the machine stands; then
the lease is allowed to expire.
"""

from __future__ import annotations

import math
from enum import IntEnum
from typing import Final

from autonomy.localization.location import Location
from autonomy.navigation.drive_request import DriveRequest
from autonomy.navigation.path_drive import PathDrive
from autonomy.navigation.waypoint_drive import WaypointDrive
from can_dbc.messages.vehicle import DriveSetpoint, Driving, VehicleReport
from machine.profile import Carrier

LEASE_NS: Final = 200_000_000
"""Four report periods."""
STANDSTILL_M_S: Final = 0.02
REST_NS: Final = 500_000_000
"""The brake is on after this time: on a slope the drive holds the machine until then."""
EXECUTION_TIMEOUT_NS: Final = 2_000_000_000
"""The drive stops when the controller does not execute its setpoints for this long."""
MOTION_TIMEOUT_NS: Final = 5_000_000_000
"""The drive stops when the wheels do not turn for this long."""
STUCK_M_S: Final = 0.02
Heights = tuple[float, float, float, float]


class Phase(IntEnum):
    """State of the navigator."""

    IDLE = 0
    DRIVING = 1
    PAUSED = 2
    STOPPED = 3
    """A problem ended the drive; ``reason`` says which."""
    ARRIVED = 4


class Navigator:
    """Drives one machine; ``phase`` and ``reason`` are its state."""

    def __init__(
        self,
        carrier: Carrier,
        profile_hash: int,
        heights_m: Heights | None = None,
        level: bool = False,
        lease_ns: int = LEASE_NS,
    ) -> None:
        self.phase = Phase.IDLE
        self.reason = ""
        self.is_standing = True
        """Whether standstill was requested and has held for ``REST_NS``."""
        self.heights_m = heights_m or (carrier.arm_transport_m,) * 4
        self.level = level
        self.holds_heights = False
        """Send setpoints at standstill, too, to set the heights."""
        self._profile_hash, self._limit_rad = profile_hash, carrier.articulation_limit_rad
        self._lease_ns = lease_ns
        self.active: PathDrive | WaypointDrive | None = None
        """The current or last drive."""
        self._sequence = 0
        self._requested_ns = self._obeyed_ns = self._moved_ns = self._rolled_ns = 0

    def drive(self, drive: PathDrive | WaypointDrive) -> None:
        """Start this drive; it replaces an active one."""
        self.active = drive
        self._begin()

    def pause(self) -> None:
        """Stop until ``resume``."""
        if self.phase is Phase.DRIVING:
            self.phase, self.reason = Phase.PAUSED, "paused"

    def resume(self) -> None:
        """Resume after a pause or a stop."""
        if self.phase in (Phase.PAUSED, Phase.STOPPED) and self.active is not None:
            self._begin()

    def stop(self, reason: str) -> None:
        """Stop with a reason until ``resume`` or another drive."""
        if self.phase is Phase.DRIVING or self.phase is Phase.PAUSED:
            self.phase, self.reason = Phase.STOPPED, reason

    def step(self, now_ns: int, report: VehicleReport, location: Location) -> DriveSetpoint | None:
        """Return the setpoint to send now, or None."""
        at_standstill = abs(report.speed_m_s) < STANDSTILL_M_S and report.driving != Driving.BRAKING
        self.is_standing = at_standstill and now_ns - self._rolled_ns >= REST_NS
        order = DriveRequest()
        if self.phase is Phase.DRIVING:
            order = self.active.step(report) if isinstance(self.active, WaypointDrive) else self.active.step(location)  # type: ignore[union-attr]
            self._supervise(now_ns, report, order)
        if self.phase is not Phase.DRIVING:
            if isinstance(self.active, PathDrive):
                self.active.reset(location)
            idle = (self.phase is Phase.IDLE or self.is_standing) and not self.holds_heights
            if idle or not math.isfinite(report.articulation_rad):
                return None
            order = DriveRequest(articulation_rad=report.articulation_rad)
        if not at_standstill or order.speed_m_s:
            self._rolled_ns = now_ns
        limit = self._limit_rad
        articulation = min(max(order.articulation_rad, -limit), limit)
        # As a beam axle: paper B opens it just before the machine moves and closes it while the crane works.
        floats = self.phase is Phase.DRIVING
        # Starts from the clock, so that the setpoints of a restarted planner are not taken for a replay.
        self._sequence = self._sequence + 1 if self._sequence else now_ns // 1_000_000 & 0xFFFF_FFFF
        return DriveSetpoint(
            self._sequence,
            self._profile_hash,
            now_ns,
            self._lease_ns,
            order.steering,
            order.latitude_deg,
            order.longitude_deg,
            articulation,
            order.articulation_rate_rad_s,
            order.speed_m_s,
            self.heights_m,
            floats,
            False,
            self.level,
        )

    def _begin(self) -> None:
        self.phase, self.reason = Phase.DRIVING, ""
        self._requested_ns = self._obeyed_ns = self._moved_ns = 0

    def _supervise(self, now_ns: int, report: VehicleReport, order: DriveRequest) -> None:
        """End the drive on arrival or on a problem."""
        if not self._requested_ns:
            self._requested_ns = self._obeyed_ns = self._moved_ns = now_ns
        if report.driving == Driving.DRIVING:
            self._obeyed_ns = now_ns
        if abs(report.speed_m_s) > STUCK_M_S or not order.speed_m_s or report.driving != Driving.DRIVING:
            self._moved_ns = now_ns
        if order.stop_reason:
            self.stop(order.stop_reason)
        elif order.arrived:
            if self.is_standing:
                self.phase = Phase.ARRIVED
        elif now_ns - self._obeyed_ns > EXECUTION_TIMEOUT_NS:
            self.stop(f"the controller does not execute drive setpoints; its last refusal is {report.refusal}")
        elif now_ns - self._moved_ns > MOTION_TIMEOUT_NS:
            self.stop("the wheels do not turn")
