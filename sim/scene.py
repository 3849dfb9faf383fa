"""Random scenes: where logs lie when a run starts.  Same profile, seed and count, same scene."""

from __future__ import annotations

import math
import random
from dataclasses import dataclass

from machine.profile import Profile
from sim.truth import Contact

TRIES = 100


@dataclass(frozen=True, slots=True)
class LogSpec:
    """A log on the ground: centre (x, y) [m] in the base frame, yaw of its axis from +x [rad], size, density."""

    x_m: float
    y_m: float
    yaw_rad: float
    length_m: float
    diameter_m: float
    density_kg_m3: float


def random_scene(profile: Profile, contact: Contact, seed: int, logs: int) -> tuple[LogSpec, ...]:
    """``logs`` logs inside the profile's pick area, none touching another (machines.md 9: sizes of paper A).

    Raises ValueError when so many logs find no free place.
    """
    rng = random.Random(f"scene {seed}")
    (cx, cy), half = profile.workspace.pick_center_m, profile.workspace.pick_half_size_m
    found: list[LogSpec] = []
    failed = 0
    while len(found) < logs and failed < TRIES:
        spread = contact.log_density_spread * max(-2.0, min(2.0, rng.gauss(0.0, 1.0)))
        spec = LogSpec(
            x_m=cx + rng.uniform(-half, half),
            y_m=cy + rng.uniform(-half, half),
            yaw_rad=rng.uniform(-math.pi / 2, math.pi / 2),
            length_m=rng.uniform(2.5, 2.8),
            diameter_m=rng.uniform(0.10, 0.30),
            density_kg_m3=contact.log_density_kg_m3 * (1.0 + spread),
        )
        if all(_apart(spec, other) for other in found):
            found.append(spec)
            failed = 0
        else:
            failed += 1
    if len(found) < logs:
        raise ValueError(f"the pick area holds no {logs} separate logs; ask for fewer logs or widen pick_half_size_m")
    return tuple(found)


def _apart(a: LogSpec, b: LogSpec) -> bool:
    """Whether the two axes stay further apart than both radii and a hand's breadth (sampled along each log)."""
    limit = (a.diameter_m + b.diameter_m) / 2 + 0.1

    def points(s: LogSpec) -> list[tuple[float, float]]:
        steps = [s.length_m * (i / 20 - 0.5) for i in range(21)]
        return [(s.x_m + t * math.cos(s.yaw_rad), s.y_m + t * math.sin(s.yaw_rad)) for t in steps]

    return all(math.dist(p, q) > limit for p in points(a) for q in points(b))
