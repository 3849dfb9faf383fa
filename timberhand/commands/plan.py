"""``timberhand plan``: check, convert and draw missions in the common planning formats.

``learn`` and ``demonstrate``: crane motions learned from demonstrations (paper B 3.2.5).
"""

from __future__ import annotations

import contextlib
import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from host.exit_codes import CommandFailed, ExitCode
from runtime.errors import InputRefused
from timberhand.commands.options import JsonOption, ProfileOption, TruthOption, truth_of

if TYPE_CHECKING:
    from autonomy.missions.features import Draft
    from autonomy.missions.review import Review
    from machine.profile import Profile

app = typer.Typer(no_args_is_help=True, help="Check, convert and draw missions: GeoJSON, .plan, GPX, KML and hpr.")

File = Annotated[Path, typer.Argument(metavar="FILE", help="GeoJSON, QGroundControl .plan, GPX, KML or StanForD hpr.")]
Logs = Annotated[
    Path | None, typer.Option(metavar="FILE", help="Add the logs of this file, for example of an hpr file.")
]
Machine = Annotated[str, typer.Option(help="Profile of the machine: a shipped name or a TOML file.")]


@app.command()
def check(
    file: File,
    logs: Logs = None,
    profile: Machine = "aoro_fc8",
    strict: Annotated[bool, typer.Option("--strict", help="Treat warnings as errors (exit code 3).")] = False,
    as_json: JsonOption = False,
) -> None:
    """Check a mission: contents, duration, errors and warnings.

    Exit code 3 when the mission cannot be driven; each error names its line.

    [bold]Examples[/bold]

      timberhand plan check docs/examples/paper_b.geojson

      timberhand plan check route.gpx --logs harvest.hpr --json
    """
    from autonomy.missions.model import MissionError

    machine = _machine(profile)
    try:
        draft, review = _read(file, logs, machine)
    except MissionError as error:
        if not as_json:
            raise
        error_document = {
            "file": str(file),
            "problems": [str(problem) for problem in error.problems],
            "codes": [problem.code for problem in error.problems],
        }
        typer.echo(json.dumps(error_document, indent=2))
        raise typer.Exit(ExitCode.CONFIGURATION) from None
    if as_json:
        typer.echo(json.dumps(_facts(file, draft, review), indent=2))
    else:
        _show(file, draft, review)
    if strict and (draft.warnings or (review is not None and review.warnings)):
        raise typer.Exit(ExitCode.CONFIGURATION)


@app.command()
def convert(
    file: File,
    out: Annotated[Path, typer.Argument(metavar="OUT", help="File to write: .geojson, .plan, .gpx or .kml.")],
    logs: Logs = None,
    as_json: JsonOption = False,
) -> None:
    """Convert a mission; GeoJSON, the native format, holds every property, the others say what they leave out.

    [bold]Examples[/bold]

      timberhand plan convert route.plan mission.geojson

      timberhand plan convert route.kml mission.geojson --logs harvest.hpr

      timberhand plan convert mission.geojson route.plan
    """
    from autonomy.missions.export import FORMATS, export
    from autonomy.missions.mission_file import load_mission, save_bytes

    kind = {"json": "geojson"}.get(out.suffix.lower()[1:], out.suffix.lower()[1:])
    if kind not in FORMATS:
        better = out.parent / f"{out.stem or 'mission'}.geojson"
        raise CommandFailed(
            "plan.output-format",
            f"{out}: missions are written as {', '.join(FORMATS)}; name it {better}",
            ExitCode.USAGE,
        )
    draft = load_mission(file, logs=logs)
    exported = export(draft.mission, kind)
    save_bytes(out, exported.data)
    draft.notes += [f"{omission} not in {out.name}: {kind} does not hold it" for omission in exported.left_out]
    if as_json:
        typer.echo(json.dumps(_facts(file, draft, None) | {"out": str(out)}, indent=2))
        return
    from rich.console import Console
    from rich.markup import escape

    console = Console(soft_wrap=True, highlight=False)
    console.print(f"[green]✔[/green] {escape(str(out))}: {escape(_contents(draft))}")
    for note in draft.notes:
        console.print(f"[yellow]note[/yellow] {escape(note)}")
    for problem in draft.warnings:
        console.print(f"[yellow]warning[/yellow] {escape(str(problem))}")


