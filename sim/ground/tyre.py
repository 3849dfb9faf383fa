"""Tyres on the ground: forces of the wheels for one physics step, compiled; no Bullet, no clock.

Normal force: spring and damper on a plane fitted to nine points of the ground under the tyre, because a soft carcass
envelopes the ground.  Tangential force: one bristle per wheel in the plane of contact (Dahl's pre-sliding spring with
LuGre's damper), with the friction circle as its yield surface, so that a stuck tyre is a spring that never creeps.
Rolling carries bristles out of the contact within a relaxation length sigma:

    z' = s - |r w| / sigma z,    F = -(k z + c z'),    |F| <= mu N,    s = hub velocity at the ground - r w

which gives the slip stiffness k sigma of a rolling tyre.  The wheel's spin w is a state of its own: hydrostatic motor
torque, brake and rolling resistance (both friction that can hold) and the tyre's pull turn it.  Neither turn slip nor
camber thrust is modelled.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from sim.ground.terrain import surface_height

SUBSTEP_COUNT: Final = 4
FOOTPRINT_RADII: Final = 0.4  # half length of the contact patch that envelopes the ground, in wheel radii
Array = NDArray[np.float64]


class Tyre(NamedTuple):
    """The constants of a run, as in ``sim.truth.body``."""

    radius_m: float
    width_m: float
    spin_inertia_kg_m2: float
    stiffness_n_m: float
    damping_n_s_m: float
    tread_n_m: float
    tread_n_s_m: float
    relaxation_m: float
    friction: float
    rolling_resistance: float
    slip_limit: float


@njit(cache=True)
def _held(w: float, free: float, capacity: float, inertia: float, h: float) -> float:
    """Compute the torque of a friction that stops the speed ``w`` if it can: ``free`` is all other torque."""
    stopping_torque_nm = -(inertia * w / h + free)
    return min(max(stopping_torque_nm, -capacity), capacity)


@njit(cache=True)
def wheel_step(
    tyre: Tyre,
    arms: Array,
    hub_x: Array,
    spin: Array,
    angle: Array,
    bristle: Array,
    torque: float,
    top_spin: float,
    brake: float,
    step_s: float,
    x0: float,
    y0: float,
    cell: float,
    heights: Array,
    out: Array,
    contact: Array,
) -> None:
    """Advance the wheels' spin [rad/s, absolute], angle against the arm [rad] and bristles [m] and give the forces.

    ``arms``: a row per wheel of its arm's frame (position, quaternion x y z w), centre of mass, velocity of that and
    angular velocity, in the world (16 numbers); the hub is at (``hub_x``, 0, 0) in that frame, its axle the y axis,
    to the left.  ``torque``: motor torque [Nm] each wheel is offered; it fades out once a wheel runs
    ``slip_limit`` faster than ``top_spin`` (anti-spin).  ``brake``: torque capacity of a brake [Nm].
    ``out``: a row per wheel of the force on its arm and the moment of it about the arm's centre of mass, world
    (6 numbers).  ``contact``: a row per wheel of contact point, world, and normal load [N] (4 numbers).
    """
    h = step_s / SUBSTEP_COUNT
    for k in range(arms.shape[0]):
        a = arms[k]
        ox, oy, oz, qx, qy, qz, qw = a[0], a[1], a[2], a[3], a[4], a[5], a[6]
        gx, gy, gz, vx, vy, vz, wx, wy, wz = a[7], a[8], a[9], a[10], a[11], a[12], a[13], a[14], a[15]
        ax, ay, az = 2.0 * (qx * qy - qz * qw), 1.0 - 2.0 * (qx * qx + qz * qz), 2.0 * (qy * qz + qx * qw)
        px = ox + hub_x[k] * (1.0 - 2.0 * (qy * qy + qz * qz))
        py = oy + hub_x[k] * 2.0 * (qx * qy + qz * qw)
        pz = oz + hub_x[k] * 2.0 * (qx * qz - qy * qw)
        # Horizontal direction of travel, and the ground fitted in it and across it.
        length = math.sqrt(ax * ax + ay * ay)
        cx, cy = ay / length, -ax / length
        fore, side = FOOTPRINT_RADII * tyre.radius_m, 0.35 * tyre.width_m
        total, rise_fore, rise_side = 0.0, 0.0, 0.0
        for i in range(-1, 2):
            for j in range(-1, 2):
                x, y = px + i * fore * cx - j * side * cy, py + i * fore * cy + j * side * cx
                z = surface_height(x, y, x0, y0, cell, heights)
                total += z
                rise_fore += i * z
                rise_side += j * z
        g, s = rise_fore / (6.0 * fore), rise_side / (6.0 * side)
        nx, ny = -(g * cx - s * cy), -(g * cy + s * cx)
        length = math.sqrt(1.0 + nx * nx + ny * ny)
        nx, ny, nz = nx / length, ny / length, 1.0 / length
        # The wheel's lowest radius, forward and sideways in the plane of the ground.
        an = ax * nx + ay * ny + az * nz
        inner = math.sqrt(1.0 - an * an)
        rx, ry, rz = (nx - an * ax) / inner, (ny - an * ay) / inner, (nz - an * az) / inner
        tx, ty, tz = (ay * nz - az * ny) / inner, (az * nx - ax * nz) / inner, (ax * ny - ay * nx) / inner
        lx, ly, lz = ny * tz - nz * ty, nz * tx - nx * tz, nx * ty - ny * tx
        reach = (pz - total / 9.0) * nz / inner  # along the radius from the hub to the ground
        depth = (tyre.radius_m - reach) * inner
        bx, by, bz = -reach * rx, -reach * ry, -reach * rz
        dx, dy, dz = px + bx - gx, py + by - gy, pz + bz - gz
        ux, uy, uz = vx + wy * dz - wz * dy, vy + wz * dx - wx * dz, vz + wx * dy - wy * dx
        # The arm does not roll on the ground: its rotation about the axle is not the wheel's.
        turn = wx * ax + wy * ay + wz * az
        forward = ux * tx + uy * ty + uz * tz + turn * reach
        across = ux * lx + uy * ly + uz * lz
        down = -(ux * nx + uy * ny + uz * nz)
        load = 0.0
        if depth > 0.0:
            load = max(0.0, tyre.stiffness_n_m * depth + tyre.damping_n_s_m * down)
        grip, rolling = tyre.friction * load, tyre.rolling_resistance * load * reach
        w, q0, q1 = spin[k], bristle[k, 0], bristle[k, 1]
        sum_t, sum_l, sum_reaction = 0.0, 0.0, 0.0
        for _ in range(SUBSTEP_COUNT):
            slip = forward - reach * w
            # Implicit in the relaxation, so that no speed makes it unstable.
            keep = 1.0 / (1.0 + h * abs(reach * w) / tyre.relaxation_m)
            e0, e1 = (q0 + h * slip) * keep, (q1 + h * across) * keep
            d0, d1 = (e0 - q0) / h, (e1 - q1) / h
            pull = tyre.tread_n_m * math.sqrt(e0 * e0 + e1 * e1)
            if pull > grip:
                e0, e1 = e0 * grip / pull, e1 * grip / pull
            ft = -(tyre.tread_n_m * e0 + tyre.tread_n_s_m * d0)
            fl = -(tyre.tread_n_m * e1 + tyre.tread_n_s_m * d1)
            pull = math.sqrt(ft * ft + fl * fl)
            if pull > grip:
                ft, fl = ft * grip / pull, fl * grip / pull
            q0, q1 = e0, e1
            drive = torque
            excess = (abs(w) - abs(top_spin)) / (tyre.slip_limit * (abs(top_spin) + 1.0))
            if torque * w > 0.0 and excess > 0.0:
                drive = torque * max(0.0, 1.0 - excess)
            free = drive - ft * reach
            # The brake holds the wheel to the arm, rolling resistance to the ground.
            still = turn if brake > 0.0 else 0.0
            held = _held(w - still, free, brake + rolling, tyre.spin_inertia_kg_m2, h)
            w += h * (free + held) / tyre.spin_inertia_kg_m2
            angle[k] += h * (w - turn)
            sum_t += ft
            sum_l += fl
            sum_reaction += drive + min(max(held, -brake), brake)
        spin[k], bristle[k, 0], bristle[k, 1] = w, q0, q1
        ft, fl, reaction = sum_t / SUBSTEP_COUNT, sum_l / SUBSTEP_COUNT, sum_reaction / SUBSTEP_COUNT
        fx, fy, fz = ft * tx + fl * lx + load * nx, ft * ty + fl * ly + load * ny, ft * tz + fl * lz + load * nz
        # Torque about the axle reaches the arm only through motor and brake.
        about = ax * (by * fz - bz * fy) + ay * (bz * fx - bx * fz) + az * (bx * fy - by * fx) + reaction
        mx, my, mz = dy * fz - dz * fy, dz * fx - dx * fz, dx * fy - dy * fx
        out[k, 0], out[k, 1], out[k, 2] = fx, fy, fz
        out[k, 3], out[k, 4], out[k, 5] = mx - about * ax, my - about * ay, mz - about * az
        contact[k, 0], contact[k, 1], contact[k, 2] = px + bx, py + by, pz + bz
        contact[k, 3] = load
