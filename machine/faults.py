"""Every reason the controller gives: number, reaction, detection bound, a sentence and what to do.

The numbers travel in ``CtrlStatus.Reason`` (8 bits) and, with the detail above them, in
``StateReport.reason``. Bounds are the FDTI of safety_faults.md section 5 (injection to latched, in ms); 0
means at once, on arrival.
"""

from __future__ import annotations

from enum import IntEnum
from typing import Final, NamedTuple

from machine.joints import JOINTS

ENCODER_BIT: Final = 2
"""In the mask of stale inputs (``StateReport.stale_mask``) the encoder of a joint has bit ``ENCODER_BIT + joint``."""


class Reaction(IntEnum):
    """What a reason does, from mild to hard (safety_faults.md section 4; stop categories of IEC 60204-1)."""

    NOTE = 0
    """Said, nothing more."""
    REFUSE = 1
    """A datagram or an arming request is refused whole (X)."""
    DEGRADE = 2
    """Half speed (D)."""
    HOLD = 3
    """Slow down, then neutral; the operator arms again (H, SS2)."""
    RAMP = 4
    """Short ramp to neutral, enable off, latched (R1, SS1)."""
    CUT = 5
    """Neutral and enable off in the next frame, latched (R0, SS0)."""


class About(IntEnum):
    """What the detail number of a reason names."""

    NOTHING = 0
    JOINT = 1
    NODE = 2


class Reason(IntEnum):
    """Why the controller refuses, slows or stops; 101 to 108 are 100 + ``DatagramFault``."""

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

    BUS_OFF = 50
    BUS_DOWN = 51
    BUS_PASSIVE = 52
    SEND_REFUSED = 53
    FOREIGN_CONTROLLER = 54

    LOOP_LATE = 60
    LOOP_STALLED = 61

    LEASE_LOST = 70
    SETPOINTS_REFUSED = 71
    JOINT_STUCK = 75
    JOINT_RUNAWAY = 76
    JOINT_REVERSED = 77

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


class Fault(NamedTuple):
    """What is known about a reason; ``always`` says that it also latches while nothing is armed."""

    reaction: Reaction
    bound_ms: int
    about: About
    sentence: str
    advice: str
    always: bool = False


_N, _J, _D = About.NOTHING, About.JOINT, About.NODE
_PLANNER: Final = "Look at the planner's log."
_SESSION: Final = "Release, reset and arm again."

