"""Plan of a calibration: the pose and the range of each joint's tests, and what they stay clear of.

Every pose of every test keeps the open grapple above ground, bunk and logs, and every joint away from its stops.
Failure: ``InputRefused`` before anything moves.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from itertools import pairwise, permutations, product
from math import hypot
from typing import Final

import numpy as np

from autonomy.calibration.spool_program import PULSES, TURN_TOPS_PCT, predicted_travel, staircase, sweep
from autonomy.calibration.survey import SurveyReading, most_informative_poses
from autonomy.calibration.trace import SpoolTestRecord
from autonomy.calibration.turn_fit import Turn
from can_dbc.messages.crane import GrappleCommand
from machine.geometry.kinematics import pin_position
from machine.joints import JOINTS, Joint
from machine.profile import JointSpec, Profile, joint
from runtime.errors import InputRefused

RANGE_MARGIN: Final = 1.35
"""A joint may travel this many times farther than its profile says: gains differ by a fifth, levers by a tenth."""
BEGIN_SHARE: Final = 0.13
"""Where in their range a joint's tests begin: the way back may be longer than the way out."""
STOP_MARGIN_SHARE, MIN_STOP_MARGIN = 0.03, 0.05
"""Margin of a test at either end of a joint's range: a share of the range, and at least this much [rad, m]."""
TIP_CLEARANCE_M: Final = 0.35
"""Free height below the tips of the open grapple."""
MIN_REACH_M: Final = 2.0
SURVEY_POSE_COUNT: Final = 6
SURVEY_SLEW: Final = (-0.35, 0.0, 0.35)
SURVEY_REACH: Final = (0.15, 0.85)
"""Part of the free ranges used by survey poses: what lies farther out takes long to reach and tells little more."""
MAX_HEIGHT_ABOVE_CLEAR_M: Final = 5.0
"""Greatest height of a pose above the clear height: an upright boom tells little and frightens people."""
TESTED_JOINT_WEIGHT: Final = 6.0
HEIGHT_WEIGHT: Final = 0.3
TRAVEL_WEIGHT_1_S: Final = 0.03
_GRID_COUNT: Final = 9
_BOOM_JOINTS: Final = (Joint.LIFT, Joint.TILT, Joint.EXT)


@dataclass(frozen=True, slots=True)
class JointPlan:
    """The tests of one joint: their start pose, and the range that they may use [rad, m]."""

    joint: Joint
    pose: tuple[float, ...]
    low: float
    high: float
    fastest: float
    """Greatest speed of the tests [rad/s, m/s]."""


@dataclass(frozen=True, slots=True)
class CalibrationPlan:
    """All tests in order.  ``skipped`` are the joints without an encoder; ``turned`` is the one of them that is tested
    by surveyed directions; ``grapple``: whether its times are measured.
    """

    joints: tuple[JointPlan, ...]
    survey: tuple[tuple[float, ...], ...]
    skipped: tuple[Joint, ...]
    clear_z_m: float
    turned: Joint | None = None
    grapple: bool = True


def free_range(spec: JointSpec) -> tuple[float, float]:
    """Return the part of a joint's range that tests may use."""
    margin = max(STOP_MARGIN_SHARE * (spec.upper - spec.lower), MIN_STOP_MARGIN)
    return spec.lower + margin, spec.upper - margin


def clear_height_m(profile: Profile) -> float:
    """Compute the lowest height of the hanger pin at which the open grapple passes over everything, m."""
    top = max(profile.workspace.ground_z_m, profile.bunk.floor_z_m + profile.bunk.stake_height_m)
    return top + max(profile.grapple.jaws.tip_below_pin_m) + TIP_CLEARANCE_M


def required_range(spec: JointSpec) -> float:
    """Compute the greatest travel of the tests of both sides [rad, m]."""
    ways = [
        abs(predicted_travel(program(spec, side), spec, side)) for program in (sweep, staircase) for side in (1, -1)
    ]
    return RANGE_MARGIN * (max(ways[:2]) + max(ways[2:]))


