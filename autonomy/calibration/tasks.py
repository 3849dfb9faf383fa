"""The tasks of a calibration in order, and what they record."""

from __future__ import annotations

from dataclasses import dataclass, field

from autonomy.calibration.plan import CalibrationPlan
from autonomy.calibration.spool_program import PULSES
from autonomy.calibration.survey import SurveyReading
from autonomy.calibration.trace import SpoolTestRecord
from autonomy.calibration.turn_fit import Turn
from can_dbc.messages.crane import GrappleCommand
from machine.joints import Joint


@dataclass(frozen=True, slots=True)
class MoveTask:
    """An ordinary motion to a pose."""

    pose: tuple[float, ...]
    why: str


@dataclass(frozen=True, slots=True)
class SpoolTask:
    """One spool program: ``kind`` is wiggle, sweep or staircase."""

    joint: Joint
    side: int
    kind: str


@dataclass(frozen=True, slots=True)
class GrappleTask:
    """Open or close the grapple while the crane stands."""

    command: GrappleCommand


@dataclass(frozen=True, slots=True)
class PinReadingTask:
    """Stand still until the surveyor has read the pin's position."""

    number: int


@dataclass(frozen=True, slots=True)
class PulseTask:
    """Turn a joint without an encoder by its spool alone, at a ``share`` of its speed limit by the profile, to an angle
    counted from its angle before the first pulse [rad].
    """

    joint: Joint
    side: int
    share: float
    to_rad: float


@dataclass(frozen=True, slots=True)
class YawReadingTask:
    """Stand still until the surveyor has read the grapple's direction."""

    number: int


Task = MoveTask | SpoolTask | GrappleTask | PinReadingTask | PulseTask | YawReadingTask


@dataclass(slots=True)
class Findings:
    """The records of a run."""

    wiggles: list[SpoolTestRecord] = field(default_factory=list)
    tests: list[SpoolTestRecord] = field(default_factory=list)
    grapple_s: dict[GrappleCommand, float] = field(default_factory=dict)
    readings: list[SurveyReading] = field(default_factory=list)
    turns: list[Turn] = field(default_factory=list)


def build_tasks(plan: CalibrationPlan) -> list[Task]:
    """All tasks in order; first the wiggle of every joint at the present pose."""
    tasks: list[Task] = []
    for p in plan.joints:
        tasks += [SpoolTask(p.joint, +1, "wiggle"), SpoolTask(p.joint, -1, "wiggle")]
    for p in plan.joints:
        tasks.append(MoveTask(p.pose, f"to the start of the {p.joint.name.lower()}'s tests"))
        for side in (+1, -1):
            tasks += [SpoolTask(p.joint, side, "sweep"), SpoolTask(p.joint, side, "staircase")]
    tasks += [GrappleTask(GrappleCommand.OPEN), GrappleTask(GrappleCommand.CLOSE), GrappleTask(GrappleCommand.OPEN)]
    for number, pose in enumerate(plan.survey):
        tasks += [MoveTask(pose, f"to survey pose {number + 1}"), PinReadingTask(number)]
    if plan.turned is not None:
        tasks.append(YawReadingTask(0))
        pulses = [PulseTask(plan.turned, s, share, to) for share, far in PULSES for s, to in ((+1, far), (-1, 0.0))]
        for number, pulse in enumerate(pulses):
            tasks += [pulse, YawReadingTask(number + 1)]
    return tasks
