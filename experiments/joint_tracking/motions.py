"""References of the experiment as functions of their own time: smooth motions between joint poses, ramps and steps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final

from experiments.joint_tracking.testbed import NAMES, Reference
from machine.profile import Profile

START_S: Final = 0.3
"""Every motion starts after this time at rest."""
PEAK_OVER_MEAN: Final = 2.1875
"""Peak speed of the motion profile over its mean (docs/reference/machines.md section 1.6)."""
STEP_S: Final = 0.08
"""A step is as large as the distance of the joint in this time at its speed limit: the gate refuses more."""
RAMP_SHARE: Final = 0.5
RAMP_S: Final = 2.5
RAMP_ENDS_S: Final = 0.8


def smooth(x: float) -> tuple[float, float]:
    """Compute the progress and its rate of s = 35t^4 - 84t^5 + 70t^6 - 20t^7, at rest outside 0..1."""
    if not 0.0 < x < 1.0:
        return (0.0, 0.0) if x <= 0.0 else (1.0, 0.0)
    return x**4 * (35.0 + x * (-84.0 + x * (70.0 - 20.0 * x))), 140.0 * (x * (1.0 - x)) ** 3


def legs(start: Sequence[float], moves: Sequence[tuple[float, float, Mapping[str, float]]]) -> Reference:
    """Add smooth moves, each with start [s], duration [s] and distance of each joint."""

    def reference(time_s: float) -> tuple[list[float], list[float]]:
        q, v = list(start), [0.0] * len(start)
        for begin_s, duration_s, distances in moves:
            done, rate = smooth((time_s - begin_s) / duration_s)
            for name, distance in distances.items():
                j = NAMES.index(name)
                q[j] += distance * done
                v[j] += distance * rate / duration_s
        return q, v

    return reference


def duration_s(profile: Profile, ways: Mapping[str, float], share: float) -> float:
    """Compute the duration [s] of a smooth move whose fastest joint uses this share of its speed limit."""
    return max(
        PEAK_OVER_MEAN * abs(distance) / (share * profile.joints[name].speed_limit) for name, distance in ways.items()
    )


def step(profile: Profile, start: Sequence[float], name: str, side: int) -> tuple[Reference, float]:
    """Make a step of the position, as large as the gate allows, and its time [s]."""
    step_size = side * STEP_S * profile.joints[name].speed_limit

    def reference(time_s: float) -> tuple[list[float], list[float]]:
        q = list(start)
        q[NAMES.index(name)] += step_size if time_s >= START_S else 0.0
        return q, [0.0] * len(q)

    return reference, START_S


def ramp(
    profile: Profile,
    start: Sequence[float],
    name: str,
    side: int,
    share: float = RAMP_SHARE,
    ends_s: float = RAMP_ENDS_S,
) -> tuple[Reference, float]:
    """Make a constant speed, a share of the limit, with smooth ends, and the time of its end [s]."""
    speed = side * share * profile.joints[name].speed_limit
    j = NAMES.index(name)

    def reference(time_s: float) -> tuple[list[float], list[float]]:
        q, v = list(start), [0.0] * len(start)
        t = time_s - START_S
        total = RAMP_S + 2.0 * ends_s
        if 0.0 < t < total:
            rising, ending = min(t / ends_s, 1.0), min((total - t) / ends_s, 1.0)
            v[j] = speed * (3.0 - 2.0 * min(rising, ending)) * min(rising, ending) ** 2
        q[j] += speed * (_risen(t, ends_s) - _risen(t - total + ends_s, ends_s))
        return q, v

    return reference, START_S + RAMP_S + 2.0 * ends_s


def _risen(t: float, ends_s: float) -> float:
    """Compute the time integral of a smoothstep from 0 to 1 over ``ends_s``."""
    x = t / ends_s
    if x <= 0.0:
        return 0.0
    return ends_s * (x**3 * (1.0 - 0.5 * x) if x < 1.0 else x - 0.5)
