"""``timberhand compile``: compile the controller's tick ahead of time.

``timberhand bench tick``: the interpreted and the compiled tick on the same recorded or random ticks.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from host.exit_codes import ExitCode
from timberhand.commands.options import JsonOption, refuse_without_effect

if TYPE_CHECKING:
    from hil.tick.compare import Progress


def compile_tick(
    force: Annotated[bool, typer.Option("--force", help="Compile again, even if the build is ready.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Compile the controller's tick ahead of time, into build/compiled.

    Takes about a minute, once for each state of the sources. From then on
    `python -m controller` runs the compiled tick; TIMBERHAND_COMPILED=0 or
    --interpreter keeps it on the interpreter. Exit code 3 when gcc or mypyc is
    missing: everything works without.
    """
    from host.compiled.build import compile_tick as build

    answer = build(lambda stage: print(f"compile: {stage}", file=sys.stderr, flush=True), force)
    if as_json:
        print(json.dumps(answer))
    elif answer["new"]:
        print(f"compiled {answer['modules']} modules in {answer['seconds']:.0f} s: build {answer['key']}")
    else:
        print(f"build {answer['key']} is ready")


def tick(
    context: typer.Context,
    recordings: Annotated[
        list[Path] | None,
        typer.Argument(metavar="[RECORDING]...", help="Runs, or their run.mcap (default: those kept with the tests)."),
    ] = None,
    rounds: Annotated[int, typer.Option(min=1, help="Rounds of all sides; fewer than 6 decide nothing.")] = 7,
    ticks: Annotated[int, typer.Option(min=0, help="Only the first TICKS of a recording; 0: all.")] = 2000,
    random: Annotated[
        int, typer.Option("--random", min=0, metavar="TICKS", help="Compare the bytes of TICKS random ticks instead.")
    ] = 0,
    against: Annotated[
        str, typer.Option(metavar="REF|WHEEL", help="A tag, commit or wheel as third side (default: the newest tag).")
    ] = "",
    counted: Annotated[
        bool,
        typer.Option("--count", help="Count what a compiled tick executes and touches, with valgrind, instead."),
    ] = False,
    seed: Annotated[int, typer.Option(help="Seed of the random ticks.")] = 1,
    as_json: JsonOption = False,
) -> None:
    """Compare the interpreted with the compiled tick: cost in turn, or bytes of random ticks.

    Cost is the processor time of one tick without the bus, hot (replayed at
    once) and cold (caches evicted before each tick, as after 5 ms of other
    work), and the instructions of one tick where the host counts them. A ratio
    is the median over the rounds, with its 95 % interval; "inconclusive" when
    the interval holds the limit. --count needs a minute, no quiet host, and
    tells the same each time: what a tick executes, and how many cache lines it
    touches. The last release, or --against, is compiled
    in build/against and judged in the same rounds. Exit code 6 when a byte
    differs or a ratio is missed.

    [bold]Examples[/bold]

      timberhand bench tick

      timberhand bench tick runs/demo-1 --rounds 9

      timberhand bench tick --against HEAD~20

      timberhand bench tick --random 1000000

      timberhand bench tick --count --ticks 600
    """
    import tempfile

    from hil.tick import compare, release

    def progress(text: str) -> None:
        print(f"bench: {text}", file=sys.stderr, flush=True)

    if against and (random or counted):
        raise typer.BadParameter("--against compares costs; leave --random and --count out")
    if random:
        refuse_without_effect(context, ("counted", "rounds", "ticks"), "with --random")
    else:
        refuse_without_effect(context, ("seed",), "without --random")
    if counted:
        refuse_without_effect(context, ("rounds",), "with --count")
    key = compare.need_build()
    with tempfile.TemporaryDirectory() as folder:
        recording_paths = recordings or compare.kept_recordings(Path(folder))
        if random:
            rows = _random(recording_paths, seed, random, progress)
            reached = all(row["differs_after"] is None for row in rows)
        elif counted:
            rows = [_counted(recording_path, ticks, Path(folder), progress) for recording_path in recording_paths]
            reached = True
        else:
            release_reference = against or release.newest_tag()
            other = release.release(release_reference, progress) if release_reference else None
            if other is None:
                progress("no release to compare with: there is no tag, and no --against")
            rows = [
                compare.compare_cost(recording_path, ticks, rounds, progress, other)
                for recording_path in recording_paths
            ]
            reached = all(_good(row) for row in rows)
    environment = compare.environment() | {"build": key}
    result = {"environment": environment, "reached": reached, "recordings": rows}
    if as_json:
        typer.echo(json.dumps(result, indent=2))
    else:
        typer.echo("  ".join(f"{name} {value}" for name, value in environment.items()))
        for row in rows:
            (_show_random if random else _show_count if counted else _show_cost)(row)
    if not reached:
        raise typer.Exit(ExitCode.FIGURE_MISSED)


def _random(places: list[Path], seed: int, ticks: int, progress: Progress) -> list[dict[str, Any]]:
    from hil.tick.compare import compare_random

    return [compare_random(recording_path, seed, -(-ticks // len(places)), progress) for recording_path in places]


def _counted(place: Path, ticks: int, folder: Path, progress: Progress) -> dict[str, Any]:
    from hil.tick.counted import count

    progress(f"{place.parent.name}: counting")
    return count(place, ticks, folder)


def _good(row: dict[str, Any]) -> bool:
    missed = any(ratio["verdict"] == "missed" for ratio in row["ratios"].values())
    return not missed and not row["interpreter"]["differing"] and not row["compiled"]["differing"]


def _show_cost(row: dict[str, Any]) -> None:
    typer.echo(f"{row['recording']}: {row['ticks']} ticks, processor time of a tick p50 / p99")
    for side in ("interpreter", "compiled", "release"):
        if side in row:
            summary = row[side]
            figures = (
                f"{c} {summary[c]['cpu_p50_us']:.0f} / {summary[c]['cpu_p99_us']:.0f} us" for c in ("hot", "cold")
            )
            count = summary["instructions_p50"]
            counted = f"{count} instructions" if count else "instructions not counted here"
            typer.echo(f"  {side:12} {'   '.join(figures)}   {counted}   {summary['differing']} ticks differ")
    for name, summary in row["ratios"].items():
        too_few = summary["high"] is None
        interval = (
            "fewer than 6 rounds give no interval" if too_few else f"{summary['low']:.2f} to {summary['high']:.2f}"
        )
        typer.echo(
            f"  {name:20} {summary['ratio']:.2f} ({interval}), at least {summary['at_least']}: {summary['verdict']}"
        )


def _show_count(row: dict[str, Any]) -> None:
    lines = row["code_lines"] + row["read_lines"] + row["written_lines"]
    typer.echo(
        f"{row['recording']}: {row['instructions']} instructions and {lines} cache lines a tick "
        f"({row['code_lines']} of code, {row['read_lines']} read, {row['written_lines']} written), "
        f"mean of {row['ticks']}"
    )


def _show_random(row: dict[str, Any]) -> None:
    modes = ", ".join(row["modes"])
    if row["differs_after"] is None:
        typer.echo(f"{row['recording']}: {row['ticks']} random ticks give the same bytes ({modes})")
    else:
        typer.echo(f"{row['recording']}: the bytes differ within the pass after {row['differs_after']} ticks")
