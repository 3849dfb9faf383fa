"""The test plan: paper B's four goals from the middle of the trail, repetitions, loads and variants.

Paper B does not state its start.  Here the hanger pin starts above the middle line of the bunk (slew 0), `START_M` from
the slew axis and as high as the arm lifts it there.  A hanging open grapple (1.2 m) is then 0.5 m above the stakes and
stays 0.2 m clear of them on the straight path to the nearest goal.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from autonomy.motion.arm_kinematics import Arm, Pose
from machine.geometry.kinematics import Point
from machine.profile import Profile

PROFILE: Final = "aoro_fc8"
GOALS_M: Final[tuple[Point, ...]] = ((4.27, 1.86, 1.0), (4.27, -1.86, 1.0), (6.0, 1.86, 1.0), (6.0, -1.86, 1.0))
"""Points 1 to 4 of paper B 5.1.3, crane base frame."""
START_M: Final = 3.0
START_HEIGHT_M: Final = 3.5
LOADS_KG: Final = (0.0, 200.0)
REPETITIONS: Final = 20
"""Motions to every goal with the law of the profile: 80 points on every machine, half of them loaded."""
FEW: Final = 2
"""Motions to every goal with the other laws: one empty, one loaded."""
LOADED_ONCE: Final = (1, 2)
"""Goals visited with a load by a variant with one motion to each goal: one near, one far, one on either side."""
OWN: Final = "own"
LAWS: Final = {"pd": "pd", "sliding_mode": "smc", "super_twisting": "sta"}
"""The laws compared, and the prefix of their metrics."""
UNCOMPENSATED, UNCALIBRATED, UNSHAPED = "uncompensated", "uncalibrated", "unshaped"
"""Variants: a profile without sag; the profile as shipped; references of the same duration without swing shaping."""


@dataclass(frozen=True, slots=True)
class Visit:
    """One motion: number of the goal (0 to 3) and the load on the hook [kg]."""

    goal: int
    load_kg: float


def visits(repetitions: int, goals: Sequence[int] = range(len(GOALS_M))) -> list[Visit]:
    """Plan the motions to every goal, empty ones first, alternating between the goals.

    With an odd number of repetitions the last motion is loaded for half of the goals (`LOADED_ONCE`).
    """
    half, odd = divmod(repetitions, 2)
    made = []
    for load in LOADS_KG:
        made += [Visit(g, load) for _ in range(half) for g in goals]
        made += [Visit(g, load) for g in goals if odd and (g in LOADED_ONCE) == (load > 0.0)]
    return made


def repetitions(variant: str) -> int:
    """Return the number of motions of a variant to every goal on one machine."""
    return REPETITIONS if variant == OWN else FEW if variant in LAWS else 1


def law_of(profile: Profile) -> str:
    """Name the law of all joints of a profile; empty if they differ."""
    kinds = {spec.law.kind for spec in profile.joints.values() if spec.encoder is not None}
    return kinds.pop() if len(kinds) == 1 else ""


def variants(own_law: str) -> tuple[str, ...]:
    """List all variants that run on a machine; the law of the profile runs once."""
    return (OWN, *(law for law in LAWS if law != own_law), UNCOMPENSATED, UNCALIBRATED, UNSHAPED)


def pose_at(arm: Arm, point: Point) -> Pose:
    """Compute the pose of the arm with its true pin at a point; the arm chooses the telescope.

    Raises:
        Unreachable: no pose reaches the point.
    """
    return arm.compact_pose_above(*point, point[2])


def start_pose(arm: Arm) -> Pose:
    """Return the start of every motion, above the middle of the trail."""
    return pose_at(arm, (START_M, 0.0, START_HEIGHT_M))
