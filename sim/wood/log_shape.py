"""One log: where it is released, and its body of solid wood, tapered and bowed.

Log frame: origin on the pith at half length, z along the chord towards the thin end, x towards the side the log bows
to.  ``s`` runs from -0.5 (butt) to 0.5 (thin end).  Pure geometry: no physics client is needed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

from sim.geometry import Quaternion, Vector

DISC_COUNT: Final = 60  # discs over which mass, centre and inertia are summed
STRAIGHT_M: Final = 0.03  # up to this sagitta a log has 3 straight pieces, beyond it 5: less than 4 mm off the arc


@dataclass(frozen=True, slots=True)
class LogSpec:
    """A log and the pose of its release, world frame.

    ``x_m``, ``y_m``: the middle; ``yaw_rad``: of its axis from +x; ``pitch_rad``: + lifts the thin end; ``roll_rad``:
    about its own axis, at 0 it bows downward; ``z_m``: clearance of its lowest line to the ground.  ``diameter_m`` is
    at half length, ``taper_m_m`` the diameter lost per metre of length, ``sweep`` the bow's sagitta as a fraction of
    the length.  ``in_bunk``: the pose is in the bunk's frame, x along it, z above its floor.
    """

    x_m: float
    y_m: float
    yaw_rad: float
    length_m: float
    diameter_m: float
    density_kg_m3: float
    taper_m_m: float = 0.0
    sweep: float = 0.0
    z_m: float = 0.0
    pitch_rad: float = 0.0
    roll_rad: float = 0.0
    in_bunk: bool = False

    @property
    def sweep_m(self) -> float:
        """Sagitta of the bow [m]."""
        return self.sweep * self.length_m

    def radius(self, s: float) -> float:
        """Return the radius [m] at s."""
        return (self.diameter_m - self.taper_m_m * s * self.length_m) / 2

    def axis_point(self, s: float) -> Vector:
        """Compute the pith at s, log frame [m]: a parabola in the x-z plane."""
        return (-4.0 * self.sweep_m * s * s, 0.0, s * self.length_m)

    @property
    def pieces(self) -> int:
        """Number of straight pieces of the body."""
        return 3 if self.sweep_m <= STRAIGHT_M else 5

    def directions(self) -> tuple[Vector, Vector]:
        """Compute the log frame's x and z axis at release: the side it bows to, and along it."""
        cy, sy = math.cos(self.yaw_rad), math.sin(self.yaw_rad)
        cp, sp = math.cos(self.pitch_rad), math.sin(self.pitch_rad)
        cr, sr = math.cos(self.roll_rad), math.sin(self.roll_rad)
        down = (sp * cy, sp * sy, -cp)
        return (cr * down[0] - sr * sy, cr * down[1] + sr * cy, cr * down[2]), (cp * cy, cp * sy, sp)

    def spine(self, points: int = 11) -> list[Vector]:
        """Compute points of the pith at release, relative to the middle [m]."""
        x, z = self.directions()
        out = []
        for i in range(points):
            bow, _, along = self.axis_point(i / (points - 1) - 0.5)
            out.append((bow * x[0] + along * z[0], bow * x[1] + along * z[1], bow * x[2] + along * z[2]))
        return out


@dataclass(frozen=True, slots=True)
class Mass:
    """Mass [kg], centre of mass in the log frame [m], principal inertia [kg m^2] in axes turned about y by ``turn``."""

    mass_kg: float
    com_m: Vector
    inertia_kg_m2: Vector
    turn_rad: float


def mass_of(spec: LogSpec) -> Mass:
    """Compute the mass properties of the tapered, bowed log."""
    step = spec.length_m / DISC_COUNT
    discs = []
    for i in range(DISC_COUNT):
        s = (i + 0.5) / DISC_COUNT - 0.5
        r = spec.radius(s)
        discs.append((spec.density_kg_m3 * math.pi * r * r * step, r, spec.axis_point(s)))
    mass = sum(m for m, _, _ in discs)
    cx, cz = sum(m * at[0] for m, _, at in discs) / mass, sum(m * at[2] for m, _, at in discs) / mass
    xx = yy = zz = xz = 0.0
    for m, r, at in discs:
        x, z, across = at[0] - cx, at[2] - cz, (3.0 * r * r + step * step) / 12.0
        xx += m * (across + z * z)
        yy += m * (across + x * x + z * z)
        zz += m * (r * r / 2.0 + x * x)
        xz -= m * x * z
    a = 0.5 * math.atan2(-2.0 * xz, xx - zz)
    c, s = math.cos(a), math.sin(a)
    first = c * c * xx - 2.0 * c * s * xz + s * s * zz
    last = s * s * xx + 2.0 * c * s * xz + c * c * zz
    return Mass(mass, (cx, 0.0, cz), (first, yy, last), a)


def log_segments(spec: LogSpec) -> list[tuple[Vector, Vector, float, float]]:
    """Cut the body into coaxial pieces: both ends of each in the log frame [m] and the radii there [m]."""
    n = spec.pieces
    knots = [i / n - 0.5 for i in range(n + 1)]
    return [(spec.axis_point(a), spec.axis_point(b), spec.radius(a), spec.radius(b)) for a, b in pairwise(knots)]


def quaternion_of(spec: LogSpec) -> Quaternion:
    """Compute the orientation (x, y, z, w) of the log frame at release: yaw, then pitch, then roll."""
    h, p, r = spec.yaw_rad / 2, (math.pi / 2 - spec.pitch_rad) / 2, spec.roll_rad / 2
    yaw, pitch = (0.0, 0.0, math.sin(h), math.cos(h)), (0.0, math.sin(p), 0.0, math.cos(p))
    return _times(_times(yaw, pitch), (0.0, 0.0, math.sin(r), math.cos(r)))


def _times(a: Quaternion, b: Quaternion) -> Quaternion:
    return (
        a[3] * b[0] + a[0] * b[3] + a[1] * b[2] - a[2] * b[1],
        a[3] * b[1] - a[0] * b[2] + a[1] * b[3] + a[2] * b[0],
        a[3] * b[2] + a[0] * b[1] - a[1] * b[0] + a[2] * b[3],
        a[3] * b[3] - a[0] * b[0] - a[1] * b[1] - a[2] * b[2],
    )
