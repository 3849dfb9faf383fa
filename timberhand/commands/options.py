"""Options that several commands share."""

from __future__ import annotations

import os
from collections.abc import Iterable
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import typer

from host.exit_codes import CommandFailed, ExitCode
from runtime.errors import InputRefused

if TYPE_CHECKING:
    from autonomy.grasp.planners import PlannerChoice


class Terrain(StrEnum):
    """The ground under the machine."""

    FLAT = "flat"
    ROUGH = "rough"
    SLOPE = "slope"
    HILL = "hill"
    MUD = "mud"
    DRAWN = "drawn"


TerrainOption = Annotated[
    Terrain,
    typer.Option("--terrain", help="Ground: drawn is a slope with ruts, stones and stumps, which follow the seed."),
]
ProfileOption = Annotated[str, typer.Option("--profile", help="Machine profile: a shipped name or a TOML file.")]
TruthOption = Annotated[
    str,
    typer.Option(
        "--truth",
        help="Hidden ground truth of the plant: nominal, sampled or wide_valves, of a TOML file as in sampled:FILE; "
        "NAME.truth.toml beside the profile is used by itself.",
    ),
]
JsonOption = Annotated[bool, typer.Option("--json", help="Print one JSON document on stdout.")]
SummaryOption = Annotated[bool, typer.Option("--json", help="Print the summary as JSON on stdout.")]
PageOption = Annotated[bool, typer.Option("--console/--no-console", help="Serve the operator's page (live).")]
PagePortOption = Annotated[
    int, typer.Option("--console-port", min=1, max=65535, help="Port of the operator's page on localhost.")
]
FoxglovePortOption = Annotated[
    int,
    typer.Option(
        "--foxglove",
        min=0,
        max=65535,
        metavar="PORT",
        help="Also serve the run to Foxglove and Lichtblick, read-only (live; 0: not).",
    ),
]
MaxStopsOption = Annotated[
    int, typer.Option("--max-stops", help="Stops after which the emulated operator gives up (live).")
]
GraspPlannerOption = Annotated[
    str,
    typer.Option(
        "--planner",
        metavar="NAME",
        help="Planner of grasps from the ground: search (ours), cnn (paper A's network), cnn-physical (the same, "
        "trained on grasps of the plant), or one of another package.",
    ),
]
VirtualCamerasOption = Annotated[
    int,
    typer.Option(
        "--virtual-cameras",
        metavar="N",
        help="With a network: places of the virtual camera over which its predictions are averaged.",
    ),
]
PlanPicturesOption = Annotated[
    Path | None,
    typer.Option(
        "--plan-pictures",
        metavar="DIR",
        help="With a network: what each grasp was planned from, as in Fig. 5 of paper A, as PNG.",
    ),
]
ForeignPlannerOption = Annotated[
    str, typer.Option("--planner", help="grasp-configs: a foreign grasp planner, by entry point, compared with ours.")
]
ForeignDetectorOption = Annotated[
    str, typer.Option("--detector", help="grasp-configs: a foreign log detector, by entry point, compared with ours.")
]


def check_foreign(experiment: str, planner: str, detector: str) -> None:
    """Refuse a foreign method where nothing would use it."""
    if (planner or detector) and experiment != "grasp-configs":
        raise typer.BadParameter("--planner and --detector are options of grasp-configs")


def planner_of(name: str, virtual_cameras: int, pictures: Path | None) -> PlannerChoice:
    """Return the choice of ``--planner``, ``--virtual-cameras`` and ``--plan-pictures``, whose folder is made.

    Raises:
        CommandFailed: there is no such planner, it has no virtual camera or draws no pictures, or the folder is none.
    """
    from autonomy.grasp.planners import NETWORKS, PlannerChoice

    try:
        if pictures is not None and name in NETWORKS:
            pictures.mkdir(parents=True, exist_ok=True)
        return PlannerChoice(name, virtual_cameras, str(pictures.resolve()) if pictures else "").check()
    except OSError as error:
        raise CommandFailed("planner.no-folder", f"{pictures}: {error.strerror}", ExitCode.USAGE) from None
    except InputRefused as error:
        raise CommandFailed.from_error(error, ExitCode.USAGE) from None


def truth_of(profile: str, truth: str) -> str:
    """Return the choice of ``--truth`` for the machine of ``--profile``: with the file beside a profile of one's own.

    Raises:
        ProfileError: the profile cannot be used.
    """
    from machine.loading.profile_file import load_profile
    from sim.individual import beside

    return beside(profile, load_profile(profile).name, truth)


LIVE_ONLY: Final = ("bus", "clock", "console", "console_port", "foxglove", "max_stops")
"""Parameters of a live run that a run in lockstep has no use for."""


def refuse_without_effect(given: typer.Context, parameters: Iterable[str], where: str) -> None:
    """Refuse options on the command line that do nothing here; ``where`` ends the sentence, as in "with --lockstep".

    Raises:
        CommandFailed: one of ``parameters`` was given.
    """
    if "TIMBERHAND_LAB" in os.environ:
        return  # the command was given outside, and judged there
    for parameter in given.command.params:
        source = given.get_parameter_source(parameter.name or "")
        if parameter.name in parameters and source is not None and source.name == "COMMANDLINE":
            raise CommandFailed(
                "option.no-effect", f"{parameter.opts[0]} has no effect {where}; leave it out", ExitCode.USAGE
            )
