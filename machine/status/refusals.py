"""Reasons for refusing a datagram as a whole, on arrival."""

from __future__ import annotations

from typing import Final

from machine.status.reasons import DetailKind, Fault, Reaction, Reason

_N, _J, _A = DetailKind.NOTHING, DetailKind.JOINT, DetailKind.ARM
PLANNER: Final = "See the planner's journal."

REFUSALS: Final[dict[Reason, Fault]] = {
    Reason.DATAGRAM_LENGTH: Fault(Reaction.REFUSE, 10, _N, "A datagram of wrong length was refused", PLANNER),
    Reason.DATAGRAM_MAGIC: Fault(Reaction.REFUSE, 10, _N, "A foreign datagram was refused", PLANNER),
    Reason.DATAGRAM_VERSION: Fault(
        Reaction.REFUSE, 10, _N, "A datagram of another version was refused", "Run the same release on both sides."
    ),
    Reason.DATAGRAM_KIND: Fault(
        Reaction.REFUSE, 10, _N, "A datagram of a kind that the controller does not accept was refused", PLANNER
    ),
    Reason.DATAGRAM_CRC: Fault(Reaction.REFUSE, 10, _N, "A corrupt datagram was refused", PLANNER),
    Reason.DATAGRAM_AUTHENTICATION: Fault(
        Reaction.REFUSE,
        10,
        _N,
        "A datagram without the right key was refused",
        "Give both sides the same key.",
    ),
    Reason.DATAGRAM_NOT_FINITE: Fault(Reaction.REFUSE, 10, _N, "A datagram with NaN or infinity was refused", PLANNER),
    Reason.DATAGRAM_VALUE: Fault(Reaction.REFUSE, 10, _N, "A datagram with an illegal value was refused", PLANNER),
    Reason.WRONG_PROFILE: Fault(
        Reaction.REFUSE, 10, _N, "A datagram for another profile was refused", "Start both sides with the same profile."
    ),
    Reason.OUT_OF_ORDER: Fault(Reaction.REFUSE, 10, _N, "A repeated or reordered datagram was refused", PLANNER),
    Reason.STAMP_FUTURE: Fault(
        Reaction.REFUSE, 10, _N, "A datagram stamped in the future was refused", "Both sides must use the same clock."
    ),
    Reason.STAMP_OLD: Fault(
        Reaction.REFUSE, 10, _N, "A datagram that arrived too late was refused", "The sender or the network is slow."
    ),
    Reason.LEASE_TOO_LONG: Fault(
        Reaction.REFUSE, 10, _N, "A setpoint with a lease over the limit was refused", "Request a shorter lease."
    ),
    Reason.NOT_ARMED: Fault(Reaction.REFUSE, 10, _N, "A setpoint was refused: the machine is not armed", "Arm first."),
    Reason.JOINT_RANGE: Fault(Reaction.REFUSE, 10, _J, "A setpoint was refused: {} is outside its range", PLANNER),
    Reason.JOINT_SPEED: Fault(Reaction.REFUSE, 10, _J, "A setpoint was refused: {} is too fast", PLANNER),
    Reason.REFERENCE_JUMP: Fault(
        Reaction.REFUSE, 10, _J, "A setpoint was refused: {} would jump from the present reference", PLANNER
    ),
    Reason.FINAL_MOVING: Fault(
        Reaction.REFUSE, 10, _J, "A final setpoint was refused: {} does not end at rest", PLANNER
    ),
    Reason.CANNOT_DRIVE: Fault(
        Reaction.REFUSE, 10, _N, "A drive setpoint was refused: this machine cannot drive", "Plan crane work only."
    ),
    Reason.TEST_FUNCTION: Fault(
        Reaction.REFUSE, 10, _J, "A spool test was refused: {} has no encoder", "Test joints with an encoder only."
    ),
    Reason.TEST_SPOOL: Fault(
        Reaction.REFUSE, 10, _J, "A spool test was refused: {} would be too fast or start too hard", PLANNER
    ),
    Reason.TEST_BUSY: Fault(
        Reaction.REFUSE, 10, _J, "A spool test was refused: a function other than {} still moves", PLANNER
    ),
    Reason.DRIVE_SPEED: Fault(
        Reaction.REFUSE, 10, _N, "A drive setpoint was refused: it is too fast, or backward to a waypoint", PLANNER
    ),
    Reason.DRIVE_WAYPOINT: Fault(
        Reaction.REFUSE, 10, _N, "A drive setpoint was refused: its waypoint is not on this site", PLANNER
    ),
    Reason.DRIVE_ARTICULATION: Fault(
        Reaction.REFUSE, 10, _N, "A drive setpoint was refused: the articulation bends too far or too fast", PLANNER
    ),
    Reason.DRIVE_HEIGHT: Fault(
        Reaction.REFUSE, 10, _A, "A drive setpoint was refused: the {} arm is outside its travel", PLANNER
    ),
    Reason.FLOAT_BOTH: Fault(Reaction.REFUSE, 10, _N, "A drive setpoint was refused: both axles would float", PLANNER),
    Reason.CRANE_MOVES: Fault(
        Reaction.REFUSE, 10, _N, "A drive setpoint was refused: the crane is moving", "Drive when the crane is at rest."
    ),
    Reason.CARRIER_MOVES: Fault(
        Reaction.REFUSE,
        10,
        _N,
        "A crane setpoint was refused: the machine is driving",
        "Move the crane when the machine stands still.",
    ),
    Reason.BELOW_GROUND: Fault(
        Reaction.REFUSE, 10, _N, "A setpoint was refused: the rotator would touch the ground", PLANNER
    ),
    Reason.KEEP_OUT: Fault(
        Reaction.REFUSE,
        10,
        _N,
        "A setpoint was refused: the boom tip would enter a box that it must keep out of",
        PLANNER,
    ),
    Reason.RAISES_MOMENT: Fault(
        Reaction.REFUSE,
        10,
        _N,
        "A setpoint was refused: the machine is overloaded and the load would go outward or up",
        "Lower the load or bring it nearer.",
    ),
    Reason.NO_AUTHORITY: Fault(
        Reaction.REFUSE,
        10,
        _N,
        "Only an operator may arm, disarm or reset",
        "Send it through the operator's socket, as a user of its group.",
    ),
}
