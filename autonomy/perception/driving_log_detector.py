"""Logs along the route, from a camera of a machine that drives; the logs lie still in the plane.

The pose of the camera is that of the crane's base in the plane (from the GNSS receiver) with the kinematic chain from
there to the camera: the half of the carrier that holds it and the articulation.  ``CylinderLocalizer`` fits cylinders
to the network's masks and merges them over pictures.  ``PaperBLocalizer`` takes the depth at the middle of each box
(paper B 3.2.3), which gives a point only.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Final, Protocol

import numpy as np

from autonomy.perception.camera.frame import Pose, RgbdFrame, optical_pose, rescaled
from autonomy.perception.fitting.measure import Masked
from autonomy.perception.log_detector import Perception
from autonomy.perception.log_list import END, HIDDEN_END_SIGMA_M, SIZE, START, LogEstimate, LogObservation
from autonomy.perception.papers import position_in_box
from autonomy.perception.shown_picture import MeasuredPicture, ignore_picture
from autonomy.perception.sources.camera_source import CameraSource
from autonomy.perception.tracking.log_filter import NOMINAL_ERRORS, CameraErrors
from machine.profile import Profile
from runtime.errors import InputRefused, LinkError

MAX_RANGE_M: Final = 10.0
"""A log that is farther away is only a few pixels wide and cannot be measured."""
PAPER_B_LENGTH_M, PAPER_B_DIAMETER_M = 2.0, 0.25
"""Mean size of paper B's logs, because its boxes give no size."""
MIN_HITS_WITH_HIDDEN_END: Final = 6
"""A log with a hidden end is reported after so many pictures: another log may hide the end in all of them."""
MIN_SCORE: Final = 0.25
"""Masks with a lower score are not logs: logs within ``MAX_RANGE_M`` score 0.5 and more, gaps in a shadow 0.2."""


class ScoredMask(Masked, Protocol):
    """A mask with its score, 0..1."""

    @property
    def score(self) -> float: ...


Segmentation = Callable[[RgbdFrame], Sequence[ScoredMask]]


class LogLocalizer(Protocol):
    """A method that turns masks into logs in the frame in which ``pose`` is given."""

    def localize(self, frame: RgbdFrame, pose: Pose, masks: Sequence[Masked]) -> list[LogObservation]:
        """Localize the logs of one picture."""

    def localize_load(self, frame: RgbdFrame, pose: Pose, masks: Sequence[Masked]) -> list[LogObservation]:
        """Localize the logs of a picture that shows a load of the crane, which must not be taken for one that lies."""


class CylinderLocalizer:
    """``autonomy.perception.log_detector``: cylinder fits and tracks."""

    def __init__(self, profile: Profile, errors: CameraErrors = NOMINAL_ERRORS) -> None:
        self._perception = Perception(profile, errors)

    def localize(self, frame: RgbdFrame, pose: Pose, masks: Sequence[Masked]) -> list[LogObservation]:
        """Return the tracks that this picture shows, without those that may be cut off at the edge of the picture."""
        tracks = self._perception.step(frame, pose, masks)
        fresh = [t for t in tracks if t.last_seen_ns == frame.stamp_ns]
        return [
            _with_unknown_ends(t.estimate).observation(t.id)
            for t in fresh
            if all(t.estimate.ends_seen) or t.hits >= MIN_HITS_WITH_HIDDEN_END
        ]

    def localize_load(self, frame: RgbdFrame, pose: Pose, masks: Sequence[Masked]) -> list[LogObservation]:
        """Return the cylinders of this picture alone."""
        logs = []
        for number, fit in enumerate(self._perception.level_fits(frame, pose, masks)):
            (x, y, z), (ax, ay, az) = pose.to_base(fit.body.center_m).tolist(), (pose.rotation @ fit.body.axis).tolist()
            logs.append(LogObservation(number, (x, y, z), (ax, ay, az), fit.body.length_m, 2.0 * fit.body.radius_m))
        return [log for log in logs if log.diameter_m < log.length_m]


def _with_unknown_ends(estimate: LogEstimate) -> LogEstimate:
    """Return the estimate with the uncertainty of an end that no picture shows: that many pictures hide it, because the
    log leaves the picture as the machine passes, does not tell where it is.
    """
    unknown = [0.0 if seen else HIDDEN_END_SIGMA_M**2 for seen in estimate.ends_seen]
    variances = np.zeros(SIZE)
    variances[[START, END]] = unknown
    return replace(estimate, covariance=estimate.covariance + np.diag(variances))


