"""The register map between bridge and PLC: converts values in SI units to 16-bit registers and back.

Pure.  Two roles: in REFERENCES (A) the PLC closes the joint loops and a command carries positions and rates; in VALVES
(B) it passes on valve openings, as shares of full opening.  A register holds 16 bits; a 32-bit number takes two, the
high word first unless `WordOrder` differs.  Reading raises `MapError` and uses nothing; writing refuses values that do
not fit, and never clamps.  Source: docs/reference/can-bus.md section 10.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Final

from runtime.errors import TimberhandError

N_AXES: Final = 7
"""Slew, lift, tilt, extension, rotator, grapple, auxiliary.  The last two have no joint: their values are 0."""
N_JOINTS: Final = 5
N_PRESSURES: Final = 8
"""Lift A and B, tilt A and B, extension A and B, grapple closing and opening side."""
ESTOP_BYTES: Final = 8

MAGIC: Final = 0x4352
MAP_VERSION: Final = 3
WORD_TEST: Final = 0x0102_0304
ARM_KEY: Final = 0x5AA5

STATUS_AT, STATUS_COUNT = 0, 56
COMMAND_AT, COMMAND_COUNT = 100, 32
HEARTBEAT_AT, SEQUENCE_AT, MODE_AT, ARM_AT = 100, 101, 102, 103
WATCHDOG_AT: Final = 11
"""The only register of the status block that may be written [ms]."""
WATCHDOG_MS: Final = (50, 2_000)
WATCHDOG_DEFAULT_MS: Final = 300

_MICRO, _MILLI = 1e6, 1e3
_U16: Final = 0xFFFF


class Role(IntEnum):
    """Who closes the joint loops; the number is that of the command's `Mode` with motion."""

    REFERENCES = 1
    VALVES = 2


class WordOrder(IntEnum):
    """Which half of a 32-bit number comes first."""

    HIGH_FIRST = 0
    LOW_FIRST = 1


class Mode(IntEnum):
    """Mode of a command; the numbers are those of ``ValveCmdA.Mode``."""

    NEUTRAL = 0
    REFERENCES = 1
    VALVES = 2


class State(IntEnum):
    """State of the PLC.

    3, the end of a trajectory stored in the PLC (docs/reference/machines.md section 1.6), is not part of this map.
    """

    INIT = 0
    HOLD = 1
    """Neutral: nothing requested, or nothing received for a moment."""
    EXECUTE = 2
    SAFE = 4
    """The watchdog expired or the emergency stop opened; latched until a reset edge."""


class Fault(IntEnum):
    """Why the PLC refused a command or stopped, register 6; 0 after a reset edge."""

    NONE = 0
    ILLEGAL_VALUE = 1
    """A command contained a value outside its range."""
    WATCHDOG = 2
    """No heartbeat of the commanding side for the watchdog's time."""
    EMERGENCY_STOP = 3


class Estop(IntEnum):
    """Bits of the emergency stop register; the first three are 1 when the machine may move."""

    CHANNEL_A = 1
    CHANNEL_B = 2
    PILOT_ON = 4
    RESET_PRESSED = 8
    PERSON = 16


class Grapple(IntEnum):
    """Register 125."""

    NEUTRAL = 0
    OPEN = 1
    CLOSE = 2
    HOLD = 3


NO_AXIS: Final = 15
RANGE_MARGIN: Final = 0.05
"""How far beyond a joint's range [rad, m] a reference may be: a machine found there must be able to hold still."""


class MapError(TimberhandError, ValueError):
    """A value that the map cannot carry, or undefined registers; ``axis`` is `NO_AXIS` if none is concerned."""

    def __init__(self, code: str, sentence: str, axis: int = NO_AXIS) -> None:
        super().__init__(code, sentence)
        self.axis = axis


