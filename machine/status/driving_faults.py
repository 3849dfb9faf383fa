"""What goes wrong on the way to a waypoint: position, heading, carrier, steering, swing arms."""

from __future__ import annotations

from typing import Final

from machine.status.reasons import About, Fault, Reaction, Reason

_N, _A = About.NOTHING, About.ARM

DRIVING: Final[dict[Reason, Fault]] = {
    Reason.POSITION_LOST: Fault(
        Reaction.HOLD, 510, _N, "The position was lost on the way to a waypoint", "Check the GNSS receiver, then arm."
    ),
    Reason.HEADING_LOST: Fault(
        Reaction.HOLD, 310, _N, "The heading was lost on the way to a waypoint", "Check both antennas, then arm."
    ),
    Reason.FIX_LOST: Fault(
        Reaction.HOLD,
        1200,
        _N,
        "The position is neither RTK fixed nor float on the way to a waypoint",
        "Wait for the fix, or check the correction service; then arm.",
    ),
    Reason.POSITION_JUMP: Fault(
        Reaction.HOLD,
        310,
        _N,
        "The position jumped on the way to a waypoint",
        "Compare it with the machine's place, then arm.",
    ),
    Reason.HEADING_JUMP: Fault(
        Reaction.HOLD,
        310,
        _N,
        "The heading jumped on the way to a waypoint",
        "Compare it with where the front looks, then arm.",
    ),
    Reason.HEADING_FROZEN: Fault(
        Reaction.HOLD,
        710,
        _N,
        "The heading stands still while the machine turns",
        "Restart the GNSS receiver, then arm.",
    ),
    Reason.HEADING_REVERSED: Fault(
        Reaction.HOLD,
        860,
        _N,
        "The machine does not go where its heading looks",
        "Check that the antennas are not swapped, then arm.",
    ),
    Reason.CARRIER_FAULT: Fault(
        Reaction.RAMP,
        110,
        _N,
        "The vehicle controller reports a fault while driving",
        "Read its fault number, then reset and arm.",
    ),
    Reason.CARRIER_RUNAWAY: Fault(
        Reaction.CUT,
        500,
        _N,
        "The carrier moves faster than it was told, or against it",
        "Secure the machine against rolling, check brake and drive; then reset and arm.",
    ),
    Reason.CARRIER_STUCK: Fault(
        Reaction.HOLD,
        2600,
        _N,
        "The carrier does not move though it is told to",
        "Look for an obstacle or a brake that does not open, then arm.",
    ),
    Reason.STEERING_DISAGREES: Fault(
        Reaction.RAMP,
        310,
        _N,
        "The articulation's encoder and the vehicle controller disagree on the angle",
        "Check the encoder's zero and coupling, then reset and arm.",
    ),
    Reason.TILTED: Fault(
        Reaction.HOLD,
        110,
        _N,
        "The machine leans more than it may while driving",
        "Drive it out by hand, straight down the slope.",
    ),
    Reason.ARMS_FAULT: Fault(
        Reaction.RAMP,
        110,
        _N,
        "The swing-arm controller reports a fault while driving",
        "Check that no two float valves are open, then reset and arm.",
    ),
    Reason.ARM_OUTSIDE: Fault(
        Reaction.HOLD, 60, _A, "The {} arm is outside its travel", "Check the sensor of its height, then arm."
    ),
    Reason.ARM_STUCK: Fault(
        Reaction.HOLD, 2100, _A, "The {} arm does not follow its command", "Look for a stuck valve, then arm."
    ),
    Reason.STEERING_STUCK: Fault(
        Reaction.HOLD,
        900,
        _N,
        "The articulation does not follow its command",
        "Look for a stuck steering valve or something between the wheels, then arm.",
    ),
    Reason.STEERING_RUNAWAY: Fault(
        Reaction.CUT,
        500,
        _N,
        "The articulation bends without a command, or against it",
        "Look for a steering valve stuck open, then reset and arm.",
    ),
}
