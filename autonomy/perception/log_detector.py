"""The log detector: one camera of the machine in, the list of logs in the crane's base frame out.

``LogDetector.detect`` takes a picture only while the crane is at rest, because the pose of a camera on a moving stick
is not known well enough.  Otherwise it returns None, and the caller requests again.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final

import numpy as np

from autonomy.perception.camera.frame import RgbdFrame, optical_pose, rescaled
from autonomy.perception.fitting.measure import Masked
from autonomy.perception.log_list import LogObservation
from autonomy.perception.pipeline import Perception
from autonomy.perception.shown_picture import MeasuredPicture, ignore_picture
from autonomy.perception.sources.camera_source import CameraSource
from machine.joints import N_JOINTS
from machine.profile import Profile
from runtime.errors import InputRefused, LinkError

REST_TOLERANCE: Final = 0.004
"""The crane is at rest when no joint moves by more than this between two requests [rad, m]: 2 cm at full reach."""
MAX_REQUEST_GAP_NS: Final = 1_000_000_000
"""After a longer gap between requests it is unknown whether the crane moved."""


class LogDetector:
    """One camera of a machine.

    ``segment`` returns the masks of the logs in a frame; ``measured`` gets every picture that was measured.
    ``problem`` says why the last call of ``detect`` returned no logs; it is empty when the call succeeded or the crane
    was moving.

    Raises:
        KeyError: the machine has no such camera.
    """

    def __init__(
        self,
        profile: Profile,
        camera: str,
        source: CameraSource,
        segment: Callable[[RgbdFrame], Sequence[Masked]],
        measured: Callable[[MeasuredPicture], None] = ignore_picture,
    ) -> None:
        self.problem = ""
        self.logs: tuple[LogObservation, ...] = ()
        """Result of the last successful detection."""
        self._profile, self._camera = profile, profile.cameras[camera]
        self._source, self._segment, self._measured = source, segment, measured
        self._perception = Perception(profile)
        self._last_q = np.full(N_JOINTS, np.nan)
        self._last_request_ns = 0

    def rests(self, q: Sequence[float], now_ns: int) -> bool:
        """Whether the crane rests: its joints ``q`` at ``now_ns`` are those of the last call, not long ago."""
        at = np.array(q, float)
        moved = np.abs(at - self._last_q)
        recent = now_ns - self._last_request_ns < MAX_REQUEST_GAP_NS
        self._last_q, self._last_request_ns = at, now_ns
        return recent and bool(np.all(moved[np.isfinite(at)] < REST_TOLERANCE))

    def detect(self, q: Sequence[float], now_ns: int) -> tuple[LogObservation, ...] | None:
        """The logs in the base frame from a picture that is newer than the request; None when there is none.

        ``q`` are the joints in ``Joint`` order [rad, m] at ``now_ns``, NaN where there is no encoder.
        """
        if not self.rests(q, now_ns):
            self.problem = ""
            return None
        try:
            pose = optical_pose(self._profile, self._camera, q)
            if not np.all(np.isfinite(pose.rotation)):
                self.problem = f"the pose of camera {self._camera.model} depends on a joint whose position is unknown"
                return None
            frame = self._source.frame()
            if frame is None:
                self.problem = getattr(self._source, "problem", "") or "the camera delivers no picture"
                return None
            frame = rescaled(frame, self._camera.depth_scale)
            masks = self._segment(frame)
            tracks = self._perception.step(frame, pose, masks)
        except (LinkError, InputRefused) as error:
            self.problem = str(error)
            return None
        self.problem = ""
        self.logs = tuple(t.estimate.observation(t.id, t.last_seen_ns == frame.stamp_ns) for t in tracks)
        self._measured(MeasuredPicture(frame, pose, masks, self.logs))
        return self.logs