@dataclass(frozen=True, slots=True)
class Command:
    """One command.  ``reference`` is rad or m in mode REFERENCES and a share of full opening, -1..1, in mode VALVES;
    ``rate`` is rad/s or m/s, and 0 in mode VALVES.  A reset counts at its rising edge.
    """

    mode: Mode = Mode.NEUTRAL
    armed: bool = False
    reference: tuple[float, ...] = (0.0,) * N_AXES
    rate: tuple[float, ...] = (0.0,) * N_AXES
    grapple: Grapple = Grapple.NEUTRAL
    grapple_pct: int = 0
    max_speed_pct: int = 100
    reset: bool = False


@dataclass(frozen=True, slots=True)
class Feedback:
    """Feedback of the PLC: positions [rad, m], velocities per second, pressures [bar], opening 0..1, load [kg].

    ``estop`` are the PLC's own contacts, for whoever reads the registers; controller and guard judge ``estop_frame``.
    """

    heartbeat: int = 0
    state: State = State.INIT
    fault: int = 0
    fault_axis: int = NO_AXIS
    estop: int = 0
    accepted: int = 0
    """Sequence number of the last accepted command."""
    longest_cycle_us: int = 0
    position: tuple[float, ...] = (0.0,) * N_AXES
    velocity: tuple[float, ...] = (0.0,) * N_AXES
    pressure_bar: tuple[float, ...] = (0.0,) * N_PRESSURES
    opening: float = 0.0
    load_kg: int = 0
    estop_frame: bytes = bytes(ESTOP_BYTES)
    """The newest EstopStat as the safety module sent it, with its checksum and counter; zeros before the first."""
    sampled_us: int = 0
    """When the positions were read, by the PLC's clock modulo 2**16."""
    output: tuple[float, ...] = (0.0,) * N_AXES
    """Opening that the PLC commands to each valve now, -1..1 of full opening."""


@dataclass(frozen=True, slots=True)
class Bounds:
    """Limits of a command on this machine: per axis, (lower, upper) of the reference and the greatest rate."""

    role: Role
    reference: tuple[tuple[float, float], ...]
    rate: tuple[float, ...] = field(default=(0.0,) * N_AXES)

    @classmethod
    def references(cls, joints: Sequence[tuple[float, float, float]]) -> Bounds:
        """Build the limits of role REFERENCES, from (lower, upper, greatest rate) of every joint."""
        spare = N_AXES - N_JOINTS
        return cls(
            Role.REFERENCES,
            tuple((lower - RANGE_MARGIN, upper + RANGE_MARGIN) for lower, upper, _ in joints) + ((0.0, 0.0),) * spare,
            tuple(rate for _, _, rate in joints) + (0.0,) * spare,
        )

    @classmethod
    def valves(cls) -> Bounds:
        """Build the limits of role VALVES: full opening in both directions."""
        return cls(Role.VALVES, ((-1.0, 1.0),) * N_JOINTS + ((0.0, 0.0),) * (N_AXES - N_JOINTS))

    def check(self, command: Command) -> None:
        """Check a command; raises MapError for one that this machine cannot execute."""
        if command.mode not in (Mode.NEUTRAL, int(self.role)):
            raise MapError("plc.role", f"mode {command.mode} is not of role {self.role.name}")
        if command.mode is Mode.NEUTRAL:
            return
        for axis, (value, rate) in enumerate(zip(command.reference, command.rate, strict=True)):
            lower, upper = self.reference[axis]
            # Half a unit of the map: a limit that is not a whole number of units is rounded in transfer.
            if not lower - 0.5e-6 <= value <= upper + 0.5e-6:
                raise MapError(
                    "plc.reference", f"reference of axis {axis} is {value:.6f}, allowed {lower:g} to {upper:g}", axis
                )
            if abs(rate) > self.rate[axis] + 0.5e-3:
                raise MapError("plc.rate", f"rate of axis {axis} is {rate:.6f}, allowed {self.rate[axis]:g}", axis)


