"""What lies there, by a camera of the machine: asked with the joints, answered with the logs.

``LogDetector.detect`` takes a picture and measures it, but only while the crane rests: a picture from a moving stick is of no
known pose.  Whoever asks gets nothing new meanwhile, and asks again.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final

import numpy as np

from autonomy.perception.camera.frame import RgbdFrame, RgbdFrameError, rescaled
from autonomy.perception.camera.mount import CameraMountError, optical_pose
from autonomy.perception.log_list.observation import LogObservation
from autonomy.perception.pipeline import Masked, Perception
from autonomy.perception.sources.camera_source import CameraSource, SourceError
from machine.joints import N_JOINTS
from machine.profile import Profile

RESTS: Final = 0.004
"""Joints that went less than this between two questions, rad or m, are at rest: 2 cm at the longest arm."""
FAMILIAR_NS: Final = 1_000_000_000
"""After a longer silence nobody knows whether the crane has moved meanwhile."""


class LogDetector:
    """One camera of a machine.  ``trouble`` says why the last look saw nothing, empty when it did.

    ``find`` gives the masks of the logs in a frame.  Raises KeyError when the machine has no such camera.
    """

    def __init__(
        self, profile: Profile, camera: str, source: CameraSource, find: Callable[[RgbdFrame], Sequence[Masked]]
    ) -> None:
        self.trouble = ""
        self.logs: tuple[LogObservation, ...] = ()
        """As of the last look."""
        self._profile, self._camera = profile, profile.cameras[camera]
        self._source, self._find = source, find
        self._perception = Perception(profile)
        self._before = np.full(N_JOINTS, np.nan)
        self._asked_ns = 0

    def detect(self, q: Sequence[float], now_ns: int) -> tuple[LogObservation, ...] | None:
        """The logs in the base frame, by a picture that is newer than the question; None when there is nothing new.

        ``q`` are the joints in ``Joint`` order [rad, m] at ``now_ns``, NaN where there is no encoder.
        """
        at = np.array(q, float)
        moved = np.abs(at - self._before)
        rests = now_ns - self._asked_ns < FAMILIAR_NS and bool(np.all(moved[np.isfinite(at)] < RESTS))
        self._before, self._asked_ns = at, now_ns
        if not rests:
            self.trouble = ""
            return None
        try:
            pose = optical_pose(self._profile, self._camera, q)
            if not np.all(np.isfinite(pose.rotation)):
                self.trouble = f"camera {self._camera.model} hangs on a joint whose position is unknown"
                return None
            frame = self._source.frame()
            if frame is None:
                self.trouble = getattr(self._source, "problem", "") or "the camera gives no picture"
                return None
            frame = rescaled(frame, self._camera.depth_scale)
            tracks = self._perception.step(frame, pose, self._find(frame))
        except (SourceError, RgbdFrameError, CameraMountError) as error:
            self.trouble = str(error)
            return None
        self.trouble = ""
        self.logs = tuple(t.estimate.observation(t.id, t.last_seen_ns == frame.stamp_ns) for t in tracks)
        return self.logs
