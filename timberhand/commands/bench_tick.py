"""``timberhand bench tick``: the interpreted and the compiled tick on the same recorded or random ticks."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer

from timberhand.commands.options import JsonOption

if TYPE_CHECKING:
    from hil.tick.compare import Progress

MIN_RATIO: Final = 2.0


def tick(
    recordings: Annotated[
        list[Path] | None,
        typer.Argument(metavar="[RECORDING]...", help="Runs, or their run.mcap (default: those kept with the tests)."),
    ] = None,
    rounds: Annotated[int, typer.Option(min=1, help="Turns of each side; the quietest counts.")] = 3,
    ticks: Annotated[int, typer.Option(min=0, help="Only the first TICKS of a recording; 0: all.")] = 2000,
    random: Annotated[
        int, typer.Option("--random", min=0, metavar="TICKS", help="Compare the bytes of TICKS random ticks instead.")
    ] = 0,
    seed: Annotated[int, typer.Option(help="Seed of the random ticks.")] = 1,
    as_json: JsonOption = False,
) -> None:
    """Compare the interpreted with the compiled tick: cost in turn, or bytes of random ticks.

    Cost is the processor time of one tick without the bus, hot (replayed at
    once) and cold (caches evicted before each tick, as after 5 ms of other
    work). Exit code 6 when a byte differs or a ratio is below 2.

    [bold]Examples[/bold]

      timberhand bench tick

      timberhand bench tick runs/demo-1 --rounds 5

      timberhand bench tick --random 1000000
    """
    import json
    import sys
    import tempfile

    from hil.tick import compare
    from host.exit_codes import ExitCode

    def progress(text: str) -> None:
        print(f"bench: {text}", file=sys.stderr, flush=True)

    key = compare.need_build()
    with tempfile.TemporaryDirectory() as folder:
        places = recordings or compare.kept_recordings(Path(folder))
        if random:
            rows = _random(places, seed, random, progress)
            reached = all(row["differs_after"] is None for row in rows)
        else:
            rows = [compare.compare_cost(place, ticks, rounds, progress) for place in places]
            reached = all(_good(row) for row in rows)
    environment = compare.environment() | {"build": key}
    result = {"environment": environment, "reached": reached, "recordings": rows}
    if as_json:
        typer.echo(json.dumps(result, indent=2))
    else:
        typer.echo("  ".join(f"{name} {value}" for name, value in environment.items()))
        for row in rows:
            _show_random(row) if random else _show_cost(row)
    if not reached:
        raise typer.Exit(ExitCode.FIGURE_MISSED)


def _random(places: list[Path], seed: int, ticks: int, progress: Progress) -> list[dict[str, Any]]:
    from hil.tick.compare import compare_random

    return [compare_random(place, seed, -(-ticks // len(places)), progress) for place in places]


def _good(row: dict[str, Any]) -> bool:
    ratios = row["compiled_ratio_hot"], row["compiled_ratio_cold"]
    return min(ratios) >= MIN_RATIO and not row["interpreter"]["differing"] and not row["compiled"]["differing"]


def _show_cost(row: dict[str, Any]) -> None:
    typer.echo(f"{row['recording']}: {row['ticks']} ticks, processor time of a tick p50 / p99")
    for side in ("interpreter", "compiled"):
        found = row[side]
        figures = (f"{c} {found[c]['cpu_p50_us']:.0f} / {found[c]['cpu_p99_us']:.0f} us" for c in ("hot", "cold"))
        typer.echo(f"  {side:12} {'   '.join(figures)}   {found['differing']} ticks differ from the recording")
    hot, cold = row["compiled_ratio_hot"], row["compiled_ratio_cold"]
    typer.echo(f"  compiled is {hot:.2f} times as fast hot, {cold:.2f} times cold (needed {MIN_RATIO:.0f})")


def _show_random(row: dict[str, Any]) -> None:
    modes = ", ".join(row["modes"])
    if row["differs_after"] is None:
        typer.echo(f"{row['recording']}: {row['ticks']} random ticks give the same bytes ({modes})")
    else:
        typer.echo(f"{row['recording']}: the bytes differ within the pass after {row['differs_after']} ticks")
