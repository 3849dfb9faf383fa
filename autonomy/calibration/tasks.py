"""The tasks of a calibration in order, and what they record."""

from __future__ import annotations

from dataclasses import dataclass, field

from autonomy.calibration.plan import CalibrationPlan
from autonomy.calibration.spool_program import PULSES, TURN_TOPS_PCT
from autonomy.calibration.survey import SurveyReading
from autonomy.calibration.trace import SpoolTestRecord
from autonomy.calibration.turn_fit import Turn
from can_dbc.messages.crane import GrappleCommand
from machine.joints import Joint
from machine.profile import JointSpec


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
class TurnSearchTask:
    """Open the valve of a joint without an encoder slowly up to a top: has it turned?"""

    joint: Joint
    side: int
    top_pct: float


@dataclass(frozen=True, slots=True)
class YawReadingTask:
    """Stand still until the surveyor has read the grapple's direction."""

    number: int


Task = MoveTask | SpoolTask | GrappleTask | PinReadingTask | PulseTask | TurnSearchTask | YawReadingTask


@dataclass(slots=True)
class Findings:
    """The records of a run."""

    wiggles: list[SpoolTestRecord] = field(default_factory=list)
    tests: list[SpoolTestRecord] = field(default_factory=list)
    grapple_s: dict[GrappleCommand, float] = field(default_factory=dict)
    readings: list[SurveyReading] = field(default_factory=list)
    turns: list[Turn] = field(default_factory=list)
    searched: list[Turn] = field(default_factory=list)
    """The turns, and rests, of the search for the dead-band of a rotator without an encoder."""
    specs: dict[Joint, JointSpec] = field(default_factory=dict)
    """Joints with the valves that their first wiggles have shown, in place of the profile's."""
    travelled_by_spool: bool = False
    """Whether the profile's valves were too far off for ordinary motions."""


def build_tasks(plan: CalibrationPlan) -> list[Task]:
    """All tasks in order; first the wiggle of every joint at the present pose."""
    tasks: list[Task] = []
    for p in plan.joints:
        tasks += [SpoolTask(p.joint, +1, "wiggle"), SpoolTask(p.joint, -1, "wiggle")]
    for p in plan.joints:
        tasks.append(MoveTask(p.pose, f"to the start of the {p.joint.name.lower()}'s tests"))
        for side in (+1, -1):
            tasks += [SpoolTask(p.joint, side, "sweep"), SpoolTask(p.joint, side, "staircase")]
    if plan.grapple:
        tasks += [GrappleTask(c) for c in (GrappleCommand.OPEN, GrappleCommand.CLOSE, GrappleCommand.OPEN)]
    for number, pose in enumerate(plan.survey):
        tasks += [MoveTask(pose, f"to survey pose {number + 1}"), PinReadingTask(number)]
    if plan.turned is not None:
        tasks.append(YawReadingTask(0))
        for side in (+1, -1):
            for top_pct in TURN_TOPS_PCT:
                tasks += [TurnSearchTask(plan.turned, side, top_pct), YawReadingTask(0)]
        pulses = [PulseTask(plan.turned, s, share, to) for share, far in PULSES for s, to in ((+1, far), (-1, 0.0))]
        for number, pulse in enumerate(pulses):
            tasks += [pulse, YawReadingTask(number + 1)]
    return tasks


def task_name(task: Task | None) -> str:
    """A task in a few words; None: nothing has begun."""
    match task:
        case SpoolTask(joint=j, side=side, kind=kind):
            return f"{j.name.lower()} {'+' if side > 0 else '-'} {kind}"
        case MoveTask(why=why):
            return f"travels {why}"
        case GrappleTask(command=command):
            return f"grapple: {command.name.lower()}"
        case PinReadingTask(number=number):
            return f"survey pose {number + 1}"
        case PulseTask(joint=j, side=side) | TurnSearchTask(joint=j, side=side):
            return f"{j.name.lower()} {'+' if side > 0 else '-'} turn"
        case YawReadingTask(number=number):
            return f"direction of the grapple {number + 1}"
    return "waiting"
