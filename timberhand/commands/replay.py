"""``timberhand replay``: a recorded run through today's controller, byte for byte."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def replay(
    log: Annotated[Path, typer.Argument(metavar="LOG", help="A run's directory, or its run.mcap.")],
    profile: Annotated[
        str | None, typer.Option(help="The profile of that run (default: the shipped one it names).")
    ] = None,
    key_file: Annotated[Path | None, typer.Option(help="Key of a run with authenticated datagrams.")] = None,
    contents: Annotated[bool, typer.Option("--contents", help="Only list what the recording holds.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON document on stdout.")] = False,
) -> None:
    """Feed the recorded inputs of every tick to the controller and compare its outputs with the recorded ones.

    Exit code 0 only when all ticks agree; 6 at the first difference or gap; 3 for another profile or DBC.

    [bold]Examples[/bold]

    timberhand replay runs/demo-1

    timberhand replay runs/demo-1/run.mcap --contents
    """
    import json

    from hil.replay.recording import contents as list_contents
    from hil.replay.recording import files_of, manifest_of
    from host.exit_codes import CommandFailed, ExitCode

    files = files_of(log)
    if contents:
        manifest, counts = manifest_of(files), list_contents(files)
        if as_json:
            typer.echo(json.dumps({"profile": manifest.profile, "topics": counts}))
            return
        typer.echo(f"{log}: profile {manifest.profile}, seed {manifest.seed}, {manifest.start_utc or 'lockstep'}")
        for topic, count in counts.items():
            typer.echo(f"{count:10d}  {topic}")
        return

    try:
        key = key_file.read_bytes().strip() if key_file else None
    except OSError as error:
        raise CommandFailed(
            "replay.key-unreadable", f"{key_file} cannot be read ({error.strerror})", ExitCode.CONFIGURATION
        ) from error
    result = _run(files, profile, key)
    if as_json:
        typer.echo(json.dumps(result.as_dict()))
    elif result.agrees:
        typer.echo(f"{result.ticks} ticks agree byte for byte ({result.profile}, {result.rate_hz} Hz)")
    elif result.difference:
        found = result.difference
        typer.echo(f"{result.ticks} ticks agree; tick {found['tick']} ({found['at']}) differs:")
        for side in ("recorded", "replayed"):
            for line in found[side]:
                typer.echo(f"  {side}  {line}")
    else:
        typer.echo(f"{result.ticks} ticks agree; {result.missing}")
    if not result.agrees:
        raise typer.Exit(ExitCode.FIGURE_MISSED)


def _run(files, profile, key):  # type: ignore[no-untyped-def]
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

        return run(files, profile, key, progress)
