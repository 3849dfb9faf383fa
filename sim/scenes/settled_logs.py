"""Logs at rest and stereo noise without a machine, for training pictures and the evaluation of detectors."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Final

import msgspec

from machine.profile import Profile
from sim.bullet.client import new_client
from sim.camera.noise import StereoNoise
from sim.camera.scene import LogPose
from sim.geometry import IDENTITY
from sim.ground.terrain import Terrain
from sim.scenes.arrangements import arrangement
from sim.truth.load import Truth, load_truth
from sim.wood.logs import LogBodies

BASE_POSE: Final = ((0.0, 0.0, 0.0), IDENTITY)


@lru_cache(maxsize=8)
def _truth(name: str, seed: int, machine: str) -> Truth:
    return load_truth(name, seed, machine)


def settle_logs(
    profile: Profile, kind: str, seed: int, logs: int, terrain: Terrain, route: Sequence[tuple[float, float]]
) -> tuple[LogPose, ...]:
    """Settle an arrangement of ``sim.scenes.arrangements`` on ``terrain``, with the nominal truth; instances 1, 2, ...

    Raises:
        PlantError: there is no room, or the logs do not come to rest.
    """
    truth, client = _truth("nominal", 0, profile.name), new_client()
    try:
        scene = arrangement(kind, profile, truth.wood, seed, logs, route=route)
        states = LogBodies(client, profile, truth, scene, terrain, BASE_POSE).states()
    finally:
        client.disconnect()
    return tuple(
        LogPose(i + 1, s.position_m, s.quaternion, s.length_m, s.diameter_m, s.taper_m_m, s.sweep_m)
        for i, s in enumerate(states)
    )


def stereo_noise(
    profile: Profile, camera: str, seed: int | str, truth: str = "nominal", truth_seed: int = 0
) -> StereoNoise:
    """Return the depth errors of a machine's camera according to a truth."""
    return StereoNoise(profile.cameras[camera], _truth(truth, truth_seed, profile.name).cameras[camera], seed)


def varied_stereo_noise(
    profile: Profile,
    camera: str,
    seed: int,
    *,
    sigma: float,
    edges: tuple[float, float],
    holes: float,
    plain_holes: float,
    correlation_px: float,
) -> StereoNoise:
    """Make a better or worse camera than the nominal one.

    ``sigma``, ``edges`` and ``holes`` are factors of its disparity error, of both its edge widths and of its share of
    holes; ``plain_holes`` is the share of holes on surfaces without texture, ``correlation_px`` the correlation length
    of the errors.
    """
    own = _truth("nominal", 0, profile.name).cameras[camera]
    changed = msgspec.structs.replace(
        own,
        disparity_sigma_px=own.disparity_sigma_px * sigma,
        edge_px=(own.edge_px[0] * edges[0], own.edge_px[1] * edges[1]),
        hole_share=min(0.3, own.hole_share * holes),
        plain_hole_share=plain_holes,
        correlation_px=correlation_px,
    )
    return StereoNoise(profile.cameras[camera], changed, seed)
