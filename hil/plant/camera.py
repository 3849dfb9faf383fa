"""A camera of the plant in the same process: the frames that `autonomy` gets in lockstep, as over a socket."""

from __future__ import annotations

from autonomy.perception.camera.frame import RgbdFrame
from autonomy.perception.log_detector import LogDetector
from autonomy.perception.segmentation.log_segmenter import LogSegmenter
from autonomy.perception.sources.stream import frame_from_message
from can_dbc.messages.rgbd import decode, encode
from machine.profile import Profile
from runtime.errors import InputRefused
from sim.camera.rig import CameraRig
from sim.camera.server import rgbd_message
from sim.plant import Plant


class RigCamera:
    """One camera of a rig as a frame source (`autonomy.perception.sources`)."""

    def __init__(self, rig: CameraRig, camera: str) -> None:
        self._rig, self._camera = rig, camera
        self._count = 0

    def frame(self) -> RgbdFrame:
        """Return the picture now; stamps count the pictures."""
        self._count += 1
        return frame_from_message(decode(encode(rgbd_message(self._rig.frame(self._camera, self._count)))))

    def close(self) -> None:
        """Do nothing: there is nothing to release."""


def camera_detector(plant: Plant, profile: Profile, camera: str, seed: int) -> LogDetector:
    """Make a log detector behind a camera of the plant.

    Raises:
        InputRefused: the machine has no such camera.
        ValueError: the network's weights are missing.
    """
    if camera not in profile.cameras:
        names = ", ".join(profile.cameras) or "none"
        raise InputRefused("plant-camera.unknown", f"{profile.name} has no camera {camera!r}; it has: {names}")
    world = plant.world
    return LogDetector(
        profile, camera, RigCamera(CameraRig(world, profile, world.truth, seed), camera), LogSegmenter().segment
    )
