"""``timberhand sim``: look at the simulated plant."""

from __future__ import annotations

import tempfile
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from host.exit_codes import CommandFailed, ExitCode

app = typer.Typer(no_args_is_help=True, help="The simulated plant: look at it alive, or take its picture.")


class Ground(StrEnum):
    """What the machine stands on."""

    FLAT = "flat"
    ROUGH = "rough"
    SLOPE = "slope"
    HILL = "hill"
    MUD = "mud"


class Scene(StrEnum):
    """How the logs lie."""

    RANDOM = "random"
    SINGLE = "single"
    PARALLEL = "parallel"
    CROSSED = "crossed"
    PILE = "pile"
    ROW = "row"
    BUNK = "bunk"


PROFILE = Annotated[str, typer.Option(help="A shipped profile or a TOML file.")]
SEED = Annotated[int, typer.Option(help="Chooses the logs and where they lie.")]
TRUTH = Annotated[str, typer.Option(help="The plant's truth: nominal, sampled, or a TOML file.")]
LOGS = Annotated[int, typer.Option(min=0, max=200, help="How many logs.")]
GROUND = Annotated[Ground, typer.Option(help="What the machine stands on.")]
SCENE = Annotated[Scene, typer.Option(help="How the logs lie.")]


@app.command()
def view(
    profile: PROFILE = "palms_471",
    seed: SEED = 1,
    logs: LOGS = 3,
    scene: SCENE = Scene.RANDOM,
    terrain: GROUND = Ground.FLAT,
    truth: TRUTH = "nominal",
    port: Annotated[int, typer.Option(help="Port of the page on localhost.")] = 8471,
) -> None:
    """Open a live three-dimensional view of the plant, with its pressures and hand levers, in the browser.

    [bold]Examples[/bold]

      timberhand sim view

      timberhand sim view --profile aoro_fc8 --terrain rough --scene row --logs 8
    """
    from rich.console import Console

    from hil.plant.viewer import run_view
    from machine.loading.profile_file import ProfileError, load_profile

    try:
        machine = load_profile(profile)
    except ProfileError as error:
        raise CommandFailed.from_error(error, ExitCode.CONFIGURATION) from None
    options = ["--seed", str(seed), "--logs", str(logs), "--scene", scene.value, "--terrain", terrain.value]
    with tempfile.TemporaryDirectory(prefix="timberhand-view-") as directory:
        run_view(machine, profile, [*options, "--truth", truth], port, Path(directory), Console())


@app.command()
def shot(
    out: Annotated[Path, typer.Argument(help="The PNG to write.")] = Path("plant.png"),
    profile: PROFILE = "palms_471",
    seed: SEED = 1,
    logs: LOGS = 3,
    scene: SCENE = Scene.RANDOM,
    terrain: GROUND = Ground.FLAT,
    truth: TRUTH = "nominal",
    camera: Annotated[
        str | None, typer.Option(help="A camera of the profile; without it the picture is taken from outside.")
    ] = None,
    azimuth_deg: Annotated[float, typer.Option(help="Where the outside camera stands, seen from above.")] = -50.0,
    elevation_deg: Annotated[float, typer.Option(min=5.0, max=89.0, help="How high it looks down from.")] = 22.0,
    distance_m: Annotated[float, typer.Option(min=1.0, help="How far away it stands.")] = 13.0,
    depth: Annotated[bool, typer.Option(help="Depth in colours instead of the photograph (profile cameras).")] = False,
) -> None:
    """Write a picture of the plant as it stands at the start.

    [bold]Examples[/bold]

      timberhand sim shot plant.png --scene pile --logs 5

      timberhand sim shot front.png --profile aoro_fc8 --camera front --depth
    """
    from hil.plant.picture import Shot, take
    from machine.loading.profile_file import ProfileError, load_profile

    request = Shot(
        logs=logs, scene=scene.value, seed=seed, terrain=terrain.value, truth=truth, camera=camera, depth=depth,
        azimuth_deg=azimuth_deg, elevation_deg=elevation_deg, distance_m=distance_m,
    )  # fmt: skip
    try:
        machine = load_profile(profile)
        take(machine, request, out)
    except (ProfileError, ValueError) as error:
        raise CommandFailed.from_error(error, ExitCode.CONFIGURATION) from None
    except OSError as error:
        raise CommandFailed(
            "sim.picture-not-written",
            f"{out} cannot be written ({error.strerror}); give another file",
            ExitCode.CONFIGURATION,
        ) from None
    print(out)
