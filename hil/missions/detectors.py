"""What sees the logs on a mission in lockstep: a detector without mistakes, or the front camera of the plant.

``perfect`` is told where logs truly lie, round the crane and before the machine.  ``faithful`` and ``ours`` are given
pictures of the front camera, whose mount was surveyed, while the crane rests; they find the logs in them with the
shipped network and measure them as paper B did or as we do, and the crane works from what is remembered.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from autonomy.manager.activity_manager import Manager
from autonomy.manager.transition_table import ENDS, RULES
from autonomy.perception.driving_log_detector import FrontEyes, Ours, PaperB
from autonomy.perception.segmentation.log_segmenter import LogFinder
from autonomy.perception.log_list.observation import LogObservation
from hil.calibration.camera_survey import SURVEYED_BY_GNSS, surveyed_profile
from hil.harness.lockstep import Eyes
from hil.plant.camera import RigCamera
from machine.profile import Profile
from sim.camera.rig import CameraRig
from sim.instruments.ideal_detector import detect_near
from sim.plant import Plant

CAMERA: Final = "front"


class NearEyes:
    """Every log that a camera could see, where it truly lies."""

    def __init__(self, plant: Plant) -> None:
        self._plant = plant

    def look(self, q: Sequence[float], now_ns: int) -> tuple[LogObservation, ...]:
        """The logs in the crane's base frame, which looks backwards."""
        return tuple(
            LogObservation(log.id, log.position_m, log.axis, log.length_m, log.diameter_m)
            for log in detect_near(self._plant)
        )


class RouteEyes:
    """The front camera, asked while the crane rests."""

    def __init__(self, front: FrontEyes, manager: Manager) -> None:
        self._front, self._manager = front, manager

    def look(self, q: Sequence[float], now_ns: int) -> tuple[LogObservation, ...] | None:
        """The logs of a picture taken now."""
        manager = self._manager
        outlook = manager.outlook
        if RULES[manager.state].crane or manager.state in ENDS or not outlook.located or outlook.vehicle is None:
            return None
        return self._front.look(outlook.base_at(now_ns), q, outlook.vehicle.articulation_rad)


def eyes_of(kind: str, plant: Plant, profile: Profile, manager: Manager, seed: int) -> Eyes:
    """Eyes of a kind.

    Raises:
        ValueError: the machine has no front camera, or the network's weights are missing.
    """
    if kind == "perfect":
        return NearEyes(plant)
    if CAMERA not in profile.cameras:
        raise ValueError(f"{profile.name} has no camera {CAMERA!r}; add [cameras.{CAMERA}] to the profile")
    seeing = surveyed_profile(profile, plant.world.truth, CAMERA, seed)
    source = RigCamera(CameraRig(plant.world, profile, plant.world.truth, seed), CAMERA)
    sight = Ours(seeing, SURVEYED_BY_GNSS) if kind == "ours" else PaperB()
    return RouteEyes(FrontEyes(seeing, CAMERA, source, LogFinder().segment, sight), manager)
