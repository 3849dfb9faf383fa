"""The crane of a machine as URDF, for other tools: the plant's links and joints with a rigid column."""

from __future__ import annotations

from dataclasses import replace

from machine.profile import Profile
from sim.bullet.urdf import JointDef, urdf_text
from sim.mechanics.crane import FLEX_JOINTS, crane_links
from sim.truth.load import Truth


def crane_urdf(profile: Profile, truth: Truth) -> str:
    """The robot ``NAME``.  Its joints have the names and ranges of the profile's; ``hanger`` is the hanger pin."""
    links, joints = crane_links(profile, truth)
    return urdf_text(profile.name, links, [_outward(profile, joint) for joint in joints])


def _outward(profile: Profile, joint: JointDef) -> JointDef:
    if joint.name in FLEX_JOINTS:
        return replace(joint, kind="fixed")
    spec = profile.joints.get(joint.name)
    return joint if spec is None else replace(joint, lower=spec.lower, upper=spec.upper)
