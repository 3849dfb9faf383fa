"""Logs on the way, by a camera of a machine that drives: they lie still in the plane while it moves.

The camera's place is that of the crane's base in the plane, by the receiver, and the kinematic chain from there: the
half that carries it, the articulation.  `CylinderLocalizer` fits cylinders to the network's masks and joins them over pictures;
`PaperBLocalizer` takes the depth at the middle of each mask's box (its 3.2.3), a point and no more.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Final, Protocol

import numpy as np

from autonomy.perception.camera.frame import Pose, RgbdFrame, RgbdFrameError, rescaled
from autonomy.perception.camera.mount import CameraMountError, optical_pose
from autonomy.perception.log_list.observation import LogObservation
from autonomy.perception.papers.paper_a import log_of
from autonomy.perception.papers.paper_b import position_of
from autonomy.perception.pipeline import Masked, Perception
from autonomy.perception.sources.camera_source import CameraSource, SourceError
from autonomy.perception.tracking.log_filter import NOMINAL_ERRORS, CameraErrors
from machine.profile import Profile

FARTHEST_M: Final = 10.0
"""A log that is farther away is a few pixels wide: nobody measures it."""
LENGTH_M, DIAMETER_M = 2.0, 0.25
"""Paper B's boxes tell no size: the mean of its logs is taken."""
PATIENCE: Final = 6
"""A log whose ends are not both seen is believed in after so many pictures: another may hide one for good."""
FLAT: Final = 0.3
"""An axis whose level part is shorter says nothing of a log on the ground."""

SURE: Final = 0.25
"""What the finder believes in less is no log: one within ``FARTHEST_M`` has 0.5 and more, a gap in a shadow 0.2."""


class ScoredMask(Masked, Protocol):
    """A mask, and how much it is believed in, 0..1."""

    @property
    def score(self) -> float: ...


Find = Callable[[RgbdFrame], Sequence[ScoredMask]]


class LogLocalizer(Protocol):
    """A pipeline: logs in the frame in which ``pose`` is given."""

    def localize(self, frame: RgbdFrame, pose: Pose, masks: Sequence[Masked]) -> list[LogObservation]:
        """Of one picture."""


class CylinderLocalizer:
    """`autonomy.perception.pipeline`: cylinder fits and tracks."""

    def __init__(self, profile: Profile, errors: CameraErrors = NOMINAL_ERRORS) -> None:
        self._perception = Perception(profile, errors)

    def localize(self, frame: RgbdFrame, pose: Pose, masks: Sequence[Masked]) -> list[LogObservation]:
        """The tracks that this picture shows; a piece at its edge is not yet a log."""
        tracks = self._perception.step(frame, pose, masks)
        fresh = [t for t in tracks if t.last_seen_ns == frame.stamp_ns]
        return [t.estimate.observation(t.id) for t in fresh if all(t.estimate.ends_seen) or t.hits >= PATIENCE]


class PaperBLocalizer:
    """`autonomy.perception.papers.paper_b`, with half a diameter added along the line of sight, for the grapple needs the
    log's middle and the paper does not say how it came from the surface; nor does it say how the grapple was turned:
    the axis is that of the mask's points, as in paper A.
    """

    def localize(self, frame: RgbdFrame, pose: Pose, masks: Sequence[Masked]) -> list[LogObservation]:
        """A log for every box whose middle has a depth."""
        found = []
        for number, one in enumerate(masks):
            rows, columns = np.flatnonzero(one.mask.any(axis=1)), np.flatnonzero(one.mask.any(axis=0))
            if not len(rows):
                continue
            box = (float(columns[0]), float(rows[0]), float(columns[-1] + 1), float(rows[-1] + 1))
            point, plain = position_of(frame, box), log_of(frame, one.mask)
            if point is None or plain is None:
                continue
            range_m = float(np.linalg.norm(point))
            level = (pose.rotation @ plain.axis)[:2]
            length = float(np.linalg.norm(level))
            if range_m > FARTHEST_M or length < FLAT:
                continue
            x, y, z = pose.to_base(point * (1.0 + 0.5 * DIAMETER_M / range_m)).tolist()
            axis = (float(level[0]) / length, float(level[1]) / length, 0.0)
            found.append(LogObservation(number, (x, y, z), axis, LENGTH_M, DIAMETER_M, _PLAIN))
        return found


_SIGMAS: Final = (0.10, 0.10, 0.6, 0.6, 0.2, 0.2, 0.05)
"""Of a box (m, rad): its place by the paper's own errors; an axis seen end-on may be any."""
_PLAIN: Final = tuple(np.diag(np.square(_SIGMAS))[np.triu_indices(len(_SIGMAS))].tolist())


class DrivingLogDetector:
    """One camera of a machine that drives.  ``trouble`` says why the last look saw nothing, empty when it did.

    ``find`` gives the masks of the logs in a frame.  Raises KeyError when the machine has no such camera.
    """

    def __init__(self, profile: Profile, camera: str, source: CameraSource, find: Find, sight: LogLocalizer) -> None:
        self.trouble = ""
        self._profile, self._camera = profile, profile.cameras[camera]
        self._source, self._find, self._sight = source, find, sight

    def detect(self, base: Pose, q: Sequence[float], articulation_rad: float) -> tuple[LogObservation, ...] | None:
        """The logs of a new picture in the crane's base frame; None when there is none.

        ``base`` is that frame in the plane, ``q`` the joints in ``Joint`` order [rad, m], both when the picture is
        taken.
        """
        self.trouble = ""
        try:
            mount = optical_pose(self._profile, self._camera, q, articulation_rad)
            frame = self._source.frame()
            if frame is None:
                self.trouble = getattr(self._source, "problem", "") or "the camera gives no picture"
                return None
            frame = rescaled(frame, self._camera.depth_scale)
            pose = Pose(base.to_base(mount.position_m), base.rotation @ mount.rotation)
            seen = self._sight.localize(frame, pose, [one for one in self._find(frame) if one.score >= SURE])
        except (SourceError, RgbdFrameError, CameraMountError) as error:
            self.trouble = str(error)
            return None
        near = [o for o in seen if np.linalg.norm(np.asarray(o.center_m) - pose.position_m) < FARTHEST_M]
        return tuple(_in_base(o, base) for o in near)


def _in_base(o: LogObservation, base: Pose) -> LogObservation:
    """From the plane into the base frame; how well it is known turns with it."""
    x, y, z = base.to_optical(np.asarray(o.center_m)).tolist()
    ax, ay, az = (np.asarray(o.axis) @ base.rotation).tolist()
    return replace(o, center_m=(x, y, z), axis=(ax, ay, az))
