"""A camera of the plant in the same process: what `autonomy` sees in lockstep, the same as over a socket."""

from __future__ import annotations

from autonomy.perception.finder import LogFinder
from autonomy.perception.frame import Frame
from autonomy.perception.log_detector import Eyes
from autonomy.perception.sources.stream import received
from can_dbc.rgbd import decode, encode
from machine.profile import Profile
from sim.camera.rig import CameraRig
from sim.camera.server import on_the_wire
from sim.plant import Plant


class RigCamera:
    """One camera of a rig, asked for frames (``autonomy.perception.sources``)."""

    def __init__(self, rig: CameraRig, camera: str) -> None:
        self._rig, self._camera = rig, camera
        self._count = 0

    def frame(self) -> Frame:
        """What it sees now; stamps count the pictures."""
        self._count += 1
        return received(decode(encode(on_the_wire(self._rig.frame(self._camera, self._count)))))

    def close(self) -> None:
        """Nothing to let go of."""


def eyes_of(plant: Plant, profile: Profile, camera: str, seed: int) -> Eyes:
    """Eyes behind a camera of the plant.

    Raises:
        ValueError: the machine has no such camera, or the network's weights are missing.
    """
    if camera not in profile.cameras:
        raise ValueError(f"{profile.name} has no camera {camera!r}; it has: {', '.join(profile.cameras) or 'none'}")
    world = plant.world
    return Eyes(profile, camera, RigCamera(CameraRig(world, profile, world.truth, seed), camera), LogFinder().segment)
