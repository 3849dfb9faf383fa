"""``timberhand bench bus``: the cost of receiving a frame, compared with python-can in one run."""

from __future__ import annotations

from typing import Annotated, Any

import typer

from timberhand.commands.options import JsonOption


def bus(
    frames: Annotated[int, typer.Option(min=10, help="Frames per round and receive path.")] = 1000,
    rounds: Annotated[int, typer.Option(min=3, help="Rounds with all paths in turn; the median counts.")] = 31,
    as_json: JsonOption = False,
) -> None:
    """Measure the time from the socket to checked and decoded values, per frame of crane0, for every receive path.

    Uses vcan where the kernel has it, else a socket pair with the same code on
    top. Exit code 6 when the fast path needs more than 5 us per frame; not
    evaluated inside user-mode Linux.

    [bold]Examples[/bold]

      timberhand bench bus

      timberhand hil vcan -- timberhand bench bus --rounds 5
    """
    import json

    from experiments.common.result import environment
    from experiments.timing.receive_cost import LIMIT_US, measure
    from host.exit_codes import ExitCode

    result = {"environment": environment()} | measure(frames, rounds)
    metrics, lab = result["metrics"], result["lab"]
    reached = metrics["rx_decode_us"] <= LIMIT_US
    if as_json:
        typer.echo(json.dumps(result, indent=2))
    else:
        _show(result, reached)
    if not reached and not lab:
        raise typer.Exit(ExitCode.FIGURE_MISSED)


def _show(result: dict[str, Any], reached: bool) -> None:
    from rich.console import Console
    from rich.table import Table

    screen = Console(soft_wrap=True, highlight=False)
    metrics = result["metrics"]
    screen.print("  ".join(f"[dim]{name}[/dim] {value}" for name, value in result["environment"].items()))
    table = Table(box=None, header_style="bold", pad_edge=False)
    table.add_column("path")
    for column in ("receive µs", "+ check and decode µs"):
        table.add_column(column, justify="right")
    for name, label in result["paths"].items():
        suffix = "" if name == "ours" else f"_{name}"
        table.add_row(label, f"{metrics[f'rx{suffix}_us']:.2f}", f"{metrics[f'rx_decode{suffix}_us']:.2f}")
    screen.print(table)
    if "pair" in result["paths"]["ours"]:
        screen.print("[dim]This kernel has no CAN: a pair of datagram sockets carries the frames instead.[/dim]")
    screen.print(f"python-can costs {metrics['rx_decode_ratio']:.1f} times as much")
    if result["lab"]:
        screen.print("[yellow]lab: user-mode Linux, where a system call costs a hundred times as much[/yellow]")
    else:
        mark = "[green]✔[/green]" if reached else "[red]✘[/red]"
        screen.print(f"{mark} at most {result['limit_us']:.0f} µs per frame, received and decoded")
    screen.print(f"[dim]{result['rounds']} rounds of {result['frames']} frames, {result['clock']}[/dim]")