def whole(value: float, scale: float, lowest: int, highest: int, what: str) -> int:
    """Compute ``value * scale`` as a whole number in lowest..highest; raises MapError."""
    scaled = value * scale
    if not math.isfinite(scaled):
        raise MapError("plc.not-finite", f"{what} is not a finite number")
    number = round(scaled)
    if not lowest <= number <= highest:
        raise MapError(
            "plc.out-of-range", f"{what} is {value:g}, the map carries {lowest / scale:g} to {highest / scale:g}"
        )
    return number


def micro(value: float, what: str) -> int:
    """Convert a value to units of 1e-6, 32 bits signed."""
    return whole(value, _MICRO, -(1 << 31), (1 << 31) - 1, what)


def signed16(value: float, scale: float, what: str) -> int:
    """Compute ``value * scale``, 16 bits signed."""
    return whole(value, scale, -(1 << 15), (1 << 15) - 1, what)


def _pair(value: int, order: WordOrder) -> tuple[int, int]:
    high, low = value >> 16 & _U16, value & _U16
    return (high, low) if order is WordOrder.HIGH_FIRST else (low, high)


def _long(registers: Sequence[int], at: int, order: WordOrder) -> int:
    first, second = registers[at], registers[at + 1]
    value = first << 16 | second if order is WordOrder.HIGH_FIRST else second << 16 | first
    return value - (1 << 32) if value & 1 << 31 else value


def _short(register: int) -> int:
    return register - (1 << 16) if register & 1 << 15 else register


def command_registers(command: Command, heartbeat: int, sequence: int, order: WordOrder) -> list[int]:
    """Encode the command block, registers 100 to 131; raises MapError."""
    if len(command.reference) != N_AXES or len(command.rate) != N_AXES:
        raise MapError("plc.axis-count", f"a command has {N_AXES} axes")
    registers = [heartbeat & _U16, sequence & _U16, command.mode, ARM_KEY if command.armed else 0]
    for axis, value in enumerate(command.reference):
        registers += _pair(micro(value, f"reference of axis {axis}"), order)
    registers += [signed16(r, _MILLI, f"rate of axis {i}") & _U16 for i, r in enumerate(command.rate)]
    grapple_pct = whole(command.grapple_pct, 1, 0, 100, "the grapple percentage")
    speed_pct = whole(command.max_speed_pct, 1, 0, 100, "the maximum speed")
    return [*registers, command.grapple, grapple_pct, speed_pct, int(command.reset), 0, 0, 0]


_CHOICES: Final = {
    MODE_AT: frozenset(Mode),
    ARM_AT: frozenset((0, ARM_KEY)),
    125: frozenset(Grapple),
    126: range(101),
    127: range(101),
    128: range(2),
    129: range(1),
    130: range(1),
    131: range(1),
}


def check_single(address: int, value: int) -> None:
    """Check one register of the command block; raises MapError for an undefined value."""
    allowed = _CHOICES.get(address)
    if allowed is not None and value not in allowed:
        raise MapError("plc.illegal-value", f"register {address} is {value}, which is not defined")


def read_command(registers: Sequence[int], order: WordOrder) -> Command:
    """Read the command from the 32 registers from `COMMAND_AT`; raises MapError."""
    if len(registers) != COMMAND_COUNT:
        raise MapError("plc.block-size", f"a command block has {COMMAND_COUNT} registers, not {len(registers)}")
    for offset, value in enumerate(registers):
        check_single(COMMAND_AT + offset, value)
    _, _, mode, arm = registers[:4]
    return Command(
        mode=Mode(mode),
        armed=arm == ARM_KEY,
        reference=tuple(_long(registers, 4 + 2 * i, order) / _MICRO for i in range(N_AXES)),
        rate=tuple(_short(registers[18 + i]) / _MILLI for i in range(N_AXES)),
        grapple=Grapple(registers[25]),
        grapple_pct=registers[26],
        max_speed_pct=registers[27],
        reset=bool(registers[28]),
    )


def estop_words(frame: bytes) -> tuple[int, ...]:
    """Split EstopStat into four registers, its first byte the high half of the first; raises MapError."""
    if len(frame) != ESTOP_BYTES:
        raise MapError("plc.estop-frame", f"EstopStat has {ESTOP_BYTES} bytes, not {len(frame)}")
    return struct.unpack(">4H", frame)


