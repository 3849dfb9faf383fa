"""mach0 of a machine with a carrier: its address, what is received, what is sent, and the health of the bus.

A machine on a fixed base has none.  Received are carrier, swing arms and engine (``machine.dbc``), the GNSS receiver
(``gnss.dbc``) and addresses; sent are drive and swing-arm commands every 20 ms, and an alive sign every 100 ms.
"""

from __future__ import annotations

from typing import Final

from can_dbc.dbc.codec import PDU2_MASK, Database, FrameRefused, load, pgn_key
from can_dbc.frame import EXTENDED, Frame, RawFrame
from can_dbc.messages.tick_record import BusReading
from can_dbc.protocols.nmea2000 import BROADCAST, Reassembler, encode, split_id
from can_dbc.protocols.nmea2000 import frames as frames_of
from controller.bus_io import ARM_KEY, BusMonitor, MessageState, PeriodicTimer, ProtectedMessage, age_out, safe_state
from machine.geometry.carrier import ARMS
from machine.status.modes import Mode
from machine.status.reasons import Reason
from machine.status.stale_inputs import CARRIER_BIT
from runtime.errors import ConfigError

ADDRESS: Final = 0x27
"""Management computer 1, in the list of preferred addresses."""
NULL_ADDRESS: Final = 254
CLAIM_PGN: Final = 60928
REQUEST_PGN: Final = 59904
FORMATS: Final = (REQUEST_PGN >> 8, CLAIM_PGN >> 8)
"""The byte of an identifier (bits 16 to 23) of frames about addresses."""
_NEEDED: Final = ("VehStat", "ArmHeightA", "ArmHeightB")
_ENGINE: Final = "EEC1"
_GNSS: Final = ("PositionRapidUpdate", "VesselHeading", "RateOfTurn", "CogSogRapidUpdate", "GnssPositionData")
_OWN_MESSAGES: Final = ("VehCmd", "ArmCmdA", "ArmCmdB", "CtrlAlive")
COMMAND_NS: Final = 20_000_000
ALIVE_NS: Final = 100_000_000
_NO_MANUFACTURER: Final = 2047
"""No code is assigned to this project."""
_MANAGEMENT_COMPUTER: Final = 30
_FORESTRY: Final = 2


class AddressClaim:
    """The controller's address on mach0 (J1939-81); `frame` returns the claim that is due.

    It is claimed by NAME before any other frame, and fixed, because the frames of `can_dbc/machine.dbc` carry it.  A
    claim of the same address by a NAME of higher priority (a smaller number, or the same) wins it: from then on only
    "cannot claim" is sent, from the null address, until a reset claims again.  Addresses below 128 need no waiting time
    after the claim (4.4.3.3).
    """

    __slots__ = ("_claim", "_due", "_name", "_request", "lost")

    def __init__(self, database: Database) -> None:
        self._claim, self._request = database.message("AddressClaim"), database.message("Request")
        self._name = encode(
            self._claim,
            IdentityNumber=1,
            ManufacturerCode=_NO_MANUFACTURER,
            EcuInstance=0,
            FunctionInstance=0,
            Function=_MANAGEMENT_COMPUTER,
            Reserved=0,
            VehicleSystem=0,
            VehicleSystemInstance=0,
            IndustryGroup=_FORESTRY,
            ArbitraryAddress=0,
        )
        self.restart()

    def restart(self) -> None:
        """Claim the address as at power-on."""
        self.lost = False
        """Another node has the address: nothing may be sent from it."""
        self._due = True

    def receive(self, frame: Frame) -> None:
        """Use a frame whose identifier has one of ``FORMATS``."""
        _, pgn, source, destination = split_id(frame.key)
        if pgn == REQUEST_PGN and len(frame.data) == self._request.length:
            requested_pgn = int.from_bytes(frame.data, "little")
            self._due |= requested_pgn == CLAIM_PGN and destination in (ADDRESS, BROADCAST)
        elif pgn == CLAIM_PGN and source == ADDRESS and len(frame.data) == self._claim.length:
            # The smaller NAME wins; two nodes of the same NAME cannot be distinguished, and both give up.
            theirs, ours = (int.from_bytes(name, "little") for name in (frame.data, self._name))
            self.lost |= theirs <= ours
            self._due = True

    def frame(self) -> RawFrame | None:
        """Return the claim when one is due: at most one per tick, however many requests came."""
        if not self._due:
            return None
        self._due = False
        return frames_of(self._claim, self._name, NULL_ADDRESS if self.lost else ADDRESS)[0]


