"""The plant for display: plain JSON values for a page or a picture.  World frame: metres, z up.

A pose is [x, y, z, qx, qy, qz, qw].  Each answer fits into one UDP datagram.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Final

from machine.geometry.carrier import ARMS
from sim.geometry.shape import Quaternion, Vector
from sim.ground.terrain import Terrain
from sim.hydraulics.layout import PA_PER_BAR
from sim.plant import Plant

GROUND_HALF_M: Final = 20.0  # half the width of the uneven ground in the view
GROUND_CELL_M: Final = 0.6
LEVER_LABELS: Final = {
    "slew": ("right", "left"),
    "lift": ("lower", "lift"),
    "tilt": ("in", "out"),
    "ext": ("in", "out"),
    "rot": ("right", "left"),
    "grapple": ("close", "open"),
    "steer": ("right", "left"),
    "drive": ("back", "forward"),
}


def scene_of(plant: Plant) -> dict[str, Any]:
    """The constant part: shapes on links, wheels, logs, ground, levers, and the view point."""
    carrier, log_bodies = plant.profile.carrier, plant.world.log_bodies
    wheel = None if carrier is None else {"radius_m": carrier.wheel_radius_m, "width_m": carrier.wheel_width_m}
    middle, _ = plant.base_pose()
    return {
        "title": plant.profile.title,
        "shapes": plant.shapes(),
        "wheels": [] if wheel is None else [wheel] * len(ARMS),
        "logs": [
            {
                "length_m": log.length_m,
                "diameter_m": log.diameter_m,
                "taper_m_m": log.taper_m_m,
                "sweep_m": log.sweep_m,
            }
            for log in log_bodies.states()
        ],
        "ground": _ground(plant.world.terrain),
        "levers": [dict(zip(("name", "minus", "plus"), (n, *_labels(n)), strict=True)) for n in plant.levers()],
        "centre_m": [middle[0], middle[1], middle[2] + 1.0],
        "size_m": 9.0 if carrier is None else 12.0,
    }


def view_of(plant: Plant) -> dict[str, Any]:
    """The moving part, and the numbers beside it."""
    h = plant.world.hydraulics
    return {
        "time_s": plant.time_s,
        "poses": {name: _pose(*pose) for name, pose in plant.link_poses().items()},
        "logs": [_pose(log.position_m, log.quaternion) for log in plant.logs()],
        "wheels": _wheels(plant),
        "facts": _facts(plant),
        "pressures_bar": {n: [round(p / PA_PER_BAR, 1) for p in h.pressures_pa[n]] for n in h.names},
    }


def _labels(lever: str) -> tuple[str, str]:
    return LEVER_LABELS.get(lever, ("lower", "raise"))


def _pose(position: Vector, turn: Quaternion) -> list[float]:
    return [round(v, 4) for v in (*position, *turn)]


def _wheels(plant: Plant) -> list[list[float]]:
    carrier, spec = plant.world.carrier, plant.profile.carrier
    if carrier is None or spec is None:
        return []
    out = []
    for arm, spin in zip(ARMS, carrier.wheel_spin_rad, strict=True):
        hub = [spec.arm_length_m if arm[4] == "f" else -spec.arm_length_m, 0.0, 0.0]
        turned = [0.0, math.sin(spin / 2), 0.0, math.cos(spin / 2)]
        out.append(_pose(*plant.world.client.multiplyTransforms(*carrier.pose(arm), hub, turned)))
    return out


def _facts(plant: Plant) -> dict[str, str]:
    world, verdict = plant.world, plant.evaluate()
    tip, rigid = world.tip(), world.rigid_tip()
    facts = {
        "tip": " ".join(_fixed(v, 2) for v in tip) + " m",
        "sag": f"{1e3 * math.dist(tip, rigid):.0f} mm",
        "load": f"{world.load_kg():.0f} kg",
        "opening": f"{100 * world.opening:.0f} %",
        "pump": f"{world.hydraulics.supply_pa / PA_PER_BAR:.0f} bar",
        "in the bunk": f"{verdict.loaded} of {len(verdict.logs)}",
    }
    vehicle = plant.vehicle()
    if vehicle is not None:
        facts |= {
            "speed": f"{_fixed(3.6 * vehicle.speed_m_s, 1)} km/h",
            "articulation": f"{_fixed(math.degrees(vehicle.articulation_rad), 1)}°",
            "roll, pitch": " ".join(f"{_fixed(math.degrees(a), 1)}°" for a in (vehicle.roll_rad, vehicle.pitch_rad)),
            "arm heights": _list(vehicle.arm_heights_m, 100, "cm"),
            "wheel loads": _list(vehicle.wheel_loads_n, 1e-3, "kN"),
        }
    return facts


def _fixed(value: float, digits: int) -> str:
    """Without a minus sign before zero."""
    return f"{round(value, digits) + 0.0:.{digits}f}"


def _list(values: Sequence[float], scale: float, unit: str) -> str:
    return " ".join(f"{scale * v:.0f}" for v in values) + f" {unit}"


def _ground(terrain: Terrain) -> dict[str, Any]:
    """Level ground as its height, uneven ground as a coarse grid about the origin."""
    if terrain.kind == "flat":
        return {"z_m": terrain.height(0.0, 0.0)}
    n = round(2 * GROUND_HALF_M / GROUND_CELL_M) + 1
    at = [-GROUND_HALF_M + i * GROUND_CELL_M for i in range(n)]
    return {
        "x0_m": -GROUND_HALF_M,
        "y0_m": -GROUND_HALF_M,
        "cell_m": GROUND_CELL_M,
        "columns": n,
        "rows": n,
        "heights": [round(terrain.height(x, y), 2) for y in at for x in at],
    }
