"""What a grasp weighs, and whether the machine bears it there: a load beyond that stops the machine in the lift."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from math import cos, inf, pi, sin
from typing import Final

import numpy as np

from autonomy.grasp.planner import NoGrasp
from autonomy.grasp.quality import DENSITY_KG_M3
from autonomy.motion.arm_kinematics import Arm, Pose
from autonomy.perception.log_list import LogObservation
from machine.joints import Joint
from machine.sensing import bearable_load_kg

GREEN_KG_M3: Final = 900.0
"""Density of green wood (birch 850 to 950, `docs/reference/machines.md`)."""
UNSURE_KG: Final = 30.0
"""Two sigmas of the scale (`autonomy.manager.load_detector`): a lighter load cannot be told from none."""
HEAVIER: Final = 1.15
"""A log by its measured size may weigh so much more: wet wood, and 3 cm of 40."""
HEAP_HEAVIER: Final = 1.5
"""The same for several logs of a heap: what they hide comes up with them.  Of 89 heaps that were lifted 18 weighed more
than this times what was seen of them, up to 2.4 times; the lift watches its load as well."""


def wood_kg(logs: Iterable[LogObservation]) -> float:
    """Compute the weight of logs by their measured sizes [kg], of the wood for which grasps are rated; the scale is
    compared with `green_kg`.
    """
    return sum(DENSITY_KG_M3 * pi * (log.diameter_m / 2.0) ** 2 * log.length_m for log in logs)


def green_kg(log: LogObservation) -> float:
    """Estimate the weight of a log of green wood by its size."""
    return GREEN_KG_M3 * pi * (log.diameter_m / 2.0) ** 2 * log.length_m


def is_weighable(logs: Iterable[LogObservation]) -> bool:
    """Tell whether the scale can tell these logs from none."""
    return sum(map(green_kg, logs)) >= UNSURE_KG


def bearable_kg(arm: Arm, q: Sequence[float]) -> float:
    """Compute the greatest load that the machine bears with joints ``q`` and as it stands [kg]; inf where unknown."""
    profile = arm.profile
    if profile.stability is None:
        return inf
    direction = q[Joint.SLEW] + profile.kinematics.theta1_offset_rad
    falls_rad = arm.slope[0] * cos(direction) + arm.slope[1] * sin(direction)
    return bearable_load_kg(profile.stability, profile.kinematics, q, falls_rad)


def refuse_too_heavy(arm: Arm, pose: Pose, kg: float, what: str) -> None:
    """Refuse ``what``, of ``kg`` at most, where the machine does not bear it with the pin at ``pose``.

    Raises:
        NoGrasp: it is too heavy there.
    """
    most_kg = bearable_kg(arm, arm.joints(np.array([pose]))[0].tolist())
    if kg > most_kg:
        raise NoGrasp(
            "grasp.too-heavy",
            f"{what} may weigh {kg:.0f} kg, and {pose.r_m:.1f} m away the machine bears {most_kg:.0f} kg; bring the "
            "machine nearer, or cut shorter logs",
        )
