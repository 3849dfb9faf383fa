"""Half the smallest inertia that each function shows its drive, in poses over its whole range (`sim.truth`).

Every joint is free and at rest, without gravity: a torque on one of them for a moment, and its acceleration, give the
inertia that this drive feels while all others give way.
"""

from __future__ import annotations

from itertools import product
from typing import Final

from machine.profile import Profile
from sim.bullet.body import Body
from sim.bullet.client import BulletClient, new_client
from sim.mechanics.crane import crane_links
from sim.truth.load import Truth

POSES_PER_JOINT: Final = 4
JAWS: Final = (0.0, 0.5, 1.0)
"""Shares of the tongs' travel."""
STEP_S: Final = 1e-4
TONGS: Final = ("tong_left", "tong_right")


def least_inertia(profile: Profile, truth: Truth) -> dict[str, float]:
    """By function [kg m^2, kg]; only the links of ``truth`` are used."""
    client = new_client()
    try:
        client.setGravity(0.0, 0.0, 0.0)
        client.setPhysicsEngineParameter(fixedTimeStep=STEP_S)
        body = Body(client, *crane_links(profile, truth), fixed=True)
        driven = {name: (name,) for name in profile.joints} | {"grapple": TONGS}
        least = dict.fromkeys(driven, float("inf"))
        shares = [i / (POSES_PER_JOINT - 1) for i in range(POSES_PER_JOINT)]
        for lift, tilt, ext, jaw in product(shares, shares, shares, JAWS):
            pose = dict.fromkeys(body.names, 0.0)
            for name, share in (("lift", lift), ("tilt", tilt), ("ext", ext)):
                spec = profile.joints[name]
                pose[name] = spec.lower + share * (spec.upper - spec.lower)
            pose["hanger"] = -(pose["lift"] + pose["tilt"])
            pose |= dict.fromkeys(TONGS, jaw * profile.grapple.jaws.angle_rad[-1])
            for name, joints in driven.items():
                least[name] = min(least[name], _inertia(client, body, pose, joints))
        return {name: 0.5 * inertia for name, inertia in least.items()}
    finally:
        client.disconnect()


def _inertia(client: BulletClient, body: Body, pose: dict[str, float], joints: tuple[str, ...]) -> float:
    """Torque over the mean acceleration of the joints that share it."""
    body.place(pose)
    body.apply([body.index[j] for j in joints], [1.0 / len(joints)] * len(joints))
    client.stepSimulation()
    rates = dict(zip(body.names, (s[1] for s in body.states()), strict=True))
    return STEP_S / (sum(rates[j] for j in joints) / len(joints))
