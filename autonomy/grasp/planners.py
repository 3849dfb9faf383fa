"""Grasp planners by name: our search, paper A's network, and those of other packages.

``search`` looks for the best grasp by the capture rule (`autonomy.grasp.sampling_planner`).  ``cnn`` is paper A's chain
(section II): virtual scene, depth image, network trained on Cornell's pictures.  ``cnn-physical`` is the same network
trained on grasps of the plant, with the height from the capture rule.  Any other name is an entry point of the group
``timberhand.grasp_planners``, a factory without arguments that returns a `GraspPlanner`.
"""

from __future__ import annotations

from functools import cache
from importlib.metadata import entry_points
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple

from autonomy.grasp.planner import GraspPlanner
from autonomy.grasp.sampling_planner import SamplingPlanner
from autonomy.networks import SHIPPED
from runtime.errors import InputRefused
from runtime.plugins import load_plugin

if TYPE_CHECKING:
    from autonomy.grasp.network import GraspNet

GRASP_PLANNERS: Final = "timberhand.grasp_planners"
SEARCH: Final = "search"
PHYSICAL: Final = "cnn-physical"
NETWORKS: Final = {"cnn": "grasp_cornell.onnx", PHYSICAL: "grasp_physical.onnx"}
"""Planners with a network, and their weights."""
NAMES: Final = (SEARCH, *NETWORKS)
MAX_VIRTUAL_CAMERAS: Final = 32


class PlannerChoice(NamedTuple):
    """A planner's name, over how many places of the virtual camera a network's predictions are averaged, and the folder
    that gets a picture of every plan.
    """

    name: str = SEARCH
    virtual_cameras: int = 1
    pictures: str = ""

    def check(self) -> PlannerChoice:
        """Check the choice and return it; nothing is loaded.

        Raises:
            InputRefused: there is no such planner, it has no virtual camera, or the folder is none.
        """
        if self.name not in NAMES and not entry_points(group=GRASP_PLANNERS, name=self.name):
            foreign = sorted({point.name for point in entry_points(group=GRASP_PLANNERS)})
            raise InputRefused(
                "planner.unknown",
                f"there is no grasp planner {self.name!r}; there are: {', '.join((*NAMES, *foreign))}",
            )
        if not 1 <= self.virtual_cameras <= MAX_VIRTUAL_CAMERAS:
            raise InputRefused(
                "planner.virtual-cameras",
                f"{self.virtual_cameras} virtual cameras: the network's predictions can be averaged over 1 to "
                f"{MAX_VIRTUAL_CAMERAS}",
            )
        if self.pictures and self.name not in NETWORKS:
            raise InputRefused(
                "planner.no-pictures",
                f"the planner {self.name!r} draws no pictures of its plans; those that do are: {', '.join(NETWORKS)}",
            )
        if self.pictures and not Path(self.pictures).is_dir():
            raise InputRefused("planner.no-folder", f"{self.pictures} is no folder; make it first")
        if self.virtual_cameras > 1 and self.name not in NETWORKS:
            raise InputRefused(
                "planner.no-virtual-camera",
                f"the planner {self.name!r} has no virtual camera; those with one are: {', '.join(NETWORKS)}",
            )
        return self

    def make(self) -> GraspPlanner:
        """Make the planner.

        Raises:
            InputRefused: as `check`.
            ConfigError: the package's planner cannot be loaded.
            InputRefused: the network's weights are missing or damaged.
        """
        self.check()
        if self.name == SEARCH:
            return SamplingPlanner()
        if self.name not in NETWORKS:
            return load_plugin(GRASP_PLANNERS, self.name)  # type: ignore[no-any-return]
        from autonomy.grasp.cnn_planner import CnnPlanner

        pictures = Path(self.pictures) if self.pictures else None
        return CnnPlanner(network(NETWORKS[self.name]), self.name == PHYSICAL, self.virtual_cameras, pictures=pictures)

    def arguments(self) -> tuple[str, ...]:
        """List the arguments that choose this planner on the command line of `autonomy`; none for the default."""
        options = () if self.name == SEARCH else ("--planner", self.name)
        if self.virtual_cameras > 1:
            options = (*options, "--virtual-cameras", str(self.virtual_cameras))
        return (*options, "--plan-pictures", self.pictures) if self.pictures else options


OUR_PLANNER: Final = PlannerChoice()


@cache
def network(weights: str) -> GraspNet:
    """Load paper A's network with shipped weights.

    Raises:
        InputRefused: they are missing or damaged.
    """
    from autonomy.grasp.network import GraspNet  # loads OpenVINO, which a search does not need

    return GraspNet(SHIPPED / weights)
