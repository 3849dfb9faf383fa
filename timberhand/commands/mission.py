"""``timberhand mission``: the forwarder does a whole mission, and what it does next, as a chart."""

from __future__ import annotations

import json
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from host.exit_codes import Exit, Stopped
from timberhand.commands.runs import Backend, enter_lab, new_directory

app = typer.Typer(no_args_is_help=True, help="Run a forwarding mission, and show what the forwarder does next.")


class Way(StrEnum):
    """Whose way the mission is done."""

    OURS = "ours"
    PAPER_B = "paper-b"


class Sight(StrEnum):
    """What sees the logs."""

    PERFECT = "perfect"
    FAITHFUL = "faithful"
    OURS = "ours"


@app.command()
def run(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="The mission, in any format of `timberhand plan`.")],
    lockstep: Annotated[bool, typer.Option(help="Virtual time in one process, bit-identical for a seed.")] = False,
    seed: Annotated[int, typer.Option(help="Chooses the plant's wood and noise.")] = 1,
    way: Annotated[Way, typer.Option(help="Our way, or paper B's activity manager and steering law.")] = Way.OURS,
    eyes: Annotated[
        Sight,
        typer.Option(
            help="A detector without mistakes, or the front camera with paper B's pipeline or ours (lockstep)."
        ),
    ] = Sight.PERFECT,
    logs: Annotated[int, typer.Option(min=0, help="So many logs along the route instead of those in the mission.")] = 0,
    profile: Annotated[str, typer.Option(help="A shipped profile or a TOML file.")] = "aoro_fc8",
    truth: Annotated[str, typer.Option(help="The plant's hidden truth: nominal, sampled, or a TOML file.")] = "nominal",
    out: Annotated[Path | None, typer.Option(help="Directory of the run's logs (default: under runs/).")] = None,
    bus: Annotated[
        Backend, typer.Option(help="vcan (in user-mode Linux if need be), the wire, or what is there (live).")
    ] = Backend.AUTO,
    console: Annotated[bool, typer.Option(help="Serve the page that shows the machine (live).")] = True,
    console_port: Annotated[int, typer.Option(help="Port of the page on localhost.")] = 8471,
    patience: Annotated[int, typer.Option(help="How many stops the stand-in operator arms again after (live).")] = 20,
    limit_s: Annotated[float, typer.Option(help="Give up after so many seconds of the machine's time.")] = 7200.0,
    as_json: Annotated[bool, typer.Option("--json", help="Print the summary as JSON on stdout.")] = False,
) -> None:
    """The forwarder follows its route, collects the logs and brings them to the end of the route.

    Exit code 0: the mission came to its end, and all that was loaded lies in the bunk by the plant's physics.

    [bold]Examples[/bold]

      timberhand mission run docs/examples/paper_b.geojson --lockstep

      timberhand mission run docs/examples/paper_b.geojson --bus vcan

      timberhand mission run docs/examples/paper_b.geojson --way paper-b --seed 3
    """
    from dataclasses import asdict

    from rich.console import Console

    from autonomy.missions.mission_file import load_mission
    from autonomy.missions.model import MissionError
    from machine.load import ProfileError, load_profile

    if not lockstep:
        enter_lab(bus)
    try:
        machine = load_profile(profile)
        carrier = machine.carrier
        site = None if carrier is None else (carrier.site_lat_deg, carrier.site_lon_deg)
        mission = load_mission(file, route_wanted=True, site=site).mission
    except (MissionError, ProfileError) as error:
        raise Stopped(Exit.CONFIGURATION, str(error)) from None
    directory = out or new_directory(f"mission-{file.stem}-{way.value}-seed{seed}")
    screen = Console(stderr=as_json)
    if lockstep:
        from hil.missions.lockstep import run_mission

        summary = run_mission(mission, profile, seed, truth, way.value, logs, directory, limit_s, screen, eyes.value)
    else:
        from hil.harness.live import LiveOptions
        from hil.missions.live import run_live_mission

        page = console_port if console else 0
        options = LiveOptions(profile, machine, seed, truth, bus.value, directory, page, limit_s, patience)
        summary = run_live_mission(file, mission, options, way.value, logs, screen)
    summary.show(screen)
    summary.save(directory / "summary.json")
    if as_json:
        print(json.dumps(asdict(summary)))
    raise typer.Exit(summary.exit)


@app.command()
def states(
    docs: Annotated[Path | None, typer.Option(help="Write the page activity.md into this folder.")] = None,
) -> None:
    """The activity manager's tables as a page with charts: paper B's (Fig. 8) and ours.

    [bold]Examples[/bold]

      timberhand mission states --docs docs
    """
    from autonomy.manager.state_chart import page

    if docs is None:
        print(page())
        return
    (docs / "activity.md").write_text(page())
    print(f"written: {docs / 'activity.md'}")
