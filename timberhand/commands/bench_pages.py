"""``timberhand bench pages``: what a tick does without and with open pages of the console."""

from __future__ import annotations

from typing import Annotated, Any, Final

import typer

from timberhand.commands.options import JsonOption

COUNTS: Final = {
    "calls": "system calls of a tick",
    "frames": "frames sent by a tick",
    "instructions": "instructions of a tick",
}


def pages(
    rounds: Annotated[int, typer.Option(min=1, help="Rounds of both sides; fewer than 6 decide no time.")] = 7,
    seconds: Annotated[float, typer.Option(min=1.0, help="Length of a window; each has two.")] = 4.0,
    number: Annotated[int, typer.Option("--pages", min=1, max=32, help="Open pages of the other side.")] = 10,
    as_json: JsonOption = False,
) -> None:
    """Count what a tick does while no page and while ten pages are open, in turn, in one run.

    Controller, guard, emulated machine and console run as processes on the
    wire. System calls, frames and, where the host counts them, instructions of
    a tick are counts, which no other load changes; with pages they must be the
    same to 2 %. Processor time is the median ratio over the rounds with its
    95 % interval; "inconclusive" when the interval holds the limit, as on a
    loud host. Exit code 6 when a count differs or the ratio is missed.

    [bold]Examples[/bold]

      timberhand bench pages

      timberhand bench pages --rounds 9 --pages 20 --json
    """
    import json
    import sys
    import tempfile
    from pathlib import Path

    from experiments.common import host_activity
    from experiments.common.result import environment
    from experiments.timing import open_pages
    from host.exit_codes import ExitCode

    def progress(text: str) -> None:
        print(f"bench: {text}", file=sys.stderr, flush=True)

    with tempfile.TemporaryDirectory() as folder:
        found = open_pages.judge(open_pages.measure(rounds, seconds, number, Path(folder), progress))
    where = environment() | host_activity.describe()
    if as_json:
        print(json.dumps({"environment": where, "pages": number, **found}, indent=2))
    else:
        print("  ".join(f"{name} {value}" for name, value in where.items()))
        _show(found, number)
    if not found["reached"]:
        raise typer.Exit(ExitCode.FIGURE_MISSED)


def _show(found: dict[str, Any], number: int) -> None:
    print(f"{'':28}{'no page':>12}{f'{number} pages':>12}")
    for name, words in COUNTS.items():
        told = found["counts"][name]
        if told["same"] is None:
            print(f"{words:28}{'not counted here':>24}")
        else:
            print(f"{words:28}{told['none']:12g}{told['open']:12g}   {'the same' if told['same'] else 'differs'}")
    cpu = found["cpu"]
    few = cpu["high"] is None
    interval = "fewer than 6 rounds give no interval" if few else f"{cpu['low']:.2f} to {cpu['high']:.2f}"
    print(
        f"{'processor time of a tick, us':28}{cpu['none']:12g}{cpu['open']:12g}   "
        f"ratio {cpu['ratio']:.2f} ({interval}), at least {cpu['at_least']}: {cpu['verdict']}"
    )
    print(
        f"{'ticks missed':28}{found['missed']['none']:12}{found['missed']['open']:12}   "
        f"of {found['ticks']['none']} and {found['ticks']['open']}"
    )
    print(f"the pages got {found['states']} states meanwhile")
