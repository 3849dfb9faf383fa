"""Faults while driving: position, heading, carrier, steering, swing arms."""

from __future__ import annotations

from typing import Final

from machine.status.reasons import DetailKind, Fault, Reaction, Reason

_N, _A = DetailKind.NOTHING, DetailKind.ARM

DRIVING: Final[dict[Reason, Fault]] = {
    Reason.POSITION_LOST: Fault(
        Reaction.HOLD,
        510,
        _N,
        "The position was lost while driving to a waypoint",
        "Check the GNSS receiver, then arm.",
    ),
    Reason.HEADING_LOST: Fault(
        Reaction.HOLD, 310, _N, "The heading was lost while driving to a waypoint", "Check both antennas, then arm."
    ),
    Reason.FIX_LOST: Fault(
        Reaction.HOLD,
        1200,
        _N,
        "The position is neither RTK fixed nor float while driving to a waypoint",
        "Wait for the fix, or check the correction service; then arm.",
    ),
    Reason.POSITION_JUMP: Fault(
        Reaction.HOLD,
        310,
        _N,
        "The position jumped while driving to a waypoint",
        "Compare it with where the machine is, then arm.",
    ),
    Reason.HEADING_JUMP: Fault(
        Reaction.HOLD,
        310,
        _N,
        "The heading jumped while driving to a waypoint",
        "Compare it with the direction of the front half, then arm.",
    ),
    Reason.HEADING_FROZEN: Fault(
        Reaction.HOLD,
        710,
        _N,
        "The heading does not change while the machine turns",
        "Restart the GNSS receiver, then arm.",
    ),
    Reason.HEADING_REVERSED: Fault(
        Reaction.HOLD,
        860,
        _N,
        "The machine does not move in the direction of its heading",
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
        "The carrier moves faster than commanded, or in the opposite direction",
        "Secure the machine against rolling, check brake and drive; then reset and arm.",
    ),
    Reason.CARRIER_STUCK: Fault(
        Reaction.HOLD,
        2600,
        _N,
        "The carrier does not move although it is commanded to",
        "Check for an obstacle or a brake that does not open, then arm.",
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
        "The machine tilts beyond the limit for driving",
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
        Reaction.HOLD, 2100, _A, "The {} arm does not follow its command", "Check for a stuck valve, then arm."
    ),
    Reason.STEERING_STUCK: Fault(
        Reaction.HOLD,
        900,
        _N,
        "The articulation does not follow its command",
        "Check for a stuck steering valve or an object between the wheels, then arm.",
    ),
    Reason.STEERING_RUNAWAY: Fault(
        Reaction.CUT,
        500,
        _N,
        "The articulation moves without a command, or against it",
        "Check for a steering valve stuck open, then reset and arm.",
    ),
}
