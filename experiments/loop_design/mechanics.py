"""The mechanics that a joint's valve drives, linearized about a pose: oil, inertia, hanging load, compliant column.

Input: an opened World at rest (bodies and hydraulics of the truth).  Output: joint position over metered travel, both
in the unit of the joint: 1 at rest, and the modes that an encoder sees.  The valve is slightly open, as in motion.  The
chamber that fills lies behind a pressure compensator that waits for the load-sensing pump.  The chamber that empties
lies behind a compensator if its load drives the joint, otherwise behind a metering edge, which damps.  Oil, edges and
damping orifices are those of ``sim.hydraulics.kernel``.  The other joints do not move.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from sim.bullet.client import GRAVITY_M_S2
from sim.hydraulics.kernel import STEADY_S
from sim.hydraulics.layout import METER_OUT_FACTOR, SOFT_PA
from sim.mechanics.crane import crane_links
from sim.world import World

DRIVEN: Final = {
    "slew": ("turntable", "flexure", "mast", "boom", "stick", "telescope"),
    "lift": ("boom", "stick", "telescope"),
    "tilt": ("stick", "telescope"),
    "ext": ("telescope",),
    "rot": ("rotator", "tong_left", "tong_right"),
}
ON_THE_COLUMN: Final = ("mast", "boom", "stick", "telescope")
HANGING: Final = ("hanger", "fork", "rotator", "tong_left", "tong_right")
LOG_BELOW_ROTATOR_M: Final = 0.6
LOG_GYRATION_M: Final = 0.8
OPENING: Final = 0.2

Array = np.ndarray[Any, np.dtype[Any]]


@dataclass(frozen=True, slots=True)
class Chamber:
    """One side of the piston: spring [Nm/rad, N/m] and decay rate of a pressure change through its edge [1/s].

    ``wait_s``: the change decays only until the pump has followed; 0: at once.
    """

    spring: float
    decay_1_s: float
    wait_s: float

    def impedance(self, s: Array, relaxation_1_s: float) -> Array:
        """Compute the force over travel; part of the oil flows through the damping orifice into the hose."""
        soft = 1.0 + relaxation_1_s * STEADY_S / (1.0 + s * STEADY_S)
        off = self.decay_1_s * (s * self.wait_s / (1.0 + s * self.wait_s) if self.wait_s else 1.0)
        return self.spring * s / (s * soft + off)


@dataclass(frozen=True, slots=True)
class Mechanics:
    """One joint in one pose; revolute: kg m^2 and Nm/rad, prismatic: kg and N/m.

    ``damping`` of the seals; ``inertia`` of all parts that follow rigidly; ``swinging``: inertia that the hanging mass
    adds below its ``pendulum_rad_s``, of which the share ``pendulum_free`` does not follow far above it.  The column:
    ``column_inertia`` of all parts above its hinge, ``shared_inertia`` of hinge and joint, ``column_spring``, and
    ``column_damping_s``, its damper over its spring.
    """

    filling: Chamber
    emptying: Chamber
    relaxation_1_s: float
    damping: float
    inertia: float
    swinging: float
    pendulum_rad_s: float
    pendulum_zeta: float
    pendulum_free: float
    column_inertia: float
    shared_inertia: float
    column_spring: float
    column_damping_s: float

    def oil(self, s: Array) -> Array:
        """Compute the force of the oil over the lag of the joint behind the metered oil."""
        r = self.relaxation_1_s
        return self.filling.impedance(s, r) + self.emptying.impedance(s, r)

    def response(self, s: Array) -> Array:
        """Compute the joint position over metered travel at the complex frequencies ``s``."""
        oil, w, z = self.oil(s), self.pendulum_rad_s, self.pendulum_zeta
        swing = 1.0 - self.pendulum_free * s * s / (s * s + 2.0 * z * w * s + w * w)
        column = self.column_inertia * s * s + self.column_spring * (1.0 + self.column_damping_s * s)
        mass = (self.inertia + self.swinging * swing) * s * s - (self.shared_inertia * s * s) ** 2 / column
        return oil / (mass + self.damping * s + oil)


def mechanics(world: World, name: str, load_kg: float = 0.0, direction: int = 1, opening: float = OPENING) -> Mechanics:
    """Linearize the joint ``name`` of a world at rest, with a load in the grapple.

    It moves in a ``direction`` (1, -1) with its valve open by the share ``opening``.
    """
    at, axis, slides = _axis(world, name)
    foot, bends, _ = _axis(world, "flex_roll" if name == "slew" else "flex_pitch")
    inertia = _product(world, DRIVEN[name], (at, axis, slides), (at, axis, slides))
    column = _product(world, ON_THE_COLUMN, (foot, bends, False), (foot, bends, False))
    shared = _product(
        world, DRIVEN[name] if name != "slew" else ON_THE_COLUMN, (at, axis, slides), (foot, bends, False)
    )
    hanging = sum(_mass(world, link) for link in HANGING) + load_kg
    pin = np.array(world.crane.pose("hanger")[0])
    moment, about = _pendulum(world, load_kg)
    pendulum = math.sqrt(GRAVITY_M_S2 * moment / about)
    swinging = 0.0
    if name == "rot":
        inertia += load_kg * LOG_GYRATION_M**2
        shared = 0.0
    else:
        pin_jacobian = axis if slides else np.cross(axis, pin - at)
        flex_jacobian = np.cross(bends, pin - foot)
        inertia += hanging * float(pin_jacobian[2] ** 2)
        column += hanging * float(flex_jacobian[2] ** 2)
        shared += hanging * float(pin_jacobian[2] * flex_jacobian[2])
        swinging = hanging * float(pin_jacobian[0] ** 2 + pin_jacobian[1] ** 2)
    structure = world.truth.structure
    stiff = structure.flex_roll_nm_rad if name == "slew" else structure.flex_pitch_nm_rad
    zeta = structure.fork_damping_nm_s_rad / (2.0 * about * pendulum)
    cylinder = world.truth.functions[name].cylinder
    arm, filling, emptying = _chambers(world, name, direction, opening)
    return Mechanics(
        filling,
        emptying,
        cylinder.relaxation_1_s,
        cylinder.viscous * arm * arm,
        inertia,
        swinging,
        pendulum,
        zeta,
        moment * moment / (hanging * about),
        column,
        shared,
        stiff,
        structure.flex_damping_s,
    )


def _pendulum(world: World, load_kg: float) -> tuple[float, float]:
    """Compute the mass times depth [kg m] and inertia [kg m^2] of all hanging parts about the fork's hinge."""
    hinge = _axis(world, "fork")
    moment = sum(_mass(world, link) * float(hinge[0][2] - _centre(world, link)[2]) for link in HANGING)
    depth = float(hinge[0][2] - world.crane.pose("rotator")[0][2]) + LOG_BELOW_ROTATOR_M
    about = _product(world, HANGING, hinge, hinge) + load_kg * (depth**2 + LOG_GYRATION_M**2)
    return moment + load_kg * depth, about


