"""Every reason with its reaction, detection bound, a sentence for the operator and what to do about it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from machine.crane_nodes import NODE_NAMES
from machine.joints import ARTICULATION, JOINTS
from machine.status.driving_faults import DRIVING
from machine.status.evidence import numbers_text
from machine.status.reasons import DetailKind, Fault, Reaction, Reason
from machine.status.refusals import PLANNER, REFUSALS

_N, _J, _D, _B = DetailKind.NOTHING, DetailKind.JOINT, DetailKind.NODE, DetailKind.BUS
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
        Reaction.REFUSE,
        2000,
        _D,
        "{} refuses its configuration",
        "Check the device's EDS, power it off and on, then reset.",
    ),
    Reason.INPUT_MISSING: Fault(
        Reaction.REFUSE,
        0,
        _N,
        "Arming is refused: an input is missing or stale",
        "See the stale mask for the missing frames and start that node.",
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
        Reaction.REFUSE, 0, _N, "Arming is refused: the machine is still stopping", "Arm again when it stands still."
    ),
    Reason.NODE_NOT_OPERATIONAL: Fault(
        Reaction.REFUSE, 2000, _D, "Arming is refused: {} is not operational", "Check its power, cable and NMT state."
    ),
    Reason.BUS_UNSTABLE: Fault(
        Reaction.REFUSE,
        0,
        _B,
        "Arming is refused: {} was lost and came back three times within a minute",
        "Check cable, termination and bit rate, and arm after a quiet minute.",
    ),
    Reason.JOINT_MOVES: Fault(
        Reaction.REFUSE,
        0,
        _J,
        "Arming is refused: {} moves without a command",
        "Leave the hand lever; if nobody moves it, cut the pilot supply and check its valve.",
    ),
    Reason.CONTROLLER_ENDED: Fault(Reaction.NOTE, 0, _N, "The controller has ended", "Start it again."),
    Reason.OPERATOR_STOP: Fault(Reaction.HOLD, 0, _N, "The operator stopped the machine", "Arm to continue."),
    Reason.OPERATOR_DISARM: Fault(Reaction.HOLD, 0, _N, "The operator disarmed the machine", "Arm to continue."),
    Reason.OPERATOR_LINK_LOST: Fault(
        Reaction.HOLD,
        1000,
        _N,
        "The operator who watches no longer reaches the machine",
        "Open the operator's page again, or end the watch by `timberhand operator unwatch`; then arm.",
    ),
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
    Reason.GUARD_LOST: Fault(Reaction.CUT, 60, _N, "The guard is no longer received", "Start the guard, then reset."),
    Reason.GUARD_REFUSES: Fault(
        Reaction.CUT,
        20,
        _N,
        "The guard withdrew its enable",
        "Read the guard's verdict, press reset on the safety module, then arm.",
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
    Reason.ENCODER_FROZEN: Fault(
        Reaction.RAMP,
        300,
        _J,
        "The encoder of {} sends the same sample again and again",
        "Its bus works and its measurement does not: check the device and its coupling, then reset and arm.",
    ),
    Reason.ENCODER_NOISY: Fault(
        Reaction.DEGRADE,
        500,
        _J,
        "The encoder of {} is much noisier than it was, or than its profile says; half speed",
        "Check its shield, supply and coupling.",
    ),
    Reason.ENCODER_DRIFT: Fault(
        Reaction.HOLD,
        3000,
        _J,
        "{} creeps by its encoder while its valve is shut, and its law pulls it back again and again",
        "Compare the joint with its encoder: it drifts, or the valve leaks; then arm.",
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
        "The valve node does not accept the controller's commands",
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
        Reaction.RAMP, 105, _D, "{} restarted or left the operational state", "Find the cause, then reset and arm."
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
    Reason.LEVER_MOVED: Fault(
        Reaction.HOLD,
        20,
        _N,
        "A hand lever was moved or its switch is faulty: automatic work has ended",
        "Leave the levers in neutral, then arm; if nobody moved one, check its switch.",
    ),
    Reason.CARRIER_LOST: Fault(
        Reaction.CUT,
        100,
        _N,
        "The carrier's state is no longer received",
        "Check the vehicle controller and the machine bus, then reset and arm.",
    ),
    Reason.SWING_ARMS_LOST: Fault(
        Reaction.CUT,
        100,
        _N,
        "The heights of the swing arms are no longer received",
        "Check the swing-arm controller and the machine bus, then reset and arm.",
    ),
    Reason.GNSS_LOST: Fault(
        Reaction.NOTE,
        510,
        _N,
        "Position or heading is no longer received",
        "Check the GNSS receiver; crane work can continue.",
    ),
    Reason.ENGINE_LOST: Fault(
        Reaction.NOTE,
        110,
        _N,
        "The engine is no longer received",
        "Check the engine controller; crane work can continue.",
    ),
    Reason.BUS_OFF: Fault(
        Reaction.CUT,
        20,
        _B,
        "The CAN controller on {} is bus-off",
        "Check cable and termination, then reset and arm.",
        True,
    ),
    Reason.BUS_DOWN: Fault(
        Reaction.CUT, 20, _B, "The CAN interface of {} is down", "Bring the interface up, then reset and arm.", True
    ),
    Reason.INPUTS_LOST: Fault(
        Reaction.CUT,
        20,
        _B,
        "Several inputs on {} are lost at the same moment",
        "Check the plug and the supply that they share, or, where this computer emulates the machine, run "
        "`timberhand doctor --rt`; then reset and arm.",
    ),
    Reason.BUS_PASSIVE: Fault(
        Reaction.DEGRADE, 100, _B, "{} is error-passive; half speed", "Check cable, termination and bit rate."
    ),
    Reason.SEND_REFUSED: Fault(
        Reaction.RAMP,
        60,
        _B,
        "The transmit queue of {} was full three times in a row",
        "Check the bus load, then reset.",
    ),
    Reason.FOREIGN_CONTROLLER: Fault(
        Reaction.CUT,
        20,
        _B,
        "Another controller sends this controller's frames on {}",
        "Stop the other controller, then reset.",
        True,
    ),
    Reason.ADDRESS_LOST: Fault(
        Reaction.RAMP,
        20,
        _N,
        "Another device uses the controller's address 27h on the machine bus",
        "Give that device another address, then reset and arm.",
    ),
    Reason.LOOP_LATE: Fault(
        Reaction.DEGRADE,
        5,
        _N,
        "The control loop was late by more than two periods and 10 ms; half speed",
        "Free the processor; see docs/how-to/real-time.md.",
    ),
    Reason.LOOP_STALLED: Fault(
        Reaction.HOLD,
        15,
        _N,
        "The control loop was late three times in a second, or by more than 50 ms",
        "Free the processor; see docs/how-to/real-time.md; then arm.",
    ),
    Reason.COMPUTER_STALLED: Fault(
        Reaction.CUT,
        20,
        _N,
        "This computer stood still, so that inputs were lost",
        "Run `timberhand doctor --rt`, end what else runs here, then reset and arm.",
    ),
    Reason.PROFILE_DIFFERS: Fault(
        Reaction.CUT,
        60,
        _N,
        "The guard runs on another profile file than the controller",
        "Restart both, with one profile; then reset and arm.",
    ),
    Reason.LEASE_LOST: Fault(Reaction.HOLD, 10, _N, "The planner's setpoints ended while moving", PLANNER),
    Reason.SETPOINTS_REFUSED: Fault(Reaction.HOLD, 10, _N, "Three setpoints were refused within a second", PLANNER),
    Reason.SPOOL_OPEN: Fault(
        Reaction.CUT,
        150,
        _J,
        "The valve of {} is further open than commanded",
        "Check its spool for dirt and its solenoid, then reset and arm.",
    ),
    Reason.SPOOL_SHUT: Fault(
        Reaction.HOLD,
        400,
        _J,
        "The valve of {} stays shut although it is commanded to open",
        "Check its spool, solenoid and plug, then arm.",
    ),
    Reason.SPOOL_WRONG: Fault(
        Reaction.DEGRADE,
        2000,
        _J,
        "The valve of {} opens more or less than commanded; half speed",
        "Check pilot pressure and solenoid, and calibrate the valve.",
    ),
    Reason.SPEED_WRONG: Fault(
        Reaction.RAMP,
        200,
        _J,
        "{} moves at another speed than its open valve gives",
        "Compare the joint with its encoder: check coupling and scale; or calibrate the valve. Then reset and arm.",
    ),
    Reason.JOINT_STUCK: Fault(
        Reaction.HOLD,
        400,
        _J,
        "{} does not follow its command",
        "Check for a stuck valve or a frozen encoder, then arm.",
    ),
    Reason.JOINT_RUNAWAY: Fault(
        Reaction.CUT, 150, _J, "{} moves without a command", "Check for a valve stuck open, then reset and arm."
    ),
    Reason.JOINT_REVERSED: Fault(
        Reaction.RAMP, 200, _J, "{} moves against its command", "Check signs in the profile, then reset and arm."
    ),
    Reason.MOVES_WHILE_STOPPED: Fault(
        Reaction.CUT,
        600,
        _J,
        "{} moves although the machine is stopped",
        "Check for a valve stuck open, then reset and arm; to move it by hand lever, disarm first.",
        True,
    ),
    Reason.OVERLOAD: Fault(
        Reaction.HOLD,
        50,
        _N,
        "Load, reach and slope together are more than the machine bears",
        "Lower the load or bring it nearer, or arm and command only that.",
    ),
    Reason.OVERLOADED: Fault(
        Reaction.DEGRADE,
        50,
        _N,
        "The machine bears no more: nothing goes outward or up; half speed",
        "Lower the load or bring it nearer.",
    ),
    Reason.HOSE_BURST: Fault(
        Reaction.CUT,
        100,
        _J,
        "The oil that carries {} is gone: a hose or a pipe has burst",
        "Stay clear of the load; replace the hose, then reset and arm.",
    ),
    Reason.TEST_RANGE: Fault(
        Reaction.HOLD,
        10,
        _J,
        "The spool test of {} reaches the end of its range",
        "Start farther from the end, then arm.",
    ),
    Reason.TEST_SPEED: Fault(
        Reaction.HOLD,
        10,
        _J,
        "{} moves faster in a spool test than its limit",
        "Correct full_speed in the profile, then arm.",
    ),
    Reason.TEST_TOO_LONG: Fault(
        Reaction.HOLD,
        10,
        _J,
        "The spool test of {} lasts too long without a pause",
        "Split it into shorter tests, then arm.",
    ),
    **DRIVING,
    **REFUSALS,
}

_BUS_NAMES: Final = ("the crane bus", "the machine bus")
_ARM_NAMES: Final = ("front left", "front right", "rear left", "rear right")


def describe(reason: int, detail: int = 0, numbers: Sequence[float | None] = ()) -> str:
    """The one text of a reason: sentence, numbers of its evidence, advice, and in brackets its code.

    ``reason`` may carry its detail in bits 8 to 15; ``numbers`` are those of `machine.status.evidence`.
    """
    known = Reason(reason & 0xFF)
    detail = detail or reason >> 8
    measured = numbers_text(known, detail, numbers)
    code = f" [{known.name}]" if known else ""
    return f"{sentence_of(known, detail)}{f' ({measured})' if measured else ''}. {FAULTS[known].advice}{code}"


def sentence_of(reason: Reason, detail: int = 0) -> str:
    """The operator's sentence without its full stop."""
    fault = FAULTS[reason]
    sentence = fault.sentence.format(part_of(fault.about, detail)).rstrip(".")
    return f"{sentence[0].upper()}{sentence[1:]}"


def part_of(about: DetailKind, detail: int) -> str:
    """The part that a detail names; empty when it names none."""
    match about:
        case DetailKind.JOINT:
            if detail < len(JOINTS):
                return f"joint {JOINTS[detail].name.lower()}"
            return "the articulation" if detail == ARTICULATION else f"joint {detail}"
        case DetailKind.NODE:
            return NODE_NAMES.get(detail, f"node {detail}")
        case DetailKind.BUS:
            return _BUS_NAMES[detail] if detail < len(_BUS_NAMES) else f"bus {detail}"
        case DetailKind.ARM:
            return _ARM_NAMES[detail] if detail < len(_ARM_NAMES) else f"swing {detail}"
        case _:
            return ""
