"""The request of a drive to the machine at one moment."""

from __future__ import annotations

from dataclasses import dataclass

from can_dbc.messages.vehicle import Steering


@dataclass(frozen=True, slots=True)
class DriveRequest:
    """Steering as in ``DriveSetpoint`` and a speed [m/s].  ``arrived``: the drive is complete.  ``stop_reason``: why
    the machine must stop, empty otherwise.
    """

    steering: Steering = Steering.ARTICULATION
    latitude_deg: float = 0.0
    longitude_deg: float = 0.0
    articulation_rad: float = 0.0
    articulation_rate_rad_s: float = 0.0
    speed_m_s: float = 0.0
    arrived: bool = False
    stop_reason: str = ""
