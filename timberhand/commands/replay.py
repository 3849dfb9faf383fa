"""``timberhand replay``: feed a recorded run to today's controller and compare byte for byte."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from host.exit_codes import ExitCode
from timberhand.commands.options import JsonOption, refuse_without_effect

if TYPE_CHECKING:
    from hil.replay.replay import Result


def replay(
    context: typer.Context,
    recording: Annotated[Path, typer.Argument(metavar="RECORDING", help="Directory of a run, or its run.mcap.")],
    profile: Annotated[
        str | None, typer.Option(help="Profile of that run (default: the shipped profile named in it).")
    ] = None,
    contents: Annotated[bool, typer.Option("--contents", help="Only list the topics of the recording.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Replay the recorded inputs of every tick and compare the controller's outputs with the recorded ones.

    Exit code 0 only when all ticks agree, 6 at the first difference or gap, 3
    when profile or DBC have changed.

    [bold]Examples[/bold]

      timberhand replay runs/demo-1

      timberhand replay runs/demo-1/run.mcap --contents
    """
    from hil.replay.recording import contents as list_contents
    from hil.replay.recording import files_of, manifest_of

    if contents:
        refuse_without_effect(context, ("profile",), "with --contents")
    files = files_of(recording)
    if contents:
        manifest, counts = manifest_of(files), list_contents(files)
        if as_json:
            typer.echo(json.dumps({"profile": manifest.profile, "topics": counts}))
            return
        typer.echo(f"{recording}: profile {manifest.profile}, seed {manifest.seed}, {manifest.start_utc or 'lockstep'}")
        for topic, count in counts.items():
            typer.echo(f"{count:10d}  {topic}")
        return

    result = _run(files, profile)
    if as_json:
        typer.echo(json.dumps(result.as_dict()))
    elif result.agrees:
        typer.echo(f"{result.ticks} ticks agree byte for byte ({result.profile}, {result.rate_hz} Hz)")
    elif result.difference:
        difference = result.difference
        typer.echo(f"{result.ticks} ticks agree; tick {difference['tick']} ({difference['at']}) differs:")
        for side in ("recorded", "replayed"):
            for line in difference[side]:
                typer.echo(f"  {side}  {line}")
    else:
        typer.echo(f"{result.ticks} ticks agree; {result.missing}")
    if not result.agrees:
        raise typer.Exit(ExitCode.FIGURE_MISSED)


def _run(files: list[Path], profile: str | None) -> Result:
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    from hil.replay.replay import replay as run

    columns = (TextColumn("replay"), BarColumn(), MofNCompleteColumn(), TextColumn("ticks"), TimeRemainingColumn())
    error = Console(stderr=True)
    with Progress(*columns, console=error, transient=True, disable=not error.is_terminal) as bar:
        task = bar.add_task("replay", total=None)

        def progress(done: int, total: int) -> None:
            if done % 100 == 0:
                bar.update(task, completed=done, total=total)

        return run(files, profile, progress)
