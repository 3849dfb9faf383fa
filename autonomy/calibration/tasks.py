"""What a calibration does, piece by piece, and what it brings home."""

from __future__ import annotations

from dataclasses import dataclass, field

from autonomy.calibration.plan import Plan
from autonomy.calibration.program import PULSES
from autonomy.calibration.survey import Reading
from autonomy.calibration.trace import Record
from autonomy.calibration.turn_fit import Turn
from can_dbc.setpoint import GrappleCommand
from machine.joints import Joint


@dataclass(frozen=True, slots=True)
class Travel:
    """An ordinary motion to a pose."""

    pose: tuple[float, ...]
    why: str


@dataclass(frozen=True, slots=True)
class Spool:
    """One spool program: ``kind`` is wiggle, sweep or staircase."""

    joint: Joint
    side: int
    kind: str


@dataclass(frozen=True, slots=True)
class Grip:
    """The grapple opens or closes, the crane stands."""

    command: GrappleCommand


@dataclass(frozen=True, slots=True)
class Look:
    """Stand still until the surveyor has read the pin's position."""

    number: int


@dataclass(frozen=True, slots=True)
class Pulse:
    """A joint without an encoder turns by its spool alone, by the profile at a ``share`` of its speed limit, to an
    angle counted from where it stood before its first pulse [rad].
    """

    joint: Joint
    side: int
    share: float
    to_rad: float


@dataclass(frozen=True, slots=True)
class Bearing:
    """Stand still until the surveyor has read the grapple's direction."""

    number: int


Task = Travel | Spool | Grip | Look | Pulse | Bearing


@dataclass(slots=True)
class Findings:
    """What a run has brought home."""

    wiggles: list[Record] = field(default_factory=list)
    tests: list[Record] = field(default_factory=list)
    grapple_s: dict[GrappleCommand, float] = field(default_factory=dict)
    readings: list[Reading] = field(default_factory=list)
    turns: list[Turn] = field(default_factory=list)


def tasks_of(plan: Plan) -> list[Task]:
    """Everything in order: first every joint's wiggle where the crane stands, inward first."""
    tasks: list[Task] = []
    for p in plan.joints:
        tasks += [Spool(p.joint, +1, "wiggle"), Spool(p.joint, -1, "wiggle")]
    for p in plan.joints:
        tasks.append(Travel(p.pose, f"to the start of the {p.joint.name.lower()}'s tests"))
        for side in (+1, -1):
            tasks += [Spool(p.joint, side, "sweep"), Spool(p.joint, side, "staircase")]
    tasks += [Grip(GrappleCommand.OPEN), Grip(GrappleCommand.CLOSE), Grip(GrappleCommand.OPEN)]
    for number, pose in enumerate(plan.survey):
        tasks += [Travel(pose, f"to survey pose {number + 1}"), Look(number)]
    if plan.turned is not None:
        tasks.append(Bearing(0))
        pulses = [Pulse(plan.turned, s, share, to) for share, far in PULSES for s, to in ((+1, far), (-1, 0.0))]
        for number, pulse in enumerate(pulses):
            tasks += [pulse, Bearing(number + 1)]
    return tasks