@app.command()
def show(
    file: File,
    png: Annotated[Path, typer.Option(metavar="OUT", help="PNG file to write.")],
    logs: Logs = None,
    profile: Machine = "aoro_fc8",
    as_json: JsonOption = False,
) -> None:
    """Draw a mission as a map in metres: route, fences, logs, landings, and where turns begin.

    [bold]Examples[/bold]

      timberhand plan show docs/examples/paper_b.geojson --png map.png
    """

    machine = _machine(profile)
    draft, review = _read(file, logs, machine)
    if png.suffix.lower() != ".png":
        better = png.parent / f"{png.stem or 'map'}.png"
        raise CommandFailed("plan.map-format", f"{png}: the map is a PNG; name it {better}", ExitCode.USAGE)
    try:
        from timberhand.mission_map import draw
    except ImportError:
        raise CommandFailed("plan.no-matplotlib", "drawing needs matplotlib: pip install 'timberhand[tools]'") from None
    try:
        draw(draft.mission, review, png)
    except OSError as error:
        raise CommandFailed("plan.map-not-written", f"{png}: cannot be written: {error.strerror}") from None
    typer.echo(json.dumps(_facts(file, draft, review) | {"png": str(png)}, indent=2) if as_json else str(png))


@app.command()
def learn(
    recording: Annotated[
        Path,
        typer.Argument(
            metavar="RECORDING", help="Directory of a run, run.mcap, CAN recording, or demonstrations (.csv)."
        ),
    ],
    out: Annotated[Path, typer.Option("--out", metavar="FILE", help="Movement primitives to write (JSON).")],
    profile: Annotated[str | None, typer.Option(help="Machine profile (default: the recorded one).")] = None,
    plot: Annotated[
        Path | None, typer.Option(metavar="PNG", help="Plot of the demonstrated and learned motions.")
    ] = None,
    csv: Annotated[Path | None, typer.Option(metavar="FILE", help="Also write the demonstrations (CSV).")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON document on stdout.")] = False,
) -> None:
    """Learn the motions between bunk and log from a recording of manual operation.

    The encoder frames on the bus suffice. Record several motions, each from rest
    to rest, out to logs and back.

    [bold]Examples[/bold]

      timberhand plan learn runs/by-hand --out forwarder.json --plot learned.png

      timberhand plan learn crane0.log --profile aoro_fc8 --out forwarder.json
    """
    from autonomy.motion.movement_primitives import encode, learn_primitives
    from training.motion.demonstration_recordings import motions_in

    machine, motions = motions_in(recording, profile)
    try:
        primitives = learn_primitives(machine, motions)
    except InputRefused as error:
        raise CommandFailed("plan.demonstrations", f"{recording}: {error}") from None
    _write(out, encode(primitives))
    if csv is not None:
        from autonomy.motion.demonstration import format_demonstrations

        _write(csv, format_demonstrations(machine.name, motions).encode())
    if plot is not None:
        from training.motion.primitives_plot import plot_primitives

        try:
            plot_primitives(plot, machine, motions, primitives)
        except (OSError, ValueError) as error:
            raise CommandFailed("plan.plot-not-written", f"{plot}: cannot be written: {error}") from None
    facts = {
        "profile": machine.name,
        "motions": len(motions),
        "out": primitives.out.demonstrations,
        "back": primitives.back.demonstrations,
        "out_s": round(primitives.out.duration_s, 2),
        "back_s": round(primitives.back.duration_s, 2),
    }
    if as_json:
        typer.echo(json.dumps(facts))
        return
    typer.echo(
        f"{out}: learned from {facts['out']} motions out and {facts['back']} back of {len(motions)} of {machine.name}, "
        f"{primitives.out.duration_s:.1f} s and {primitives.back.duration_s:.1f} s"
    )


@app.command()
def demonstrate(
    out: Annotated[Path, typer.Argument(metavar="OUT", help="Demonstrations to write (.csv).")],
    profile: ProfileOption = "aoro_fc8",
    seed: Annotated[int, typer.Option(help="Chooses the targets and the tremor of the hand.")] = 1,
    targets: Annotated[int, typer.Option(min=1, max=40, help="Number of targets, each out and back.")] = 6,
    truth: TruthOption = "nominal",
    record: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Also record the run into DIR, for `plan learn DIR`.")
    ] = None,
) -> None:
    """Let an emulated operator move the plant's crane with its hand levers, and write the motions.

    [bold]Examples[/bold]

      timberhand plan demonstrate demonstrations.csv

      timberhand plan demonstrate shown.csv --targets 2 --record runs/by-hand
    """
    from rich.console import Console
    from rich.progress import Progress

    from autonomy.motion.demonstration import format_demonstrations, joint_track, segment_motions
    from can_dbc.dbc.codec import load
    from hil.demonstrations import demonstrate as demonstrate_motions
    from machine.loading.profile_file import load_profile
    from recorder.manifest import describe
    from recorder.recorder import Recorder

    error_console = Console(stderr=True)
    try:
        machine = load_profile(profile)
        buses = tuple(name for name in (machine.crane_bus, machine.machine_bus) if name)
        recorder = Recorder(record, machine, describe(machine, buses, seed)) if record is not None else None
        with (
            contextlib.nullcontext() if recorder is None else contextlib.closing(recorder),
            Progress(console=error_console, transient=True, disable=not error_console.is_terminal) as bar,
        ):
            task = bar.add_task("motions", total=None)
            frames = demonstrate_motions(
                profile,
                seed,
                targets,
                truth_of(profile, truth),
                recorder,
                lambda done, total: bar.update(task, completed=done, total=total),
            )
    except ValueError as error:
        raise CommandFailed.from_error(error) from None
    motions = segment_motions(machine, joint_track(machine, load("crane"), frames))
    _write(out, format_demonstrations(machine.name, motions).encode())
    typer.echo(f"{out}: {len(motions)} motions of {machine.name}")