class PaperBLocalizer:
    """``autonomy.perception.papers``, extended where the paper is silent.

    Half a diameter is added along the line of sight, because the grapple needs the log's middle and the camera sees its
    surface.  A box tells nothing of the axis, and paper B's rotator does not turn (3.1): every log gets the
    direction of the view.
    """

    def localize(self, frame: RgbdFrame, pose: Pose, masks: Sequence[Masked]) -> list[LogObservation]:
        """Return a log for every box whose middle has a depth."""
        logs = []
        east, north, _ = (pose.rotation @ (0.0, 0.0, 1.0)).tolist()
        heading_rad = math.atan2(north, east)
        axis = (math.cos(heading_rad), math.sin(heading_rad), 0.0)
        for number, instance in enumerate(masks):
            rows, columns = np.flatnonzero(instance.mask.any(axis=1)), np.flatnonzero(instance.mask.any(axis=0))
            if not len(rows):
                continue
            box = (float(columns[0]), float(rows[0]), float(columns[-1] + 1), float(rows[-1] + 1))
            point = position_in_box(frame, box)
            range_m = math.inf if point is None else float(np.linalg.norm(point))
            if point is None or range_m > MAX_RANGE_M:
                continue
            x, y, z = pose.to_base(point * (1.0 + 0.5 * PAPER_B_DIAMETER_M / range_m)).tolist()
            logs.append(
                LogObservation(number, (x, y, z), axis, PAPER_B_LENGTH_M, PAPER_B_DIAMETER_M, _PAPER_B_COVARIANCE)
            )
        return logs

    localize_load = localize


_PAPER_B_SIGMAS: Final = (0.10, 0.10, 0.6, 0.6, 0.2, 0.2, 0.05)
"""Of a box [m, rad]: the position as in the paper's own errors; the axis is arbitrary."""
_PAPER_B_COVARIANCE: Final = tuple(np.diag(np.square(_PAPER_B_SIGMAS))[np.triu_indices(len(_PAPER_B_SIGMAS))].tolist())


class DrivingLogDetector:
    """One camera of a machine that drives.

    ``segment`` returns the masks of the logs in a frame; ``measured`` gets every picture that was measured.
    ``problem`` says why the last call of ``detect`` returned no logs; it is empty when the call succeeded.

    Raises:
        KeyError: the machine has no such camera.
    """

    def __init__(
        self,
        profile: Profile,
        camera: str,
        source: CameraSource,
        segment: Segmentation,
        localizer: LogLocalizer,
        measured: Callable[[MeasuredPicture], None] = ignore_picture,
    ) -> None:
        self.problem = ""
        self._profile, self._camera = profile, profile.cameras[camera]
        self._source, self._segment, self._localizer = source, segment, localizer
        self._measured = measured

    def detect(
        self, base: Pose, q: Sequence[float], articulation_rad: float, load: bool = False
    ) -> tuple[LogObservation, ...] | None:
        """Detect the logs of a new picture in the crane's base frame; None when there is no usable picture.

        ``base`` is that frame in the plane, ``q`` the joints in ``Joint`` order [rad, m], both at the time of the
        picture.  ``load`` as for `detect_in_plane`.
        """
        logs = self.detect_in_plane(lambda: (base, articulation_rad), q, load)
        return None if logs is None else tuple(in_base(o, base) for o in logs)

    def detect_in_plane(
        self, standing: Callable[[], tuple[Pose, float] | None], q: Sequence[float], load: bool = False
    ) -> tuple[LogObservation, ...] | None:
        """Detect the logs of a new picture in the plane; None when there is no usable picture.

        ``standing`` is called after the picture and returns base and articulation at its time, None when unknown.
        ``load``: the picture shows a load that hangs in the crane, and its logs are measured for themselves.
        """
        self.problem = ""
        try:
            frame = self._source.frame()
            if frame is None:
                self.problem = getattr(self._source, "problem", "") or "the camera delivers no picture"
                return None
            stood = standing()
            if stood is None:
                self.problem = "the planner says too seldom where the machine is; this computer is too busy"
                return None
            base, articulation_rad = stood
            mount = optical_pose(self._profile, self._camera, q, articulation_rad)
            frame = rescaled(frame, self._camera.depth_scale)
            pose = Pose(base.to_base(mount.position_m), base.rotation @ mount.rotation)
            masks = [instance for instance in self._segment(frame) if instance.score >= MIN_SCORE]
            localize = self._localizer.localize_load if load else self._localizer.localize
            logs = localize(frame, pose, masks)
        except (LinkError, InputRefused) as error:
            self.problem = str(error)
            return None
        near = tuple(o for o in logs if np.linalg.norm(np.asarray(o.center_m) - pose.position_m) < MAX_RANGE_M)
        self._measured(MeasuredPicture(frame, mount, masks, [in_base(o, base) for o in near]))
        return near


def in_base(o: LogObservation, base: Pose) -> LogObservation:
    """Transform a log from the plane into the base frame; the covariance refers to the axis and turns with it."""
    x, y, z = base.to_optical(np.asarray(o.center_m)).tolist()
    ax, ay, az = (np.asarray(o.axis) @ base.rotation).tolist()
    return replace(o, center_m=(x, y, z), axis=(ax, ay, az))