def status_registers(feedback: Feedback, watchdog_ms: int, order: WordOrder) -> list[int]:
    """Encode the status block, registers 0 to 55; raises MapError."""
    f = feedback
    registers = [MAGIC, MAP_VERSION, *_pair(WORD_TEST, order)]
    registers += [f.heartbeat & _U16, f.state, f.fault & _U16, f.fault_axis & _U16]
    registers += [f.estop & _U16, f.accepted & _U16, min(f.longest_cycle_us, _U16), watchdog_ms]
    for axis, value in enumerate(f.position):
        registers += _pair(micro(value, f"position of axis {axis}"), order)
    registers += [signed16(v, _MILLI, f"velocity of axis {i}") & _U16 for i, v in enumerate(f.velocity)]
    registers += [signed16(p, 10.0, f"pressure {i}") & _U16 for i, p in enumerate(f.pressure_bar)]
    registers += [whole(f.opening, _MILLI, 0, 1000, "the opening"), whole(f.load_kg, 1, 0, _U16, "the load")]
    registers += [*estop_words(f.estop_frame), f.sampled_us & _U16]
    registers += [signed16(u, _MILLI, f"output of axis {i}") & _U16 for i, u in enumerate(f.output)]
    return [*registers, 0]


def check_identity(registers: Sequence[int], order: WordOrder) -> None:
    """Check the block; raises MapError unless it is of this map, this version and this word order."""
    if len(registers) != STATUS_COUNT:
        raise MapError("plc.block-size", f"a status block has {STATUS_COUNT} registers, not {len(registers)}")
    if registers[0] != MAGIC:
        raise MapError(
            "plc.magic",
            f"register 0 is 0x{registers[0]:04X}, not 0x{MAGIC:04X}; check the PLC's program and byte order",
        )
    if registers[1] != MAP_VERSION:
        raise MapError(
            "plc.version",
            f"the PLC has map version {registers[1]}, not {MAP_VERSION}; load the matching PLC program",
        )
    if _long(registers, 2, order) != WORD_TEST:
        other = WordOrder(1 - order)
        if _long(registers, 2, other) == WORD_TEST:
            raise MapError(
                "plc.word-order",
                f"the PLC's word order is {other.name}, the setting is {order.name}; change one of them",
            )
        raise MapError(
            "plc.byte-order",
            f"the word-order test reads 0x{registers[2]:04X}{registers[3]:04X}; check the PLC's byte order",
        )


def read_status(registers: Sequence[int], order: WordOrder) -> tuple[Feedback, int]:
    """Read the feedback and watchdog [ms] in the 56 registers from `STATUS_AT`; raises MapError."""
    check_identity(registers, order)
    try:
        state = State(registers[5])
    except ValueError:
        raise MapError("plc.state", f"the PLC's state is {registers[5]}, which is not defined") from None
    feedback = Feedback(
        heartbeat=registers[4],
        state=state,
        fault=registers[6],
        fault_axis=registers[7],
        estop=registers[8],
        accepted=registers[9],
        longest_cycle_us=registers[10],
        position=tuple(_long(registers, 12 + 2 * i, order) / _MICRO for i in range(N_AXES)),
        velocity=tuple(_short(registers[26 + i]) / _MILLI for i in range(N_AXES)),
        pressure_bar=tuple(_short(registers[33 + i]) / 10.0 for i in range(N_PRESSURES)),
        opening=registers[41] / _MILLI,
        load_kg=registers[42],
        estop_frame=struct.pack(">4H", *registers[43:47]),
        sampled_us=registers[47],
        output=tuple(_short(registers[48 + i]) / _MILLI for i in range(N_AXES)),
    )
    return feedback, registers[WATCHDOG_AT]


def advances(sequence: int, last: int) -> bool:
    """Tell whether a 16-bit sequence number lies ahead of the last one."""
    return 0 < (sequence - last) & _U16 < 1 << 15
