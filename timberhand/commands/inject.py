"""``timberhand inject``: inject a fault into a live run, or into the one-log job in lockstep."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated

import typer

from host.exit_codes import CommandFailed, ExitCode
from runtime.errors import InputRefused
from timberhand.commands.options import ProfileOption, TruthOption, refuse_without_effect, truth_of


def inject(
    context: typer.Context,
    name: Annotated[str, typer.Argument(help="A fault (encoder-stuck) or a component (encoder-lift).")] = "",
    word: Annotated[
        str, typer.Argument(help="off, stuck, garbage, wrong, slow, delayed or intermittent; for a component.")
    ] = "",
    at: Annotated[str, typer.Option(help="When: 12.3s after the start (lockstep), or from now (live).")] = "0s",
    length: Annotated[str, typer.Option("--for", help="How long, as in 500ms or 2s (default: for ever).")] = "",
    joint: Annotated[str, typer.Option(help="Joint: q1 to q5, or slew, lift, tilt, ext, rot.")] = "",
    part: Annotated[str, typer.Option(help="Message, node, bus, process or position that the fault acts on.")] = "",
    size: Annotated[float | None, typer.Option(help="Size in the unit of --list (default: that of --list).")] = None,
    seed: Annotated[int, typer.Option(help="For what the fault draws, and for the job in lockstep.")] = 1,
    run: Annotated[
        Path | None, typer.Option(help="Directory of the live run (default: the newest below runs/).")
    ] = None,
    lockstep: Annotated[bool, typer.Option(help="Run the one-log job in virtual time with this fault.")] = False,
    profile: ProfileOption = "palms_471",
    truth: TruthOption = "nominal",
    i_know: Annotated[
        bool, typer.Option("--i-know", help="Send frames on a bus that may be that of a machine.")
    ] = False,
    list_all: Annotated[bool, typer.Option("--list", help="Show all faults and end.")] = False,
) -> None:
    """Inject a fault: into a live run, or into the job in lockstep.

    Faults have PX4's words: off, stuck, garbage, wrong, slow, delayed,
    intermittent. In lockstep the same seed gives the same bytes.

    [bold]Examples[/bold]

      timberhand inject --list

      timberhand inject encoder-lift stuck --at 12.3s --lockstep

      timberhand inject bus-babble --for 200ms     into the newest live run

      timberhand inject process-stuck --part planner --for 1s
    """
    from rich.console import Console

    from hil.faults.table import FOREVER_S, make

    if list_all or not name:
        _show(Console())
        return
    if joint:
        refuse_without_effect(context, ("part",), "with --joint")
    if lockstep:
        refuse_without_effect(context, ("run", "i_know"), "with --lockstep")
    else:
        refuse_without_effect(context, ("profile", "truth"), "without --lockstep")
    try:
        order = make(
            name,
            word,
            joint or part,
            _seconds(at),
            _seconds(length) if length else FOREVER_S,
            math.nan if size is None else size,
            seed,
        )
        if lockstep:
            _in_lockstep(profile, seed, truth_of(profile, truth), order)
            return
        from hil.faults.live import LiveTarget
        from hil.faults.live import inject as inject_live

        print(inject_live(order, LiveTarget.of(run or _newest_run()), i_know))
    except InputRefused as error:
        raise CommandFailed.from_error(error, ExitCode.USAGE) from None


def _in_lockstep(profile: str, seed: int, truth: str, order: object) -> None:
    from rich.console import Console

    from hil.demo.lockstep import run_lockstep
    from hil.faults.table import Order
    from timberhand.commands.runs import end, new_directory

    assert isinstance(order, Order)
    screen = Console()
    directory = new_directory(f"lockstep-{order.fault}-seed{seed}")
    summary = run_lockstep(profile, seed, truth, directory, 300.0, screen, orders=(order,))
    end(summary, screen, directory)


def _show(console: object) -> None:
    from rich.console import Console
    from rich.table import Table

    from hil.faults.table import FAULTS

    assert isinstance(console, Console)
    table = Table("fault", "component", "word", "what happens", "acts on", "size", "live", box=None)
    for fault, kind in FAULTS.items():
        on = f"{kind.part} ({kind.default_part})" if kind.part else ""
        size = f"{kind.size:g} {kind.unit}" if kind.unit else ""
        table.add_row(fault, kind.component, kind.word, kind.summary, on, size, "no" if kind.not_live else "yes")
    console.print(table)


def _seconds(text: str) -> float:

    number, factor = (text[:-2], 1e-3) if text.endswith("ms") else (text.removesuffix("s"), 1.0)
    try:
        return float(number) * factor
    except ValueError:
        raise InputRefused("fault.time-syntax", f"{text!r} is no time; write 12.3s or 500ms") from None


def _newest_run() -> Path:
    """Find the directory below runs/ with the newest live run."""
    from hil.harness.live import ADDRESSES

    address_files = sorted(Path("runs").glob(f"*/{ADDRESSES}"), key=lambda path: path.stat().st_mtime)
    if not address_files:
        raise InputRefused(
            "fault.no-live-run", "there is no live run below runs/; start `timberhand demo`, or add --lockstep"
        )
    return address_files[-1].parent
