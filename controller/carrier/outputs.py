"""What the controller says on mach0: drive and swing-arm commands every 20 ms, an alive sign every 100 ms.

Inputs: the carrier's command, mode and reason.  Outputs: ``(key, data)`` in send order, the address claim first.  A
machine that does not drive gets neutral commands without the arm key, so that silence always means a dead controller;
once another node has our address there is silence, and the carrier brakes by its own time-out.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from can_dbc.canopen import Wire
from can_dbc.codec import Database
from controller.carrier.address_claim import AddressClaim
from controller.outputs import ARM_KEY, Every, Message, safe_state
from machine.modes import Mode
from machine.reasons import Reason

COMMAND_NS: Final = 20_000_000
ALIVE_NS: Final = 100_000_000
N_ARMS: Final = 4


@dataclass(frozen=True, slots=True)
class CarrierCommand:
    """What the carrier is to do now; the default is to stand with the brake on and to hold its height.

    Articulation rate + bends left; arms front left, front right, rear left, rear right, + raises the frame.  A float
    valve connects the two arms of its axle; the arm controller refuses both at once.
    """

    moving: bool = False
    """Gives the arm key: without it the carrier brakes and the arms hold, whatever else is said."""
    articulation_rate_rad_s: float = 0.0
    speed_m_s: float = 0.0
    brake_pct: float = 100.0
    arm_spools_pct: tuple[float, ...] = (0.0,) * N_ARMS
    float_front: bool = False
    float_rear: bool = False


STANDING: Final = CarrierCommand()


class MachineWriter:
    """Builds the frames of a tick into a list that the caller owns."""

    __slots__ = ("_address", "_alive", "_alive_due", "_arms_a", "_arms_b", "_command_due", "_drive", "_moved")

    def __init__(self, database: Database, address: AddressClaim) -> None:
        names = ("VehCmd", "ArmCmdA", "ArmCmdB", "CtrlAlive")
        self._drive, self._arms_a, self._arms_b, self._alive = (Message(database.message(name)) for name in names)
        self._address = address
        self._moved = False
        self._command_due, self._alive_due = Every(COMMAND_NS, 10_000_000), Every(ALIVE_NS, 15_000_000)

    def write(
        self, command: CarrierCommand, mode: Mode, reason: Reason, half_speed: bool, now_ns: int, frames: list[Wire]
    ) -> None:
        """Appends what is due now; a command that ends the motion is due at once."""
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

    def commands(self, command: CarrierCommand, frames: list[Wire]) -> None:
        """Appends VehCmd, ArmCmdA and ArmCmdB."""
        key = ARM_KEY if command.moving else 0
        motion = (command.articulation_rate_rad_s, command.speed_m_s, command.brake_pct)
        frames.append(self._drive.carrying(key, *motion))
        frames.append(self._arms_a.carrying(key, *command.arm_spools_pct))
        frames.append(self._arms_b.carrying(key, command.float_front, command.float_rear))

    def alive(self, mode: Mode, reason: Reason, half_speed: bool) -> Wire:
        """CtrlAlive."""
        return self._alive.carrying(mode, safe_state(mode, reason, half_speed), reason)
