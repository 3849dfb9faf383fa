"""``timberhand bench pool``: what a trial costs beside its own work."""

from __future__ import annotations

import json
from dataclasses import asdict

from timberhand.commands.options import JsonOption


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
