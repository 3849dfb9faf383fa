"""Physics worlds for trials, and helpers that read or load them."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from typing import Any, Final

from machine.geometry.kinematics import Point, inverse, solve
from machine.loading.profile_file import load_profile
from machine.profile import Profile, joint_limits
from sim.mechanics.carrier import PARKED
from sim.plant import Plant
from sim.scenes.arrangements import arrangement
from sim.wood.log_shape import LogSpec
from sim.world import World, open_world

CARRIER_PROFILE: Final = "aoro_fc8"
ARM: Final = ("slew", "lift", "tilt", "ext")
SETTLE_STEP_COUNT: Final = 800
CarrierPose = tuple[float, float, float]
"""Middle of the front axle [m] and direction [rad] in the world frame."""


@cache
def profile_named(name: str) -> Profile:
    """Load the profile of that name or file, once per process."""
    return load_profile(name)


def carrier_profile(name: str) -> str:
    """Return the profile itself if it has a carrier, otherwise the shipped machine with one."""
    return name if profile_named(name).carrier is not None else CARRIER_PROFILE


@contextmanager
def trial_world(
    profile: str,
    truth: str,
    seed: int,
    scene: str | Sequence[LogSpec] = (),
    logs: int = 1,
    home: dict[str, float] | None = None,
) -> Iterator[World]:
    """Open a world for one trial, closed at the end; the same arguments give the same world.

    A scene given by name is an arrangement of that many logs (`sim.scenes.arrangements`).
    """
    p = profile_named(profile)
    specs = arrangement(scene, p, wood_of(profile, truth), seed, logs) if isinstance(scene, str) else scene
    world = open_world(p, truth=truth, seed=seed, scene=specs, home=home)
    try:
        yield world
    finally:
        world.close()


@cache
def wood_of(profile: str, truth: str) -> Any:
    """Return the properties of the logs of a truth; the same for every individual machine."""
    with trial_world(profile, truth, 0) as world:
        return world.truth.wood


def home_at(profile: str, reach_m: float, height_m: float, ext_m: float | None = None) -> dict[str, float]:
    """Compute joint positions with slew 0 and the hanger pin at this reach and height in the base frame."""
    p = profile_named(profile)
    turn = p.kinematics.theta1_offset_rad
    point = (reach_m * math.cos(turn), reach_m * math.sin(turn), height_m)
    if ext_m is None:
        return dict(zip(ARM, solve(p, *point), strict=True))
    return dict(zip(ARM, (*inverse(p.kinematics, joint_limits(p), *point, ext_m), ext_m), strict=True))


def to_base(world: World, point: Sequence[float]) -> Point:
    """Transform a point from the world frame to the crane's base frame."""
    p = world.client
    x, y, z = p.multiplyTransforms(*p.invertTransform(*world.base_pose()), point, (0.0, 0.0, 0.0, 1.0))[0]
    return x, y, z


def yaw_in_base(world: World, axis: Sequence[float]) -> float:
    """Compute the direction [rad] of a horizontal axis, given in the world frame, in the crane's base frame."""
    foot, tip = to_base(world, (0.0, 0.0, 0.0)), to_base(world, axis)
    return math.atan2(tip[1] - foot[1], tip[0] - foot[0])


def hang(world: World, mass_kg: float) -> None:
    """Hang a load on the hook: add its mass to the rotator and keep the inertia, as for a dense weight."""
    link = world.crane.link["rotator"]
    own = world.truth.links["rotator"].mass_kg
    world.client.changeDynamics(world.crane.body, link, mass=own + mass_kg)


def step_neutral(world: World, steps: int) -> None:
    """Advance the physics with every spool closed."""
    neutral = [0.0] * len(world.functions)
    for _ in range(steps):
        world.step(neutral)


def place(plant: Plant, pose: CarrierPose) -> None:
    """Place the machine at rest with its front axle at a pose in the world frame."""
    world, carrier = plant.world, plant.profile.carrier
    assert world.carrier is not None and carrier is not None
    x, y, yaw = pose
    lf = carrier.front_axle_m
    world.carrier.place(x - lf * math.cos(yaw), y - lf * math.sin(yaw), yaw, carrier.arm_transport_m)
    neutral = [0.0] * len(world.functions)
    for _ in range(SETTLE_STEP_COUNT):
        world.step(neutral, PARKED)
