"""``timberhand why``: why the machine stopped."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from timberhand.commands.options import JsonOption

if TYPE_CHECKING:
    from timberhand.why.stops import FoundStop


def why(
    run: Annotated[
        Path | None,
        typer.Argument(
            metavar="[RUN]", help="Run, directory of stops, stop file or run.mcap (default: the newest stop here)."
        ),
    ] = None,
    every: Annotated[bool, typer.Option("--all", help="Show every stop, oldest first, not only the newest.")] = False,
    plot: Annotated[
        Path | None, typer.Option(metavar="FILE.png", help="Draw the newest stop: 10 s before it and 5 s after it.")
    ] = None,
    key_file: Annotated[Path | None, typer.Option(help="Key file of a run with authenticated datagrams.")] = None,
    as_json: JsonOption = False,
) -> None:
    """Explain the last stop: code, sentence, numbers, what to do, and what happened before it.

    Without RUN it takes the newest stop on this computer, of the runs below
    runs/ and of the service (/var/lib/timberhand/stops; needs the rights to
    read it). Exit code 0, also when the machine did not stop; 3 when there is
    no recording, or none that this release can read.

    [bold]Examples[/bold]

      timberhand why

      timberhand why runs/LAST --all

      timberhand why runs/LAST --plot why.png
    """
    import json

    from host.exit_codes import CommandFailed, ExitCode
    from timberhand.why.stops import SERVICE_STOPS

    try:
        key = key_file.read_bytes().strip() if key_file else None
    except OSError as error:
        raise CommandFailed(
            "why.key-unreadable", f"{key_file} cannot be read ({error.strerror})", ExitCode.CONFIGURATION
        ) from error
    stops: list[dict[str, object]] | None = [] if as_json else None
    try:
        count = _explain(run, every, plot, key, stops)
    except (OSError, ValueError) as error:
        raise CommandFailed(
            "why.unusable", f"{run or 'the newest stop'} cannot be shown: {error}", ExitCode.CONFIGURATION
        ) from error
    if not count and run is None:
        raise CommandFailed(
            "why.no-stop",
            f"there is no stop below runs/, and none in {SERVICE_STOPS} that you may read; name a run",
            ExitCode.CONFIGURATION,
        )
    if as_json:
        typer.echo(json.dumps({"stops": stops, "plot": str(plot) if plot and count else None}, allow_nan=False))
    elif not count:
        typer.echo(f"{run}: the machine did not stop in this recording")
    elif plot is not None:
        typer.echo(f"plot: {plot}")
    else:
        typer.echo("plot: add --plot FILE.png")


def _explain(
    run: Path | None, every: bool, plot: Path | None, key: bytes | None, stops: list[dict[str, object]] | None
) -> int:
    """Show the stops, or add them to ``stops``, one at a time; draw the last one; return their number."""
    from rich.console import Console

    from timberhand.why.screen import as_dict, show
    from timberhand.why.stops import find_stops
    from timberhand.why.timeline import events_of

    console, count = Console(highlight=False), 0
    newest: FoundStop | None = None
    for found in find_stops(run, key, newest=not every):
        count, newest = count + 1, found
        events = events_of(found.ticks, found.stop.at_ns, key)
        if stops is not None:
            stops.append(as_dict(found, events))
        else:
            show(console, found, events)
            console.print()
    if plot is not None and newest is not None:
        from timberhand.why.plot import draw

        draw(newest, plot, key)
    return count
