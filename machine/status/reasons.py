"""Every reason that the controller reports, by number, and the record that describes one.

The numbers travel in ``CtrlStatus.Reason`` (8 bits) and, with the detail above them, in ``StateReport.reason``.
"""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple


class Reaction(IntEnum):
    """What a reason makes the controller do, from mild to severe.

    Source: docs/reference/safety.md section 4; stop categories of IEC 60204-1.
    """

    NOTE = 0
    """Only reported."""
    REFUSE = 1
    """A datagram or an arming request is refused as a whole (X)."""
    DEGRADE = 2
    """Half speed (D)."""
    HOLD = 3
    """Slow down, then neutral; the operator must arm again (H, SS2)."""
    RAMP = 4
    """Short ramp to neutral, enable off, latched (R1, SS1)."""
    CUT = 5
    """Neutral and enable off in the next frame, latched (R0, SS0)."""


class DetailKind(IntEnum):
    """What the detail number of a reason refers to."""

    NOTHING = 0
    JOINT = 1
    NODE = 2
    BUS = 3
    """0 is crane0, 1 is mach0."""
    ARM = 4
    """A swing arm, in the order of `machine.geometry.carrier.ARMS`."""


class Reason(IntEnum):
    """Why the controller refuses, slows down or stops; 101 to 108 are 100 + ``DatagramFault``."""

    NONE = 0
    NODE_ABSENT = 1
    NODE_IDENTITY = 2
    NODE_CONFIGURATION = 3
    INPUT_MISSING = 4
    GUARD_NOT_READY = 5
    ESTOP_NOT_RELEASED = 6
    VALVE_NODE_NOT_READY = 7
    FAULT_LATCHED = 8
    STILL_STOPPING = 9
    OPERATOR_STOP = 10
    OPERATOR_DISARM = 11
    NODE_NOT_OPERATIONAL = 12
    CONTROLLER_ENDED = 13
    BUS_UNSTABLE = 14
    JOINT_MOVES = 15
    OPERATOR_LINK_LOST = 16

    ESTOP_PRESSED = 20
    ESTOP_CHANNELS = 21
    ESTOP_LOST = 22
    GUARD_LOST = 23
    GUARD_REFUSES = 24
    ENCODER_LOST = 25
    ENCODER_JUMP = 26
    ENCODER_ALARM = 27
    POSITION_OUTSIDE = 28
    VALVE_FEEDBACK_LOST = 29
    VALVE_ECHO_STUCK = 30
    VALVE_NODE_FAULT = 31
    PLC_LOST = 32
    PLC_FAULT = 33
    PRESSURE_LOST = 34
    GRAPPLE_STATUS_LOST = 35
    SAFETY_NODE_LOST = 36
    ENCODER_NODE_LOST = 37
    PRESSURE_NODE_LOST = 38
    NODE_RESTARTED = 39
    EMERGENCY_MESSAGE = 40
    EMERGENCY_WARNING = 41
    PERSON_IN_ZONE = 42
    CARRIER_LOST = 43
    SWING_ARMS_LOST = 44
    GNSS_LOST = 45
    ENGINE_LOST = 46
    ENCODER_FROZEN = 47
    ENCODER_NOISY = 48
    ENCODER_DRIFT = 49

    BUS_OFF = 50
    BUS_DOWN = 51
    BUS_PASSIVE = 52
    SEND_REFUSED = 53
    FOREIGN_CONTROLLER = 54
    ADDRESS_LOST = 55
    LEVER_MOVED = 56
    INPUTS_LOST = 57

    LOOP_LATE = 60
    LOOP_STALLED = 61
    SPOOL_OPEN = 62
    SPOOL_SHUT = 63
    SPOOL_WRONG = 64
    SPEED_WRONG = 65
    COMPUTER_STALLED = 66
    PROFILE_DIFFERS = 67

    LEASE_LOST = 70
    SETPOINTS_REFUSED = 71
    OVERLOAD = 72
    HOSE_BURST = 73
    OVERLOADED = 74
    JOINT_STUCK = 75
    JOINT_RUNAWAY = 76
    JOINT_REVERSED = 77
    TEST_RANGE = 78
    TEST_SPEED = 79
    TEST_TOO_LONG = 80

    POSITION_LOST = 81
    HEADING_LOST = 82
    FIX_LOST = 83
    POSITION_JUMP = 84
    HEADING_JUMP = 85
    HEADING_FROZEN = 86
    HEADING_REVERSED = 87
    CARRIER_FAULT = 88
    CARRIER_RUNAWAY = 89
    CARRIER_STUCK = 90
    STEERING_DISAGREES = 91
    TILTED = 92
    ARMS_FAULT = 93
    ARM_OUTSIDE = 94
    ARM_STUCK = 95
    STEERING_STUCK = 96
    STEERING_RUNAWAY = 97
    MOVES_WHILE_STOPPED = 98

    DATAGRAM_LENGTH = 101
    DATAGRAM_MAGIC = 102
    DATAGRAM_VERSION = 103
    DATAGRAM_KIND = 104
    DATAGRAM_CRC = 105
    DATAGRAM_AUTHENTICATION = 106
    DATAGRAM_NOT_FINITE = 107
    DATAGRAM_VALUE = 108
    WRONG_PROFILE = 110
    OUT_OF_ORDER = 111
    STAMP_FUTURE = 112
    STAMP_OLD = 113
    LEASE_TOO_LONG = 114
    NOT_ARMED = 115
    JOINT_RANGE = 116
    JOINT_SPEED = 117
    REFERENCE_JUMP = 118
    FINAL_MOVING = 119
    CANNOT_DRIVE = 120
    TEST_FUNCTION = 121
    TEST_SPOOL = 122
    TEST_BUSY = 123
    DRIVE_SPEED = 124
    DRIVE_WAYPOINT = 125
    DRIVE_ARTICULATION = 126
    DRIVE_HEIGHT = 127
    FLOAT_BOTH = 128
    CRANE_MOVES = 129
    CARRIER_MOVES = 130
    NO_AUTHORITY = 131
    BELOW_GROUND = 140
    KEEP_OUT = 141
    RAISES_MOMENT = 142


class Fault(NamedTuple):
    """The description of a reason; with ``always`` it also latches while nothing is armed.

    ``bound_ms`` is the fault detection time of docs/reference/safety.md section 5 (injection to latched); 0 means
    immediately, on arrival.
    """

    reaction: Reaction
    bound_ms: int
    about: DetailKind
    sentence: str
    advice: str = ""
    always: bool = False


def pack(reason: Reason, detail: int) -> int:
    """Pack reason and detail as one 16-bit number, as ``StateReport`` carries them."""
    return reason | detail << 8


def known(reason: int) -> Reason | None:
    """Return the reason without its detail; None for one of another release."""
    return Reason(reason & 0xFF) if reason & 0xFF in set(Reason) else None
