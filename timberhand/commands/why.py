"""``timberhand why``: why the machine stopped."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from host.exit_codes import CommandFailed
from timberhand.commands.options import JsonOption, refuse_without_effect

if TYPE_CHECKING:
    from timberhand.why.stops import FoundStop


def why(
    context: typer.Context,
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
    page: Annotated[
        bool, typer.Option("--page", help="Show the newest stop in the operator's page, from 10 s before it.")
    ] = False,
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port of the page.")] = 8471,
    as_json: JsonOption = False,
) -> None:
    """Explain the last stop: code, sentence, numbers, what to do, and what happened before it.

    Without RUN it takes the newest stop on this computer, of the runs below
    runs/ and of the service (/var/lib/timberhand/stops; needs the rights to
    read it), and tells of a service that has failed since then. Exit code 0,
    also when the machine did not stop; 3 when there is no recording, or none
    that this release can read.

    [bold]Examples[/bold]

      timberhand why

      timberhand why runs/LAST --all

      timberhand why runs/LAST --plot why.png

      timberhand why --page
    """
    import msgspec

    from timberhand.why.stops import SERVICE_STOPS, newest_failure

    if page:
        refuse_without_effect(context, ("every", "plot", "as_json"), "with --page")
        _open_page(run, port)
        return
    refuse_without_effect(context, ("port",), "without --page")
    stops: list[dict[str, object]] | None = [] if as_json else None
    try:
        count, newest_utc_ns = _explain(run, every, plot, stops)
    except (OSError, ValueError) as error:
        raise _unusable(run, error) from error
    failed = newest_failure(newest_utc_ns) if run is None else None
    if not count and run is None and failed is None:
        raise _no_stop(f"below runs/, and none in {SERVICE_STOPS} that you may read")
    if as_json:
        failure = None if failed is None else msgspec.to_builtins(failed[0]) | {"times": failed[1]}
        answer = {"stops": stops, "plot": str(plot) if plot and count else None, "failure": failure}
        typer.echo(json.dumps(answer, allow_nan=False))
        return
    if failed is not None:
        failure, times = failed
        typer.echo(f"{failure.sentence}{f', {times} times since the last stop' if times > 1 else ''}")
        typer.echo(
            f"  what to do  See journalctl -u {failure.unit}; it comes back disarmed by itself unless it says no."
        )
    if not count and run is None:
        return  # a failure is all there is
    if not count:
        typer.echo(f"{run}: the machine did not stop in this recording")
    elif plot is not None:
        typer.echo(f"plot: {plot}")
    else:
        typer.echo("plot: add --plot FILE.png")


def _open_page(run: Path | None, port: int) -> None:
    """Serve the page of the newest stop: of its whole run where that is recorded, else of the stop's file."""
    from recorder.recover import run_files
    from timberhand.replay_page import show_recording
    from timberhand.why.stops import find_stops

    try:
        found_stop = next(iter(find_stops(run, newest=True)), None)
    except (OSError, ValueError) as error:
        raise _unusable(run, error) from error
    if found_stop is None:
        raise _no_stop(f"in {run or 'runs/'}")
    run_folder = found_stop.source if found_stop.source.is_dir() else found_stop.source.parent.parent
    show_recording(
        run_folder if run_files(run_folder) else found_stop.source, None, port, stop_ns=found_stop.stop.at_ns
    )


def _unusable(run: Path | None, error: Exception) -> CommandFailed:
    return CommandFailed("why.unusable", f"{run or 'the newest stop'} cannot be shown: {error}")


def _no_stop(where: str) -> CommandFailed:
    return CommandFailed("why.no-stop", f"there is no stop {where}; name a run")


def _explain(
    run: Path | None, every: bool, plot: Path | None, stops: list[dict[str, object]] | None
) -> tuple[int, int | None]:
    """Show the stops, or add them to ``stops``, one at a time; draw the last one; return their number, and its time."""
    from rich.console import Console

    from timberhand.why.screen import as_dict, show
    from timberhand.why.stops import find_stops
    from timberhand.why.timeline import events_of

    console, count = Console(highlight=False), 0
    newest: FoundStop | None = None
    for found_stop in find_stops(run, newest=not every):
        count, newest = count + 1, found_stop
        events = events_of(found_stop.ticks, found_stop.stop.at_ns)
        if stops is not None:
            stops.append(as_dict(found_stop, events))
        else:
            show(console, found_stop, events)
            console.print()
    if plot is not None and newest is not None:
        from timberhand.why.plot import draw

        draw(newest, plot)
    return count, newest.stop.utc_ns if newest is not None else None