class CarrierInputs:
    """All inputs from mach0, and what this tick brought.

    The machine's own frames are matched by identifier and carry an E2E header; the PGNs of J1939 and NMEA 2000 are
    matched whatever their priority and source address.  A position with its quality is a fast packet of 7 frames.
    Without the carrier's own frames the machine stops; the loss of engine or GNSS is only reported.
    """

    def __init__(self, machine: Database, gnss: Database) -> None:
        self.address = AddressClaim(machine)
        self.vehicle, self.arms_a, self.arms_b = needed = tuple(
            MessageState(machine.message(name), CARRIER_BIT, machine=True) for name in _NEEDED
        )
        helpful = [MessageState(machine.message(_ENGINE), CARRIER_BIT, watched=False, machine=True)]
        helpful += [MessageState(gnss.message(name), CARRIER_BIT, watched=False, machine=True) for name in _GNSS]
        self.engine, self.position, self.heading, self.rate_of_turn, self.course, self.fix = helpful
        self.needed = needed
        self._helpful = tuple(helpful)
        self.messages = (*needed, *helpful)
        self._by_key = {s.codec.key: s for s in self.messages if not s.codec.by_pgn}
        self._by_pgn = {pgn_key(s.codec.key): s for s in self.messages if s.codec.by_pgn}
        self._own = frozenset(machine.message(name).key for name in _OWN_MESSAGES)
        self._reassembler = Reassembler()
        self.stale_mask = age_out(self.messages, 0)
        self.foreign = False
        """Another node sent one of the controller's own frames in this tick."""
        self.heard_ns = 0
        """When the newest frame came, whatever it was."""
        self.unknown = self.count = 0

    def filters(self) -> list[int | tuple[int, int]]:
        """List the keys to receive, for the bus's filter, with masks where the source address does not matter."""
        by_pgn = [(key, PDU2_MASK) for key in self._by_pgn]
        addresses = [(EXTENDED | form << 16, EXTENDED | 0xFF << 16) for form in FORMATS]
        return [*self._by_key, *self._own, *by_pgn, *addresses]

    def forget(self) -> None:
        """Make all values unknown again, and the address must be claimed anew."""
        for state in self.messages:
            state.forget()
        self._reassembler = Reassembler()
        self.address.restart()

    def decode(self, frames: list[Frame], now_ns: int) -> None:
        """Decode the frames of a tick in bus order."""
        self.foreign = False
        for state in self.messages:
            state.fresh = False
        by_key, by_pgn = self._by_key, self._by_pgn
        for frame in frames:
            key = frame[1]
            message = by_key.get(key)
            if message is not None:
                message.receive(frame, now_ns)
                continue
            message = by_pgn.get(key & PDU2_MASK)
            if message is not None:
                if message.codec.length > 8:
                    self._receive_part(message, frame, now_ns)
                else:
                    message.receive(frame, now_ns)
            elif key in self._own:
                self.foreign = True
            elif key >> 16 & 0xFF in FORMATS:
                self.address.receive(frame)
            else:
                self.unknown += 1
        self.count += len(frames)
        if frames:
            self.heard_ns = min(frames[-1][0], now_ns)
        self.stale_mask = age_out(self.needed, now_ns)
        age_out(self._helpful, now_ns)

    def _receive_part(self, state: MessageState, frame: Frame, now_ns: int) -> None:
        """Take one frame of a fast packet; the packet may continue beyond the part that the DBC describes."""
        try:
            payload = self._reassembler.add(frame.key, frame.data, frame.stamp_ns)
        except FrameRefused:
            state.refused += 1
            return
        if payload is not None:
            state.receive(Frame(frame.stamp_ns, frame.key, payload[: state.codec.length]), now_ns)


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
    """Builds the frames of a tick, in send order and the address claim first, in a list that the caller owns.

    While the machine does not drive, the commands are neutral and without the arm key, so that silence always means a
    dead controller.  After another node won the address nothing is sent, and the carrier brakes by its own time-out.
    """

    __slots__ = ("_address", "_alive", "_alive_due", "_arms_a", "_arms_b", "_command_due", "_drive", "_moved")

    def __init__(self, database: Database, address: AddressClaim) -> None:
        messages = (ProtectedMessage(database.message(name)) for name in _OWN_MESSAGES)
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


class CarrierBus:
    """``inputs``, ``monitor`` and ``command`` of mach0.

    The command is `STANDING` (brake on) until `controller.carrier.vehicle` replaces it by one of its laws.
    """

    __slots__ = ("_writer", "command", "inputs", "monitor")

    def __init__(self, databases: tuple[Database, Database] | None = None) -> None:
        """``databases`` (machine and gnss) are loaded when they are not given.

        Raises:
            ConfigError: a database cannot be loaded.
        """
        try:
            machine, gnss = databases or (load("machine"), load("gnss"))
        except ConfigError as error:
            raise ConfigError(error.code, str(error)) from error
        self.inputs = CarrierInputs(machine, gnss)
        self.monitor = BusMonitor(1)
        self.command = STANDING
        self._writer = CarrierWriter(machine, self.inputs.address)

    def decode(self, frames: list[Frame], reading: BusReading, sent: bool, now_ns: int) -> None:
        """Decode the frames of a tick; ``sent``: the previous tick had frames to send."""
        self.monitor.update(reading, sent, now_ns)
        if self.monitor.recovered:
            self.inputs.forget()
        self.inputs.decode([] if self.monitor.frames_lost else frames, now_ns)

    def encode(self, mode: Mode, reason: Reason, half_speed: bool, now_ns: int, frames: list[RawFrame]) -> None:
        """Replace ``frames`` by the frames of this tick."""
        frames.clear()
        self._writer.encode(self.command, mode, reason, half_speed, now_ns, frames)

    def shutdown_frames(self) -> list[RawFrame]:
        """Build the last frames before the process ends: brake on, arms held, and an alive sign with the reason."""
        frames: list[RawFrame] = []
        if not self.inputs.address.lost:
            self._writer.commands(STANDING, frames)
            frames.append(self._writer.alive(Mode.BOOT, Reason.CONTROLLER_ENDED, False))
        return frames