FAULTS: Final[dict[Reason, Fault]] = {
    Reason.NONE: Fault(Reaction.NOTE, 0, _N, "All is well.", "Nothing to do."),
    Reason.NODE_ABSENT: Fault(
        Reaction.REFUSE, 2000, _D, "{} does not answer on the bus", "Check its power, node id and cable."
    ),
    Reason.NODE_IDENTITY: Fault(
        Reaction.REFUSE,
        2000,
        _D,
        "{} is not the device the profile names",
        "Compare objects 1000h, 1018h, 6001h, 6002h and 6005h with the profile, then reset.",
    ),
    Reason.NODE_CONFIGURATION: Fault(
        Reaction.REFUSE, 2000, _D, "{} refuses its set-up", "Check the device's EDS, power it off and on, then reset."
    ),
    Reason.INPUT_MISSING: Fault(
        Reaction.REFUSE,
        0,
        _N,
        "Arming is refused: an input is missing or stale",
        "Look which frames are missing (stale mask) and start that node.",
    ),
    Reason.GUARD_NOT_READY: Fault(
        Reaction.REFUSE, 0, _N, "Arming is refused: the guard does not enable", "Start the guard or read its verdict."
    ),
    Reason.ESTOP_NOT_RELEASED: Fault(
        Reaction.REFUSE, 0, _N, "Arming is refused: the emergency stop is not released", "Release it, then reset."
    ),
    Reason.VALVE_NODE_NOT_READY: Fault(
        Reaction.REFUSE, 0, _N, "Arming is refused: the valve node is not operational", "Check the machine PLC."
    ),
    Reason.FAULT_LATCHED: Fault(Reaction.REFUSE, 0, _N, "Arming is refused: a fault is latched", "Reset, then arm."),
    Reason.STILL_STOPPING: Fault(
        Reaction.REFUSE, 0, _N, "Arming is refused: the machine is still stopping", "Arm again when it stands."
    ),
    Reason.NODE_NOT_OPERATIONAL: Fault(
        Reaction.REFUSE, 2000, _D, "Arming is refused: {} is not operational", "Check its power, cable and NMT state."
    ),
    Reason.CONTROLLER_ENDED: Fault(Reaction.NOTE, 0, _N, "The controller has ended", "Start it again."),
    Reason.OPERATOR_STOP: Fault(Reaction.HOLD, 0, _N, "The operator stopped the machine", "Arm to go on."),
    Reason.OPERATOR_DISARM: Fault(Reaction.HOLD, 0, _N, "The operator disarmed the machine", "Arm to go on."),
    Reason.ESTOP_PRESSED: Fault(Reaction.CUT, 15, _N, "The emergency stop is pressed", _SESSION, True),
    Reason.ESTOP_CHANNELS: Fault(
        Reaction.CUT,
        20,
        _N,
        "The emergency stop channels disagree or report an error",
        "Check the stop circuit's wiring, then reset and arm.",
        True,
    ),
    Reason.ESTOP_LOST: Fault(
        Reaction.CUT, 40, _N, "The emergency stop state is no longer received", "Check the safety module, then reset."
    ),
    Reason.GUARD_LOST: Fault(Reaction.CUT, 60, _N, "The guard is no longer heard", "Start the guard, then reset."),
    Reason.GUARD_REFUSES: Fault(
        Reaction.CUT, 20, _N, "The guard withdrew its enable", "Read the guard's verdict, then reset and arm."
    ),
    Reason.ENCODER_LOST: Fault(
        Reaction.RAMP, 20, _J, "The encoder of {} is no longer received", "Check its cable, then reset and arm."
    ),
    Reason.ENCODER_JUMP: Fault(
        Reaction.RAMP,
        10,
        _J,
        "The encoder of {} jumps faster than the joint can move",
        "Check its coupling and shield, then reset and arm.",
    ),
    Reason.ENCODER_ALARM: Fault(
        Reaction.RAMP, 20, _J, "The encoder of {} reports an alarm", "Read objects 6503h or 5122h, then reset."
    ),
    Reason.POSITION_OUTSIDE: Fault(
        Reaction.RAMP, 20, _J, "{} is outside its range", "Move it back by hand lever, then reset and arm."
    ),
    Reason.VALVE_FEEDBACK_LOST: Fault(
        Reaction.RAMP, 20, _N, "The valve node's feedback is no longer received", "Check the machine PLC, then reset."
    ),
    Reason.VALVE_ECHO_STUCK: Fault(
        Reaction.RAMP,
        35,
        _N,
        "The valve node does not take our commands",
        "Check the bus to the machine PLC and its exit code, then reset.",
    ),
    Reason.VALVE_NODE_FAULT: Fault(
        Reaction.RAMP, 20, _N, "The valve node reports a fault or a cut pilot supply", "Read its exit code, then reset."
    ),
    Reason.PLC_LOST: Fault(
        Reaction.CUT, 100, _N, "The machine PLC's status is no longer received", "Check the machine PLC, then reset."
    ),
    Reason.PLC_FAULT: Fault(
        Reaction.RAMP, 30, _N, "The machine PLC reports a fault", "Read its fault bits, then reset and arm."
    ),
    Reason.PRESSURE_LOST: Fault(
        Reaction.DEGRADE, 110, _N, "A pressure module is no longer received; half speed", "Check the pressure modules."
    ),
    Reason.GRAPPLE_STATUS_LOST: Fault(
        Reaction.DEGRADE, 110, _N, "The grapple status is no longer received; half speed", "Check the machine PLC."
    ),
    Reason.SAFETY_NODE_LOST: Fault(
        Reaction.CUT, 260, _D, "The heartbeat of {} is lost", "Check this node's power and cable, then reset and arm."
    ),
    Reason.ENCODER_NODE_LOST: Fault(
        Reaction.RAMP, 260, _D, "The heartbeat of {} is lost", "Check this encoder's power and cable, then reset."
    ),
    Reason.PRESSURE_NODE_LOST: Fault(
        Reaction.DEGRADE, 260, _D, "The heartbeat of {} is lost; half speed", "Check the pressure modules."
    ),
    Reason.NODE_RESTARTED: Fault(
        Reaction.RAMP, 105, _D, "{} restarted or left the operational state", "Find why, then reset and arm."
    ),
    Reason.EMERGENCY_MESSAGE: Fault(
        Reaction.RAMP, 5, _D, "{} sends an emergency message", "Read its error register, then reset and arm."
    ),
    Reason.EMERGENCY_WARNING: Fault(
        Reaction.DEGRADE, 5, _D, "{} sends a warning; half speed", "Read its error register (1001h, 1003h)."
    ),
    Reason.PERSON_IN_ZONE: Fault(
        Reaction.HOLD, 20, _N, "A person is in the machine's zone", "Clear the zone, then arm."
    ),
    Reason.BUS_OFF: Fault(
        Reaction.CUT, 20, _N, "Our CAN controller is bus-off", "Check cable and termination, then reset and arm.", True
    ),
    Reason.BUS_DOWN: Fault(
        Reaction.CUT,
        20,
        _N,
        "The CAN interface is down",
        "Bring the interface up, then start the controller again.",
        True,
    ),
    Reason.BUS_PASSIVE: Fault(
        Reaction.DEGRADE, 100, _N, "The bus is error-passive; half speed", "Check cable, termination and bit rate."
    ),
    Reason.SEND_REFUSED: Fault(
        Reaction.RAMP, 20, _N, "The transmit queue is full three times in a row", "Check the bus load, then reset."
    ),
    Reason.FOREIGN_CONTROLLER: Fault(
        Reaction.CUT, 20, _N, "Another controller sends our frames", "Stop the other controller, then reset.", True
    ),
    Reason.LOOP_LATE: Fault(
        Reaction.DEGRADE, 5, _N, "The control loop was late; half speed", "Free the processor; see realtime tuning."
    ),
    Reason.LOOP_STALLED: Fault(
        Reaction.HOLD, 15, _N, "The control loop was late by more than three periods", "Free the processor, then arm."
    ),
    Reason.LEASE_LOST: Fault(Reaction.HOLD, 10, _N, "The planner's setpoints ended while moving", _PLANNER),
    Reason.SETPOINTS_REFUSED: Fault(Reaction.HOLD, 10, _N, "Three setpoints were refused within a second", _PLANNER),
    Reason.JOINT_STUCK: Fault(
        Reaction.HOLD,
        400,
        _J,
        "{} does not follow its command",
        "Look for a stuck valve or a frozen encoder, then arm.",
    ),
    Reason.JOINT_RUNAWAY: Fault(
        Reaction.CUT, 150, _J, "{} moves without a command", "Look for a valve stuck open, then reset and arm."
    ),
    Reason.JOINT_REVERSED: Fault(
        Reaction.RAMP, 200, _J, "{} moves against its command", "Check signs in the profile, then reset and arm."
    ),
    Reason.DATAGRAM_LENGTH: Fault(Reaction.REFUSE, 10, _N, "A datagram of a wrong length was refused", _PLANNER),
    Reason.DATAGRAM_MAGIC: Fault(Reaction.REFUSE, 10, _N, "A datagram that is not ours was refused", _PLANNER),
    Reason.DATAGRAM_VERSION: Fault(
        Reaction.REFUSE, 10, _N, "A datagram of another version was refused", "Run the same release on both sides."
    ),
    Reason.DATAGRAM_KIND: Fault(
        Reaction.REFUSE, 10, _N, "A datagram of a kind that is not for the controller was refused", _PLANNER
    ),
    Reason.DATAGRAM_CRC: Fault(Reaction.REFUSE, 10, _N, "A corrupt datagram was refused", _PLANNER),
    Reason.DATAGRAM_AUTHENTICATION: Fault(
        Reaction.REFUSE, 10, _N, "A datagram with a wrong key was refused", "Give both sides the same key."
    ),
    Reason.DATAGRAM_NOT_FINITE: Fault(Reaction.REFUSE, 10, _N, "A datagram with NaN or infinity was refused", _PLANNER),
    Reason.DATAGRAM_VALUE: Fault(Reaction.REFUSE, 10, _N, "A datagram with an illegal value was refused", _PLANNER),
    Reason.WRONG_PROFILE: Fault(
        Reaction.REFUSE, 10, _N, "A datagram for another profile was refused", "Start both sides with one profile file."
    ),
    Reason.OUT_OF_ORDER: Fault(Reaction.REFUSE, 10, _N, "A repeated or reordered datagram was refused", _PLANNER),
    Reason.STAMP_FUTURE: Fault(
        Reaction.REFUSE, 10, _N, "A datagram stamped in the future was refused", "Both sides must use one clock."
    ),
    Reason.STAMP_OLD: Fault(
        Reaction.REFUSE, 10, _N, "A datagram that came too late was refused", "The sender or the network is slow."
    ),
    Reason.LEASE_TOO_LONG: Fault(
        Reaction.REFUSE, 10, _N, "A setpoint with a lease over the limit was refused", "Ask for a shorter lease."
    ),
    Reason.NOT_ARMED: Fault(Reaction.REFUSE, 10, _N, "A setpoint was refused: the machine is not armed", "Arm first."),
    Reason.JOINT_RANGE: Fault(Reaction.REFUSE, 10, _J, "A setpoint was refused: {} out of its range", _PLANNER),
    Reason.JOINT_SPEED: Fault(Reaction.REFUSE, 10, _J, "A setpoint was refused: {} too fast", _PLANNER),
    Reason.REFERENCE_JUMP: Fault(
        Reaction.REFUSE, 10, _J, "A setpoint was refused: {} would jump from the present reference", _PLANNER
    ),
    Reason.FINAL_MOVING: Fault(
        Reaction.REFUSE, 10, _J, "A final setpoint was refused: {} does not end at rest", _PLANNER
    ),
    Reason.CANNOT_DRIVE: Fault(
        Reaction.REFUSE, 10, _N, "A drive setpoint was refused: this machine cannot drive", "Plan crane work only."
    ),
}

_NODE_NAMES: Final = {
    0x01: "the safety module", 0x10: "the valve node", 0x20: "pressure module A", 0x21: "pressure module B",
    0x22: "pressure module C", 0x7D: "the guard",
}  # fmt: skip


def pack(reason: Reason, detail: int) -> int:
    """Reason and detail as one 16-bit number, as ``StateReport`` carries them."""
    return reason | detail << 8


def describe(reason: int, detail: int = 0) -> str:
    """The operator's sentence and what to do; ``reason`` may carry its detail in bits 8 to 15."""
    known = Reason(reason & 0xFF)
    detail = detail or reason >> 8
    fault = FAULTS[known]
    if known is Reason.NONE:
        return f"{fault.sentence} {fault.advice}"
    subject = ""
    if fault.about is About.JOINT:
        subject = f"joint {JOINTS[detail].name.lower()}" if detail < len(JOINTS) else f"joint {detail}"
    elif fault.about is About.NODE:
        subject = _NODE_NAMES.get(detail, f"node {detail}")
    sentence = fault.sentence.format(subject)
    return f"{sentence[0].upper()}{sentence[1:]}. {fault.advice}"
