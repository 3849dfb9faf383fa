"""From a recording to primitives: the demonstrations in it, what is learned from them, and a picture of both."""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final

import numpy as np

from autonomy.motion.arm import Arm
from autonomy.motion.demonstration import (
    JointTrack,
    RecordingRefused,
    joint_track,
    read_demonstrations,
    segment_motions,
)
from autonomy.motion.movement_primitives import Primitives, pose_track, split_by_direction
from autonomy.motion.pose import Pose
from can_dbc.dbc.codec import load as load_database
from can_dbc.frame import Frame
from can_dbc.trace.candump import read as read_log
from hil.replay.recording import files_of, manifest_of
from host.exit_codes import CommandFailed, ExitCode
from machine.loading.profile_file import ProfileError, load_profile
from machine.profile import Profile
from recorder.mcap_scan import NotMcap, Stored, scan
from runtime.plot_style import OIL, RUST, STEEL, sheet

_RAW: Final = struct.Struct("<IB3x8s")
USUAL: Final = "aoro_fc8"
_OTHERS: Final = (1.25, 0.75, -0.75, -1.0, -1.25)
"""Slews to places that nobody showed, as shares of one that was shown."""


def motions_in(log: Path, profile: str | None = None) -> tuple[Profile, tuple[JointTrack, ...]]:
    """The machine and the demonstrations of a run's directory, an MCAP file, a CAN log or a file of demonstrations.

    Raises:
        CommandFailed: it cannot be read, is of another machine, or holds no motion.
    """
    try:
        if log.is_file() and log.suffix.lower() == ".csv":
            name, motions = read_demonstrations(log)
            machine = load_profile(profile or name)
            if machine.name != name:
                raise CommandFailed(
                    "demonstration.other-machine",
                    f"{log} is of machine {name}, not of {machine.name}",
                    ExitCode.CONFIGURATION,
                )
        else:
            machine, frames = _frames(log, profile)
            motions = segment_motions(machine, joint_track(machine, load_database("crane"), frames))
    except (RecordingRefused, ProfileError) as error:
        raise CommandFailed.from_error(error, ExitCode.CONFIGURATION) from None
    if not motions:
        raise CommandFailed(
            "demonstration.no-motion",
            f"{log}: the crane moves nowhere in it; record some motions from rest to rest",
            ExitCode.CONFIGURATION,
        )
    return machine, motions


def _frames(log: Path, profile: str | None) -> tuple[Profile, Iterator[Frame]]:
    if log.is_file() and log.suffix.lower() != ".mcap":
        machine = load_profile(profile or USUAL)
        try:
            return machine, (entry for entry in read_log(log) if isinstance(entry, Frame))
        except OSError as error:
            raise CommandFailed(
                "demonstration.unreadable", f"{log} cannot be read ({error.strerror})", ExitCode.CONFIGURATION
            ) from None
    files = files_of(log)
    machine = load_profile(profile or manifest_of(files).profile)
    return machine, _raw(files, f"/{machine.crane_bus}/raw")


def _raw(files: Sequence[Path], topic: str) -> Iterator[Frame]:
    """The frames of a bus with their monotonic stamps."""
    try:
        for path in files:
            for record in scan(path, {topic}):
                if isinstance(record, Stored) and len(record.data) >= _RAW.size:
                    key, length, data = _RAW.unpack_from(record.data)
                    yield Frame(record.publish_ns, key, data[:length])
    except NotMcap as error:
        raise CommandFailed.from_error(error, ExitCode.CONFIGURATION) from error


def draw(path: Path, profile: Profile, motions: Sequence[JointTrack], primitives: Primitives) -> None:
    """Demonstrated and learned motions, out and back: the pin from behind, and its height over time."""
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
                axis.plot(*_seen(arm, poses), color=STEEL, lw=2.5, alpha=0.45, label="" if i else "demonstrated")
                axis.plot(*_seen(arm, learned.position), color=OIL, lw=1.2, label="" if i else "learned, same goal")
                if axis is out_axis:
                    time_axis.plot(motion.time_s, poses[:, 2], color=STEEL, lw=2.5, alpha=0.45)
                    time_axis.plot(learned.time_s, learned.position[:, 2], color=OIL, lw=1.2)
            if group:
                shown = pose_track(arm, group[-1])
                for k, share in enumerate(_OTHERS):
                    a, b = shown[0].copy(), shown[-1].copy()
                    side = b if axis is out_axis else a
                    side[0] *= share
                    other = dmp.rollout(a, b).position
                    axis.plot(*_seen(arm, other), color=RUST, lw=0.7, ls=":", label="" if k else "learned, new goals")
            across = bunk.width_m / 2
            axis.plot([-across, -across, across, across], [top, bunk.floor_z_m, bunk.floor_z_m, top], color="k", lw=2)
            axis.set(title=title, xlabel="pin across the machine [m]", ylabel="pin height [m]")
        time_axis.legend(*out_axis.get_legend_handles_labels(), fontsize=7, loc="upper right")
        time_axis.set(title="height on the way out", xlabel="time [s]", ylabel="pin height [m]")


def _seen(arm: Arm, poses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Across the bunk's length, and height."""
    bunk = arm.profile.bunk
    xy = np.array([arm.xy(Pose(*row[:4], 0.0)) for row in poses.tolist()]) - np.array(bunk.center_m)
    return xy @ np.array([-np.sin(bunk.yaw_rad), np.cos(bunk.yaw_rad)]), poses[:, 2]