def _machine(name: str) -> Profile:
    """Load the profile of a machine that drives."""
    from machine.loading.profile_file import load_profile

    profile = load_profile(name)
    if profile.carrier is None:
        raise CommandFailed(
            "plan.stationary-machine",
            f"{profile.name} does not drive; choose a machine with a carrier, such as aoro_fc8",
        )
    return profile


def _read(file: Path, logs: Path | None, machine: Profile) -> tuple[Draft, Review | None]:
    """Read the checked mission, and its review for the machine; None without a route."""
    from autonomy.missions.mission_file import load_mission
    from autonomy.missions.review import review

    carrier = machine.carrier
    site = None if carrier is None else (carrier.site_lat_deg, carrier.site_lon_deg)
    draft = load_mission(file, logs=logs, site=site)
    return draft, review(draft.mission, machine) if draft.mission.waypoints else None


def _facts(file: Path, draft: Draft, review: Review | None) -> dict[str, Any]:
    """Return the JSON document of a mission."""
    from math import degrees, isfinite

    mission = draft.mission
    facts: dict[str, Any] = {
        "file": str(file),
        "format": draft.format,
        "name": mission.name,
        "waypoints": len(mission.waypoints),
        "laps": mission.options.laps,
        "fences": len(mission.fences),
        "landings": len(mission.landings),
        "logs": len(mission.logs),
        "notes": draft.notes,
        "warnings": [str(problem) for problem in draft.warnings],
        "warning_codes": [problem.code for problem in draft.warnings],
    }
    if review is not None:
        corners = [
            {
                "waypoint": corner.waypoint + 1,
                "turn_deg": round(degrees(corner.turn_rad), 1),
                "switch_m": round(corner.switch_m, 2) if isfinite(corner.switch_m) else None,
            }
            for corner in review.corners
        ]
        facts |= {
            "length_m": round(review.length_m, 2),
            "drive_s": round(review.drive_s, 1),
            "logs_to_fetch": review.logs,
            "crane_s": round(review.crane_s, 1),
            "total_s": round(review.total_s, 1),
            "corners": corners,
            "warnings": facts["warnings"] + [warning.sentence for warning in review.warnings],
            "warning_codes": facts["warning_codes"] + [warning.code for warning in review.warnings],
        }
    return facts


def _contents(draft: Draft) -> str:
    """Describe the contents of a mission."""
    mission = draft.mission
    parts = (("waypoint", mission.waypoints), ("fence", mission.fences), ("landing", mission.landings))
    counted = [f"{len(p)} {word}{'' if len(p) == 1 else 's'}" for word, p in (*parts, ("log", mission.logs)) if p]
    return ", ".join(counted)


def _show(file: Path, draft: Draft, review: Review | None) -> None:
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    console = Console(soft_wrap=True, highlight=False)
    mission = draft.mission
    title = f" · {mission.name}" if mission.name else ""
    console.print(f"[bold]{escape(file.name + title)}[/bold] [dim]{draft.format}[/dim]")
    table = Table.grid(padding=(0, 2))
    table.add_row("holds", escape(_contents(draft)))
    if mission.logs:
        volume = sum(log.volume_m3 or 0.0 for log in mission.logs)
        kinds = sorted({log.species or log.assortment for log in mission.logs} - {""})
        table.add_row("logs", escape(f"{volume:.2f} m³" + (f", {', '.join(kinds)}" if kinds else "")))
    if review is not None:
        laps = f" in {mission.options.laps} laps" if mission.options.laps > 1 else ""
        table.add_row("route", f"{review.length_m:.1f} m{laps}")
        loading = f" and {review.crane_s / 60:.1f} min of loading {review.logs} logs" if review.logs else ""
        table.add_row("time", f"about {review.total_s / 60:.1f} min: {review.drive_s / 60:.1f} min of driving{loading}")
    console.print(table)
    for note in draft.notes:
        console.print(f"[yellow]note[/yellow] {escape(note)}")
    for problem in draft.warnings:
        console.print(f"[yellow]warning[/yellow] {escape(str(problem))}")
    for warning in review.warnings if review is not None else ():
        console.print(f"[yellow]warning[/yellow] {escape(warning.sentence)}")
    if review is not None and not review.warnings and not draft.warnings:
        console.print("[green]✔[/green] no warnings for this machine")


def _write(path: Path, data: bytes) -> None:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data)
    except OSError as error:
        raise CommandFailed(
            "plan.output-not-written", f"{path} cannot be written ({error.strerror}); choose another file"
        ) from None