def make_plan(
    profile: Profile, position: Sequence[float], surveyed: bool, chosen: Collection[Joint] = JOINTS
) -> CalibrationPlan:
    """Make the plan from the present joints (``Joint`` order, NaN without an encoder).

    With fewer joints ``chosen``, only these are tested, and not the grapple: enough after a valve was replaced.

    Raises:
        InputRefused: a joint has too little room, or nothing chosen can be tested.
    """
    present_pose = [0.0 if np.isnan(p) else float(p) for p in position]
    clear = clear_height_m(profile)
    blind = tuple(j for j in JOINTS if joint(profile, j).encoder is None)
    plans: list[JointPlan] = []
    for j in JOINTS:
        if j in chosen and j not in blind:
            plans.append(
                _joint_plan(profile, j, plans[-1].pose if plans else present_pose, present_pose[Joint.SLEW], clear)
            )
    survey = _survey_poses(profile, present_pose, clear) if surveyed else ()
    turned = Joint.ROT if surveyed and Joint.ROT in blind and Joint.ROT in chosen else None
    if not plans and turned is None:
        names = ", ".join(j.name.lower() for j in chosen)
        raise InputRefused(
            "calibration.no-encoder", f"{names}: without an encoder only a survey can test it; choose other joints"
        )
    whole = all(j in chosen for j in JOINTS)
    return CalibrationPlan(tuple(plans), survey, blind, clear, turned, grapple=whole)


def _grids(profile: Profile) -> list[list[float]]:
    return [np.linspace(*free_range(joint(profile, j)), _GRID_COUNT).tolist() for j in _BOOM_JOINTS]


def _is_clear(profile: Profile, q: Sequence[float], clear_m: float) -> bool:
    x, y, z = pin_position(profile.kinematics, q)
    return clear_m <= z <= clear_m + MAX_HEIGHT_ABOVE_CLEAR_M and hypot(x, y) >= MIN_REACH_M


def _joint_plan(profile: Profile, which: Joint, before: Sequence[float], slew: float, clear_m: float) -> JointPlan:
    spec = joint(profile, which)
    low, high = free_range(spec)
    needed = required_range(spec)
    name = which.name.lower()
    if needed > high - low:
        raise InputRefused(
            "calibration.range-too-short",
            f"the {name} has {high - low:.2f} of free range, its tests may need {needed:.2f}; lower its speed_limit or "
            "correct full_speed in the profile",
        )
    best: tuple[float, tuple[float, ...], float] | None = None
    for boom in product(*_grids(profile)):
        q = [slew, *boom, 0.0]
        middle = 0.5 * (low + high) if which is Joint.ROT else q[which]
        start = min(max(middle - 0.5 * needed, low), high - needed)
        stretch = [_with(q, which, start + share * needed) for share in (0.0, 0.25, 0.5, 0.75, 1.0)]
        if all(_is_clear(profile, s, clear_m) for s in stretch):
            cost = _cost(profile, which, stretch[2]) + TRAVEL_WEIGHT_1_S * _travel_time_s(profile, before, stretch[0])
            if best is None or cost < best[0]:
                best = (cost, tuple(_with(q, which, start + BEGIN_SHARE * needed)), start)
    if best is None:
        raise InputRefused(
            "calibration.no-clear-pose",
            f"no pose leaves the {name} {needed:.2f} of free travel with the grapple {TIP_CLEARANCE_M} m clear of "
            "ground and bunk; check [workspace], [bunk] and the joint limits in the profile",
        )
    return JointPlan(which, best[1], best[2], best[2] + needed, 0.8 * spec.speed_limit)


