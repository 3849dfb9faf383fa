"""A plot of demonstrated motions and of the movement primitives learned from them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np

from autonomy.motion.arm_kinematics import Arm, Pose
from autonomy.motion.demonstration import JointTrack
from autonomy.motion.movement_primitives import Primitives, pose_track, split_by_direction
from machine.profile import Profile
from runtime.plot_style import OIL, RUST, STEEL, sheet

NEW_GOAL_SHARES: Final = (1.25, 0.75, -0.75, -1.0, -1.25)
"""Slews to goals that were not demonstrated, as shares of a demonstrated slew."""


def plot_primitives(path: Path, profile: Profile, motions: Sequence[JointTrack], primitives: Primitives) -> None:
    """Plot demonstrated and learned motions, out and back: the tip pin seen from behind, and its height over time."""
    arm, bunk = Arm(profile), profile.bunk
    groups = split_by_direction(arm, motions)
    top = bunk.floor_z_m + bunk.stake_height_m
    with sheet(path, 3, 13.0, 4.2) as (out_axis, back_axis, time_axis):
        for axis, group, primitive, title in (
            (out_axis, groups[0], primitives.out, "out to the log"),
            (back_axis, groups[1], primitives.back, "back to the bunk"),
        ):
            dmp = primitive.dmp()
            for i, motion in enumerate(group):
                poses = pose_track(arm, motion)
                learned = dmp.rollout(poses[0], poses[-1])
                shown_at, learned_at = _across_and_height(arm, poses), _across_and_height(arm, learned.position)
                axis.plot(*shown_at, color=STEEL, lw=2.5, alpha=0.45, label="" if i else "demonstrated")
                axis.plot(*learned_at, color=OIL, lw=1.2, label="" if i else "learned, same goal")
                if axis is out_axis:
                    time_axis.plot(motion.time_s, poses[:, 2], color=STEEL, lw=2.5, alpha=0.45)
                    time_axis.plot(learned.time_s, learned.position[:, 2], color=OIL, lw=1.2)
            if group:
                shown = pose_track(arm, group[-1])
                for k, share in enumerate(NEW_GOAL_SHARES):
                    a, b = shown[0].copy(), shown[-1].copy()
                    side = b if axis is out_axis else a
                    side[0] *= share
                    other = dmp.rollout(a, b).position
                    other_at = _across_and_height(arm, other)
                    axis.plot(*other_at, color=RUST, lw=0.7, ls=":", label="" if k else "learned, new goals")
            across = bunk.width_m / 2
            axis.plot([-across, -across, across, across], [top, bunk.floor_z_m, bunk.floor_z_m, top], color="k", lw=2)
            axis.set(title=title, xlabel="pin across the machine [m]", ylabel="pin height [m]")
        time_axis.legend(*out_axis.get_legend_handles_labels(), fontsize=7, loc="upper right")
        time_axis.set(title="height on the way out", xlabel="time [s]", ylabel="pin height [m]")


def _across_and_height(arm: Arm, poses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Compute the position across the bunk's length, and height [m]."""
    bunk = arm.profile.bunk
    pins = [arm.xy(Pose(slew, r, z, ext, 0.0)) for slew, r, z, ext, *_ in poses.tolist()]
    xy = np.array(pins) - np.array(bunk.center_m)
    return xy @ np.array([-np.sin(bunk.yaw_rad), np.cos(bunk.yaw_rad)]), poses[:, 2]
