"""Which motions are made: paper B's four goals from the middle of the trail, how often, with which load, by whom.

Paper B does not give its start.  Here the hanger pin stands over the middle line of the bunk (slew 0), `START_M` from
the slew axis and as high as the arm lifts it there: a hanging open grapple (1.2 m) is 0.5 m above the stakes, and on
the straight way to the nearest goal it stays 0.2 m clear of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from autonomy.motion.arm import Arm
from autonomy.motion.pose import Pose
from machine.kinematics import Point
from machine.profile import Profile

PROFILE: Final = "aoro_fc8"
GOALS_M: Final[tuple[Point, ...]] = ((4.27, 1.86, 1.0), (4.27, -1.86, 1.0), (6.0, 1.86, 1.0), (6.0, -1.86, 1.0))
"""Points 1 to 4 of paper B 5.1.3, crane base frame."""
START_M: Final = 3.0
START_HEIGHT_M: Final = 3.5
LOADS_KG: Final = (0.0, 200.0)
REPETITIONS: Final = 20
"""Of every goal by the profile's own law: 80 points on every machine, half of them loaded."""
FEW: Final = 2
"""Of every goal by the other laws: one empty, one loaded."""
LOADED_ONCE: Final = (1, 2)
"""Goals that a variant with one motion to each goal visits loaded: one near and one far, one on either side."""
OWN: Final = "own"
LAWS: Final = {"pd": "pd", "sliding_mode": "smc", "super_twisting": "sta"}
"""Laws that are compared and the prefix of their metrics."""
UNCOMPENSATED, UNCALIBRATED, UNSHAPED = "uncompensated", "uncalibrated", "unshaped"
"""A profile without sag; the profile as shipped; references of the same duration that leave the grapple swinging."""


@dataclass(frozen=True, slots=True)
class Visit:
    """One motion: number of the goal (0 to 3) and the load on the hook [kg]."""

    goal: int
    load_kg: float


def visits(repetitions: int, goals: Sequence[int] = range(len(GOALS_M))) -> list[Visit]:
    """Every goal so often, the empty half first, going round the goals; of an odd number, half of the goals' last
    motions are loaded (`LOADED_ONCE`).
    """
    half, odd = divmod(repetitions, 2)
    made = []
    for load in LOADS_KG:
        made += [Visit(g, load) for _ in range(half) for g in goals]
        made += [Visit(g, load) for g in goals if odd and (g in LOADED_ONCE) == (load > 0.0)]
    return made


def repetitions(variant: str) -> int:
    """How often a variant moves to every goal of a machine."""
    return REPETITIONS if variant == OWN else FEW if variant in LAWS else 1


def law_of(profile: Profile) -> str:
    """The law that all joints of a profile have; empty when they differ."""
    kinds = {spec.law.kind for spec in profile.joints.values() if spec.encoder is not None}
    return kinds.pop() if len(kinds) == 1 else ""


def variants(own_law: str) -> tuple[str, ...]:
    """Everything that runs on a machine; the profile's own law is not tried twice."""
    return (OWN, *(law for law in LAWS if law != own_law), UNCOMPENSATED, UNCALIBRATED, UNSHAPED)


def pose_at(arm: Arm, point: Point) -> Pose:
    """The arm's pose with its true pin at a point, the telescope as it is easy for the arm.

    Raises:
        Unreachable: with the reason.
    """
    return arm.reach(*point, point[2])


def start_pose(arm: Arm) -> Pose:
    """The middle of the trail."""
    return pose_at(arm, (START_M, 0.0, START_HEIGHT_M))
