"""The guard's rules by number, and those whose violation only a person ends."""

from __future__ import annotations

from enum import IntEnum
from typing import Final

NO_AXIS: Final = 15
"""``FaultAxis``: 0 to 4 are the joints; ..."""
ROTATOR_AXIS, GRAPPLE_AXIS, AUX_AXIS, DRIVE_AXIS, STEER_AXIS, ARMS_AXIS = 4, 5, 6, 7, 8, 9


class Verdict(IntEnum):
    """The broken rule; the number of ``GuardStat.Verdict`` and ``GuardAlive.Verdict``."""

    GOOD = 0
    NO_COMMAND = 1  # a command is missing or too old
    CORRUPT = 2  # too many commands with a wrong checksum or length
    OTHER_GUARD = 3  # another node sends the guard's frames
    RANGE = 4  # a command out of its range, of an unknown mode, or for a function that does not exist
    RATE = 5  # a command that grows faster than the machine may
    NOT_ARMED = 6  # a motion is commanded without the arm key
    ESTOP = 7  # the emergency stop is pressed, or its channels differ
    ENCODER = 8  # a motion is commanded for a joint whose encoder is silent
    OUTSIDE = 9  # a motion further out is commanded for a joint outside its range
    CALMING = 10  # no rule is broken, but not for long enough
    STALE = 11  # commands come late, or some are missing in between
    ESTOP_LOST = 12  # the emergency stop is not received
    LATCHED = 13  # no rule is broken, but nobody has pressed reset since one of `LATCHING` was
    SPOOL = 14  # a spool is open that nobody commands to open
    MOVING = 15  # a joint or the carrier moves without a command
    PERSON = 16  # a motion is commanded while a person is in the machine's zone
    REACH = 17  # a motion is commanded that brings the pin below the ground or into a box of the envelope
    DISAGREE = 18  # a motion is commanded by a controller that does not say that it operates
    BOTH = 19  # crane and carrier move at once
    CARRIER_LOST = 20  # a motion of the carrier is commanded, and its state is not received
    OVERSPEED = 21  # a joint moves faster than the envelope allows


LATCHING: Final = frozenset(Verdict) - {
    Verdict.GOOD, Verdict.NO_COMMAND, Verdict.ENCODER, Verdict.CALMING, Verdict.STALE, Verdict.ESTOP_LOST,
    Verdict.LATCHED, Verdict.CARRIER_LOST,
}  # fmt: skip
"""Rules whose violation is something heard, not silence: only a person allows motion again."""

Finding = tuple[Verdict, int]
"""The broken rule and its axis."""
FINE: Final[Finding] = (Verdict.GOOD, NO_AXIS)