def _cost(profile: Profile, which: Joint, q: Sequence[float]) -> float:
    """Compute the cost of a test pose.  A slewing crane should be short and low, so that it rings fast; otherwise the
    tested joint should be in the middle of its range, where a cylinder's lever changes least, and the others near the
    middle.
    """
    off = 0.0
    for j in _BOOM_JOINTS:
        spec = joint(profile, j)
        share = (q[j] - 0.5 * (spec.lower + spec.upper)) / (spec.upper - spec.lower)
        off += (TESTED_JOINT_WEIGHT if j is which else 1.0) * share**2
    if which is Joint.SLEW:
        x, y, z = pin_position(profile.kinematics, q)
        return hypot(x, y) + HEIGHT_WEIGHT * z + 0.1 * off
    return off


def _travel_time_s(profile: Profile, start: Sequence[float], goal: Sequence[float]) -> float:
    """Compute the duration of a move at the speed limit of the slowest joint, s."""
    return max(abs(goal[j] - start[j]) / joint(profile, j).speed_limit for j in JOINTS)


def _with(q: Sequence[float], which: Joint, value: float) -> list[float]:
    changed = list(q)
    changed[which] = value
    return changed


def _survey_poses(profile: Profile, here: Sequence[float], clear_m: float) -> tuple[tuple[float, ...], ...]:
    """Choose the poses that separate offsets from lean, in the fastest order."""
    slew_low, slew_high = free_range(joint(profile, Joint.SLEW))
    slews = sorted({min(max(here[Joint.SLEW] + d, slew_low), slew_high) for d in SURVEY_SLEW})
    grids = []
    for j in _BOOM_JOINTS:
        low, high = free_range(joint(profile, j))
        begin, end = (low + share * (high - low) for share in SURVEY_REACH)
        grids.append(np.linspace(begin, end, 5).tolist())
    candidates = [q for s, *boom in product(slews, *grids) if _is_clear(profile, q := [s, *boom, 0.0], clear_m)]
    chosen = [candidates[i] for i in most_informative_poses(profile.kinematics, candidates, SURVEY_POSE_COUNT)]
    return tuple(_shortest_order(profile, chosen))


def _shortest_order(profile: Profile, poses: Sequence[list[float]]) -> list[tuple[float, ...]]:
    """Put the poses into the order with the least total travel time."""

    def time_s(order: Sequence[Sequence[float]]) -> float:
        return sum(_travel_time_s(profile, p, q) for p, q in pairwise(order))

    return [tuple(q) for q in min(permutations(sorted(poses)), key=time_s)]


def plan_summary(profile: Profile, plan: CalibrationPlan) -> list[str]:
    """List what will move and how far, a line per test, for the person who confirms."""
    lines = []
    for p in plan.joints:
        unit = "m" if p.joint is Joint.EXT else "rad"
        x, y, z = pin_position(profile.kinematics, p.pose)
        lines.append(
            f"{p.joint.name.lower()}: within {p.low:+.2f} to {p.high:+.2f} {unit}, up to {p.fastest:.2f} {unit}/s; "
            f"boom tip at {hypot(x, y):.1f} m reach, {z:.1f} m high"
        )
    lines += [f"{j.name.lower()}: not tested, it has no encoder" for j in plan.skipped if j is not plan.turned]
    if plan.grapple:
        lines.append("grapple: opens, closes and opens once, empty")
    if plan.survey:
        reach = max(hypot(*pin_position(profile.kinematics, q)[:2]) for q in plan.survey)
        lines.append(f"survey: {len(plan.survey)} poses within {reach:.1f} m reach")
    if plan.turned is not None:
        share, far = PULSES[-1]
        speed = share * joint(profile, plan.turned).speed_limit
        name = plan.turned.name.lower()
        lines.append(f"{name}: there and back by {far:.1f} rad at the last pose, up to {speed:.2f} rad/s")
    return lines


# -- The tasks of a calibration in order, and what they record.


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
    """List all tasks in order; first the wiggle of every joint at the present pose."""
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
    """Name a task in a few words; None: nothing has begun."""
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
