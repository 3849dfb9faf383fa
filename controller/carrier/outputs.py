"""Frames that the controller sends on mach0: drive and swing-arm commands every 20 ms, an alive sign every 100 ms.

Inputs: the carrier's command, mode and reason.  Outputs: ``(key, data)`` in send order, the address claim first.  While
the machine does not drive, the commands are neutral and without the arm key, so that silence always means a dead
controller.  After another node won the address nothing is sent, and the carrier brakes by its own time-out.
"""

from __future__ import annotations

from typing import Final

from can_dbc.dbc.codec import Database
from can_dbc.frame import RawFrame
from controller.bus_io import ARM_KEY, PeriodicTimer, ProtectedMessage, safe_state
from controller.carrier.address_claim import AddressClaim
from machine.geometry.carrier import ARMS
from machine.status.modes import Mode
from machine.status.reasons import Reason

COMMAND_NS: Final = 20_000_000
ALIVE_NS: Final = 100_000_000


class CarrierCommand:
    """The carrier's command; the default stands with the brake on and holds the heights.

    It is made in every tick while the carrier drives, and no dataclass, whose frozen fields take a call each.

    A positive articulation rate bends left; arms are front left, front right, rear left, rear right, and + raises the
    frame.  A float valve connects the two arms of its axle; the arm controller refuses both at once.
    """

    __slots__ = (
        "arm_spools_pct",
        "articulation_rate_rad_s",
        "brake_pct",
        "float_front",
        "float_rear",
        "moving",
        "speed_m_s",
    )

    def __init__(
        self,
        moving: bool = False,
        articulation_rate_rad_s: float = 0.0,
        speed_m_s: float = 0.0,
        brake_pct: float = 100.0,
        arm_spools_pct: tuple[float, ...] = (0.0,) * len(ARMS),
        float_front: bool = False,
        float_rear: bool = False,
    ) -> None:
        self.moving = moving
        """Sets the arm key: without it the carrier brakes and the arms hold, whatever the other values."""
        self.articulation_rate_rad_s, self.speed_m_s, self.brake_pct = articulation_rate_rad_s, speed_m_s, brake_pct
        self.arm_spools_pct = arm_spools_pct
        self.float_front, self.float_rear = float_front, float_rear


STANDING: Final = CarrierCommand()


class CarrierWriter:
    """Builds the frames of a tick in a list that the caller owns."""

    __slots__ = ("_address", "_alive", "_alive_due", "_arms_a", "_arms_b", "_command_due", "_drive", "_moved")

    def __init__(self, database: Database, address: AddressClaim) -> None:
        names = ("VehCmd", "ArmCmdA", "ArmCmdB", "CtrlAlive")
        messages = (ProtectedMessage(database.message(name)) for name in names)
        self._drive, self._arms_a, self._arms_b, self._alive = messages
        self._address = address
        self._moved = False
        self._command_due, self._alive_due = PeriodicTimer(COMMAND_NS, 10_000_000), PeriodicTimer(ALIVE_NS, 15_000_000)

    def encode(
        self, command: CarrierCommand, mode: Mode, reason: Reason, half_speed: bool, now_ns: int, frames: list[RawFrame]
    ) -> None:
        """Append the frames that are due; a command that ends a motion is due at once."""
        claim = self._address.frame()
        if claim is not None:
            frames.append(claim)
        if self._address.lost:
            return
        if self._command_due.due(now_ns) or (self._moved and not command.moving):
            self.commands(command, frames)
            self._moved = command.moving
        if self._alive_due.due(now_ns):
            frames.append(self.alive(mode, reason, half_speed))

    def commands(self, command: CarrierCommand, frames: list[RawFrame]) -> None:
        """Append VehCmd, ArmCmdA and ArmCmdB."""
        key = ARM_KEY if command.moving else 0
        frames.append(
            self._drive.frame_with(key, command.articulation_rate_rad_s, command.speed_m_s, command.brake_pct)
        )
        frames.append(self._arms_a.frame_with(key, *command.arm_spools_pct))
        frames.append(self._arms_b.frame_with(key, command.float_front, command.float_rear))

    def alive(self, mode: Mode, reason: Reason, half_speed: bool) -> RawFrame:
        """Encode CtrlAlive."""
        return self._alive.frame_with(mode, safe_state(mode, reason, half_speed), reason)
