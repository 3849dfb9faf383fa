"""``timberhand sim``: view the simulated plant."""

from __future__ import annotations

import tempfile
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from host.exit_codes import CommandFailed
from timberhand.commands.options import ProfileOption, Terrain, TerrainOption, TruthOption, truth_of

app = typer.Typer(no_args_is_help=True, help="View the simulated plant live, or write a picture of it.")


class Scene(StrEnum):
    """The arrangement of the logs."""

    RANDOM = "random"
    SINGLE = "single"
    PARALLEL = "parallel"
    CROSSED = "crossed"
    PILE = "pile"
    ROW = "row"
    BUNK = "bunk"


SeedOption = Annotated[int, typer.Option("--seed", help="Chooses the logs and their poses.")]
LogsOption = Annotated[int, typer.Option("--logs", min=0, max=200, help="Number of logs.")]
SceneOption = Annotated[Scene, typer.Option("--scene", help="Arrangement of the logs.")]


@app.command()
def view(
    profile: ProfileOption = "palms_471",
    seed: SeedOption = 1,
    logs: LogsOption = 3,
    scene: SceneOption = Scene.RANDOM,
    terrain: TerrainOption = Terrain.FLAT,
    truth: TruthOption = "nominal",
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port of the page on localhost.")] = 8471,
) -> None:
    """Serve a live three-dimensional view of the plant with its pressures and hand levers, for the browser.

    [bold]Examples[/bold]

      timberhand sim view

      timberhand sim view --profile aoro_fc8 --terrain rough --scene row
    """
    from rich.console import Console

    from hil.plant.viewer import run_view
    from machine.loading.profile_file import load_profile

    machine = load_profile(profile)
    options = ["--seed", str(seed), "--logs", str(logs), "--scene", scene.value, "--terrain", terrain.value]
    with tempfile.TemporaryDirectory(prefix="timberhand-view-") as directory:
        run_view(machine, profile, [*options, "--truth", truth_of(profile, truth)], port, Path(directory), Console())


@app.command()
def picture(
    out: Annotated[Path, typer.Argument(help="PNG file to write.")] = Path("plant.png"),
    profile: ProfileOption = "palms_471",
    seed: SeedOption = 1,
    logs: LogsOption = 3,
    scene: SceneOption = Scene.RANDOM,
    terrain: TerrainOption = Terrain.FLAT,
    truth: TruthOption = "nominal",
    camera: Annotated[str | None, typer.Option(help="Camera of the profile (default: an outside camera).")] = None,
    azimuth_deg: Annotated[float, typer.Option(help="Azimuth of the outside camera.")] = -50.0,
    elevation_deg: Annotated[float, typer.Option(min=5.0, max=89.0, help="Elevation of the outside camera.")] = 22.0,
    distance_m: Annotated[float, typer.Option(min=1.0, help="Distance of the outside camera.")] = 13.0,
    depth: Annotated[
        bool, typer.Option(help="Show depth as colors instead of the image (cameras of the profile).")
    ] = False,
) -> None:
    """Write a picture of the plant in its initial state.

    [bold]Examples[/bold]

      timberhand sim picture plant.png --scene pile --logs 5

      timberhand sim picture front.png --profile aoro_fc8 --camera front --depth
    """
    from hil.plant.picture import PictureRequest, take_picture
    from machine.loading.profile_file import load_profile

    request = PictureRequest(
        logs=logs,
        scene=scene.value,
        seed=seed,
        terrain=terrain.value,
        truth=truth_of(profile, truth),
        camera=camera,
        depth=depth,
        azimuth_deg=azimuth_deg,
        elevation_deg=elevation_deg,
        distance_m=distance_m,
    )
    try:
        machine = load_profile(profile)
        take_picture(machine, request, out)
    except ValueError as error:
        raise CommandFailed.from_error(error) from None
    except OSError as error:
        raise CommandFailed(
            "sim.picture-not-written", f"{out} cannot be written ({error.strerror}); give another file"
        ) from None
    print(out)
