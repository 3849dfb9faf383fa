"""``timberhand dbc``: check DBC files and the codecs compiled from them."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from host.exit_codes import ExitCode
from timberhand.commands.options import JsonOption

app = typer.Typer(no_args_is_help=True, help="Check DBC and KCD files.")


@app.callback()
def group() -> None:
    """Keep ``check`` a subcommand although it is the only one."""


@app.command(
    epilog="Examples:  timberhand dbc check crane machine gnss  ·  timberhand dbc check my.dbc --frames 2000 --strict"
)
def check(
    files: Annotated[
        list[str], typer.Argument(metavar="FILE...", help="DBC or KCD paths, or shipped: crane, machine, gnss.")
    ],
    frames: Annotated[
        int, typer.Option(min=1, help="Random frames per message for the comparison with cantools.")
    ] = 200,
    seed: Annotated[int, typer.Option(help="Seed of the random frames.")] = 1,
    strict: Annotated[bool, typer.Option("--strict", help="Treat lint warnings as errors (exit code 3).")] = False,
    as_json: JsonOption = False,
) -> None:
    """Compile each FILE, compare its codecs with cantools on random frames, and lint it.

    Exit code 3 when a file cannot be loaded, 6 when a compiled codec differs from
    cantools.
    """
    from can_dbc.dbc.check import check as check_file

    reports = [check_file(file, frames, seed) for file in files]
    if as_json:
        typer.echo(json.dumps({"frames": frames, "seed": seed, "files": [asdict(r) for r in reports]}, indent=2))
    else:
        _show(reports)
    if any(r.error for r in reports) or (strict and any(r.warnings for r in reports)):
        raise typer.Exit(ExitCode.CONFIGURATION)
    if any(r.different for r in reports):
        raise typer.Exit(ExitCode.FIGURE_MISSED)


def _show(reports: list) -> None:  # type: ignore[type-arg]

    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    console = Console(soft_wrap=True, highlight=False)
    table = Table(box=None, header_style="bold", pad_edge=False)
    table.add_column("file")
    for column in ("messages", "signals", "decoded", "encoded", "differ", "warnings"):
        table.add_column(column, justify="right")
    table.add_column("")
    for r in reports:
        verdict = "[red]✘ cannot be loaded[/red]" if r.error else "[green]✔[/green]"
        if r.different:
            verdict = "[red]✘ differs from cantools[/red]"
        counts = (r.messages, r.signals, r.decoded, r.encoded, r.different, len(r.warnings))
        table.add_row(escape(Path(r.path).name), *map(str, counts), verdict)
    console.print(table)
    for r in reports:
        if r.error:
            console.print(f"[red]error[/red] {escape(r.error)}")
        for text in r.differences:
            console.print(f"[red]differs[/red] {escape(text)}")
        for w in r.warnings:
            where = f"{Path(r.path).name}: {w.where}"
            console.print(f"[yellow]warning[/yellow] {escape(where)}: {escape(w.text)} [dim]({w.rule})[/dim]")
