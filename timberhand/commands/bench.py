"""``timberhand bench``: measurements, each a command that prints its environment and its figures."""

from __future__ import annotations

import typer

from timberhand.commands import bench_codec, bench_plant

app = typer.Typer(no_args_is_help=True, help="Measure: every claimed figure has the command that makes it.")
app.command("codec")(bench_codec.codec)
app.command("plant")(bench_plant.plant)
