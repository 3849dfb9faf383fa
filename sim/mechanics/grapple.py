"""The grapple's steel: jaw geometry fitted to the profile's table, boxes of jaws and rotator
(docs/reference/machines.md section 1.5).

A jaw is a straight chord from pivot to tip in the plane of its motion; at angle 0 (fully open) the chord points
outward and down from the pivot.  The jaws interleave: two blades left, one right, all with cross plates, so that a log
cannot wedge between the blades.  Links: jaw frames at the pivots, z up, tips at -z; the rotator frame at its joint.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from machine.profile import Kinematics, Profile
from sim.geometry import IDENTITY, Shape, Vector, rpy_quaternion

PIVOT_Y_M = -0.0193
PALMS_CHORD_M = 0.648  # blades, widths and beam below belong to this grapple; others are scaled by their chord
# (along, across) the chord from pivot to tip, in chord lengths: a claw, bulging outward.
JAW_PROFILE_CHORDS = ((0.0, 0.0), (0.06, 0.13), (0.29, 0.205), (0.585, 0.20), (0.85, 0.12), (1.0, 0.0))
PLATE_M = (0.035, 0.035, 0.035, 0.03, 0.022)  # per segment: the tips are sharp to get under a thin log


@dataclass(frozen=True, slots=True)
class JawGeometry:
    """Pivots at (-+pivot_x_m, -pivot_z_m) of the rotator frame; tips at (-+out_m, -down_m) of the open jaw frames."""

    pivot_x_m: float
    pivot_z_m: float
    out_m: float
    down_m: float
    closed_rad: float

    @property
    def chord_m(self) -> float:
        """Pivot to tip."""
        return math.hypot(self.out_m, self.down_m)


def jaw_geometry(profile: Profile) -> JawGeometry:
    """Fit pivots and chord to the profile's table by least squares.

    half gap = x + out cos(a) - down sin(a), tip below pivot = out sin(a) + down cos(a).
    """
    k, table = profile.kinematics, profile.grapple.jaws
    hanging = k.hanger_to_fork_m + k.fork_to_rotator_m + k.rotator_to_tong_pivot_m
    rows: list[tuple[tuple[float, float, float], float]] = []
    for a, gap, below in zip(table.angle_rad, table.half_gap_m, table.tip_below_pin_m, strict=True):
        c, s = math.cos(a), math.sin(a)
        rows += [((1.0, c, -s), gap), ((0.0, s, c), below - hanging)]
    normal = [[sum(r[i] * r[j] for r, _ in rows) for j in range(3)] for i in range(3)]
    right = [sum(r[i] * y for r, y in rows) for i in range(3)]
    x, out, down = _solve3(normal, right)
    return JawGeometry(x, k.rotator_to_tong_pivot_m, out, down, table.angle_rad[-1])


def _solve3(m: list[list[float]], y: Sequence[float]) -> tuple[float, float, float]:
    """Solve by Cramer's rule."""

    def det(a: list[list[float]]) -> float:
        return (
            a[0][0] * (a[1][1] * a[2][2] - a[1][2] * a[2][1])
            - a[0][1] * (a[1][0] * a[2][2] - a[1][2] * a[2][0])
            + a[0][2] * (a[1][0] * a[2][1] - a[1][1] * a[2][0])
        )

    whole = det(m)
    x = [det([[y[i] if j == k else m[i][j] for j in range(3)] for i in range(3)]) / whole for k in range(3)]
    return (x[0], x[1], x[2])


def jaw_points(jaws: JawGeometry, side: int) -> list[tuple[float, float]]:
    """Return the polyline (x, z) [m] of a jaw in its link frame at angle 0; side -1 left, +1 right."""
    x, z = jaws.out_m, jaws.down_m
    return [(side * (a * x + b * z), -a * z + b * x) for a, b in JAW_PROFILE_CHORDS]


def grapple_shapes(profile: Profile) -> list[Shape]:
    """Return the boxes of fork, rotator and jaws.

    The beam between the pivots is slim and lies above them, because a thick log needs the room between the jaws.
    """
    k: Kinematics = profile.kinematics
    jaws = jaw_geometry(profile)
    scale = jaws.chord_m / PALMS_CHORD_M
    dark, red = (0.2, 0.2, 0.22), (0.8, 0.2, 0.15)
    rotator, fork, z = k.rotator_to_tong_pivot_m, k.fork_to_rotator_m, -jaws.pivot_z_m
    shapes = [
        Shape("hanger", (0.08, 0.08, k.hanger_to_fork_m), (0.0, 0.0, -k.hanger_to_fork_m / 2), IDENTITY, dark, False),
        Shape("fork", (0.14, 0.14, fork), (0.0, 0.0, -fork / 2), IDENTITY, dark, False),
        Shape("rotator", (0.22, 0.22, rotator / 2), (0.0, 0.0, -rotator / 4), IDENTITY, dark),
        Shape("rotator", (2 * jaws.pivot_x_m + 0.06, 0.16 * scale, 0.08), (0.0, PIVOT_Y_M, z + 0.07), IDENTITY, dark),
    ]
    for side, link in ((-1, "tong_left"), (1, "tong_right")):
        points = jaw_points(jaws, side)
        for (x0, z0), (x1, z1), thick in zip(points, points[1:], PLATE_M, strict=False):
            length, x, z = math.hypot(x1 - x0, z1 - z0), (x0 + x1) / 2, (z0 + z1) / 2
            turn = rpy_quaternion(0.0, -math.atan2(z1 - z0, x1 - x0))

            def plate(y: float, extra: float, width: float) -> None:
                at: Vector = (x, y - PIVOT_Y_M, z)  # noqa: B023
                shapes.append(Shape(link, (length + extra, width, thick), at, turn, red))  # noqa: B023

            if side < 0:
                for y in (-0.14 * scale, 0.14 * scale):
                    plate(y, 0.02, 0.08 * scale)
            plate(0.0, 0.0, (0.36 if side < 0 else 0.19) * scale)
    return shapes
