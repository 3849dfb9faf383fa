"""A planner that only drives: located by its own localizer, along one drive, with a lease on every setpoint."""

from __future__ import annotations

from autonomy.localization.local_plane import LocalPlane
from autonomy.localization.localizer import Localizer
from autonomy.localization.location import Location, Status
from autonomy.navigation.navigator import Navigator, Phase
from autonomy.navigation.path_drive import PathDrive
from autonomy.navigation.waypoint_drive import WaypointDrive
from autonomy.perception.log_list import LogObservation
from can_dbc.messages.crane import StateReport
from can_dbc.messages.datagrams import encode
from can_dbc.messages.vehicle import VehicleReport
from machine.profile import Carrier
from machine.status.modes import Mode

Drive = PathDrive | WaypointDrive


class CarrierDriver:
    """Waits until the machine is armed and located, and drives then; a subclass says where, and what it samples."""

    def __init__(self, carrier: Carrier, plane: LocalPlane, navigator: Navigator) -> None:
        self.carrier, self.navigator, self.localizer = carrier, navigator, Localizer(carrier, plane)
        self.drive: Drive | None = None
        self.location: Location | None = None
        self._fresh: VehicleReport | None = None
        self._armed = False

    @property
    def over(self) -> bool:
        """Whether the drive has ended."""
        return self.navigator.phase in (Phase.ARRIVED, Phase.STOPPED)

    def receive(self, report: VehicleReport) -> None:
        """Receive a report of the vehicle."""
        self._fresh = report

    def step(self, now_ns: int, report: StateReport | None, logs: tuple[LogObservation, ...] | None) -> bytes | None:
        """Return the setpoint to send now."""
        vehicle, self._fresh = self._fresh, None
        if report is not None:
            self._armed = report.mode in (Mode.ARMED, Mode.ACTIVE)
        if vehicle is None:
            return None
        self.location = location = self.localizer.step(vehicle)
        if self.drive is None and location.status is Status.TRACKING and self._armed:
            self.drive = self.begin_drive(location)
            if self.drive is not None:
                self.navigator.drive(self.drive)
        setpoint = self.navigator.step(now_ns, vehicle, location)
        self.sample(now_ns, location)
        return None if setpoint is None else encode(setpoint)

    def begin_drive(self, location: Location) -> Drive | None:
        """Return the drive from a location; None to stand."""
        return None

    def sample(self, now_ns: int, location: Location) -> None:
        """Take a sample after every report of the vehicle."""
