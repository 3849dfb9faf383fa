"""``timberhand bench``: benchmarks that print their environment and their figures."""

from __future__ import annotations

import json
from dataclasses import asdict

import typer

from timberhand.commands import (
    bench_bus,
    bench_codec,
    bench_loop_design,
    bench_motion,
    bench_pages,
    bench_plant,
    bench_tick,
)
from timberhand.commands.options import JsonOption

app = typer.Typer(no_args_is_help=True, help="Benchmarks: measure the documented figures again.")
app.command("bus")(bench_bus.bus)
app.command("codec")(bench_codec.codec)
app.command("loop-design")(bench_loop_design.loop_design)
app.command("pages")(bench_pages.pages)
app.command("plant")(bench_plant.plant)
app.command("motion")(bench_motion.motion)
app.command("tick")(bench_tick.tick)


@app.command()
def pool(as_json: JsonOption = False) -> None:
    """Overhead of a trial, and how two workers scale: trials that only wait.

    [bold]Examples[/bold]

      timberhand bench pool
    """
    from rich.console import Console

    from experiments.benches.pool import TRIALS, WAIT_S, measure

    found = [measure(count, Console(stderr=True)) for count in (1, 2)]
    if as_json:
        print(json.dumps([asdict(one) for one in found]))
        return
    for one in found:
        print(
            f"{one.workers} worker{'s' if one.workers > 1 else ''}: {TRIALS} trials of {WAIT_S:g} s in "
            f"{one.wall_s:.2f} s, {1e3 * one.between_s:.1f} ms between two, {one.peak_bytes / 2**20:.0f} MiB each"
        )
    print(f"two are {found[0].wall_s / found[1].wall_s:.2f} times as fast as one")
