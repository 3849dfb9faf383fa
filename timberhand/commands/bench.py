"""``timberhand bench``: benchmarks that print their environment and their figures."""

from __future__ import annotations

import typer

from timberhand.commands import (
    bench_bus,
    bench_codec,
    bench_loop_design,
    bench_motion,
    bench_pages,
    bench_plant,
    bench_pool,
    bench_tick,
)

app = typer.Typer(no_args_is_help=True, help="Benchmarks: measure the documented figures again.")
app.command("bus")(bench_bus.bus)
app.command("codec")(bench_codec.codec)
app.command("loop-design")(bench_loop_design.loop_design)
app.command("pages")(bench_pages.pages)
app.command("plant")(bench_plant.plant)
app.command("motion")(bench_motion.motion)
app.command("pool")(bench_pool.pool)
app.command("tick")(bench_tick.tick)