def _chambers(world: World, name: str, direction: int, opening: float) -> tuple[float, Chamber, Chamber]:
    """Compute the lever arm [m], and the chambers that fill and empty in this direction."""
    supply, function, q = world.truth.supply, world.truth.functions[name], world.q[name]
    c, valve = function.cylinder, function.valve
    grid = np.linspace(c.arm_at[0], c.arm_at[-1], 257)
    arms = np.interp(grid, c.arm_at, c.arm)
    arm = float(np.interp(q, grid, arms))
    travel = np.concatenate(([0.0], np.cumsum(0.5 * (arms[1:] + arms[:-1]) * np.diff(grid))))
    out, stroke = float(np.interp(q, grid, travel)), float(travel[-1])
    sides = ((c.area_a, c.dead_volume_m3 + c.area_a * out), (c.area_b, c.dead_volume_m3 + c.area_b * (stroke - out)))
    pressures = world.hydraulics.pressures_pa[name]
    speed = opening * (valve.full_speed_plus if direction > 0 else valve.full_speed_minus) * abs(c.arm_nominal)
    made = []
    for side, (area, volume) in enumerate(sides):
        fills = (side == 0) == (direction > 0)
        # In steady motion the pressure drop at the outlet is nearly the margin, or the pressure caused by the load.
        braked = supply.pressure_margin_pa / METER_OUT_FACTOR**2
        drop = supply.pressure_margin_pa if fills else max(pressures[side] - supply.tank_pa, braked)
        bare = fills or drop < supply.pressure_margin_pa
        slope = area * speed * (1.0 / drop - 0.5 / (drop + SOFT_PA)) if bare else 0.0
        spring = supply.bulk_modulus_pa * (arm * area) ** 2 / volume
        off = supply.bulk_modulus_pa * slope / volume
        made.append(Chamber(spring, off, supply.build_up_s if fills else 0.0))
    a, b = made
    return (arm, a, b) if direction > 0 else (arm, b, a)


Hinge = tuple[Array, Array, bool]


def _axis(world: World, name: str) -> Hinge:
    """Return origin and direction of a joint in the world frame, and whether it is prismatic."""
    joint = next(j for j in crane_links(world.profile, world.truth)[1] if j.name == name)
    origin, turn = world.crane.pose(joint.child)
    return np.array(origin), _turned(world, turn) @ np.array(joint.axis), joint.kind == "prismatic"


def _turned(world: World, quaternion: Any) -> Array:
    return np.array(world.client.getMatrixFromQuaternion(quaternion)).reshape(3, 3)


def _mass(world: World, link: str) -> float:
    return float(world.client.getDynamicsInfo(world.crane.body, world.crane.link[link])[0])


def _centre(world: World, link: str) -> Array:
    state = world.client.getLinkState(world.crane.body, world.crane.link[link], computeForwardKinematics=1)
    return np.array(state[0])


def _product(world: World, links: tuple[str, ...], one: Hinge, other: Hinge) -> float:
    """Compute the coupling inertia of two hinges in the masses of ``links``; for one hinge twice, its moment of
    inertia.
    """
    total = 0.0
    for link in links:
        index = world.crane.link[link]
        state = world.client.getLinkState(world.crane.body, index, computeForwardKinematics=1)
        center, own = np.array(state[0]), _turned(world, state[1]).T
        about = np.array(world.client.getDynamicsInfo(world.crane.body, index)[2])
        jacobian_one, jacobian_other = (
            axis if slides else np.cross(axis, center - at) for at, axis, slides in (one, other)
        )
        total += _mass(world, link) * float(jacobian_one @ jacobian_other)
        if not (one[2] or other[2]):
            total += float(about @ ((own @ one[1]) * (own @ other[1])))
    return total
