"""``timberhand bench codec``: the compiled codecs compared with cantools, in one run, on the messages of crane.dbc."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from typing import Annotated, Any, Final

import typer

from host.exit_codes import ExitCode
from runtime.errors import InputRefused
from timberhand.commands.options import JsonOption

MIN_ENCODE_RATIO: Final = 5.0
MIN_DECODE_RATIO: Final = 2.0
CALLS_PER_SAMPLE: Final = 100


def codec(
    repetitions: Annotated[int, typer.Option(min=3, help="Interleaved repetitions; the median counts.")] = 31,
    as_json: JsonOption = False,
) -> None:
    """Measure encode and decode of every message of crane.dbc, with the compiled codec and cantools in turn.

    Both check ranges when they encode. Exit code 6 unless encoding is 5 times and
    decoding 2 times as fast as cantools.
    """

    result = measure(repetitions)
    if as_json:
        typer.echo(json.dumps(result, indent=2))
    else:
        _show(result)
    if not result["reached"]:
        raise typer.Exit(ExitCode.FIGURE_MISSED)


def measure(repetitions: int) -> dict[str, Any]:
    """Return medians of interleaved repetitions [ns per frame] per message, and the ratios of their sums."""
    import gc
    import platform
    import random
    from importlib.metadata import version

    from can_dbc.dbc.check import random_values
    from can_dbc.dbc.codec import FrameRefused, load, parse

    database = load("crane")
    reference = {m.name: m for m in parse(database.path).messages}
    rng = random.Random(1)
    rows: list[dict[str, Any]] = []
    gc.disable()
    try:
        for name, ours in database.messages.items():
            theirs = reference[name]
            while True:
                values = random_values(rng, ours, rng.randbytes(ours.length))
                try:
                    payload = ours.encode(*(values or ()))
                    ours.receive(payload)
                    # What ours saturates cantools refuses; both are to take the values as they arrive.
                    values = list(ours.decode(payload))
                    if None not in values:
                        break
                except (InputRefused, FrameRefused):
                    continue
            named = dict(zip(ours.index, values or (), strict=True))
            rows.append({"message": name} | _timed(ours, theirs, payload, values or [], named, repetitions))
    finally:
        gc.enable()
    totals = {key: sum(row[key] for row in rows) for key in rows[0] if key != "message"}
    ratios = {
        "encode": totals["cantools_encode_ns"] / totals["encode_ns"],
        "encode_unchecked": totals["cantools_encode_unchecked_ns"] / totals["encode_ns"],
        "decode": totals["cantools_decode_ns"] / totals["decode_ns"],
        "receive": totals["cantools_decode_ns"] / totals["receive_ns"],
    }
    return {
        "environment": {
            "python": platform.python_version(),
            "machine": f"{platform.system()} {platform.release()} {platform.machine()}",
            "cpus": os.cpu_count(),
            "cantools": version("cantools"),
            "bitstruct": version("bitstruct"),
        },
        "repetitions": repetitions,
        "needed": {"encode": MIN_ENCODE_RATIO, "decode": MIN_DECODE_RATIO},
        "ratios": ratios,
        "reached": ratios["encode"] >= MIN_ENCODE_RATIO and ratios["decode"] >= MIN_DECODE_RATIO,
        "messages": rows,
    }


def _timed(
    ours: Any, theirs: Any, payload: bytes, values: list[Any], named: dict[str, Any], repetitions: int
) -> dict[str, float]:
    from statistics import median
    from time import perf_counter_ns

    cases: dict[str, Callable[[], object]] = {
        "encode_ns": lambda: ours.encode(*values),
        "cantools_encode_ns": lambda: theirs.encode(named),
        "cantools_encode_unchecked_ns": lambda: theirs.encode(named, strict=False),
        "decode_ns": lambda: ours.decode(payload),
        "receive_ns": lambda: ours.receive(payload),
        "cantools_decode_ns": lambda: theirs.decode(payload, decode_choices=False),
    }
    samples: dict[str, list[float]] = {name: [] for name in cases}
    for _ in range(repetitions):
        for name, call in cases.items():
            start = perf_counter_ns()
            for _ in range(CALLS_PER_SAMPLE):
                call()
            samples[name].append((perf_counter_ns() - start) / CALLS_PER_SAMPLE)
    return {name: median(times) for name, times in samples.items()}


def _show(result: dict[str, Any]) -> None:
    from rich.console import Console
    from rich.table import Table

    console = Console(soft_wrap=True, highlight=False)
    console.print("  ".join(f"[dim]{name}[/dim] {value}" for name, value in result["environment"].items()))
    table = Table(box=None, header_style="bold", pad_edge=False)
    table.add_column("message")
    for column in ("encode µs", "cantools", "decode µs", "receive µs", "cantools"):
        table.add_column(column, justify="right")
    for row in result["messages"]:
        if row["message"].startswith("Heartbeat") and row["message"] != "HeartbeatSafe":
            continue
        columns = ("encode_ns", "cantools_encode_ns", "decode_ns", "receive_ns", "cantools_decode_ns")
        table.add_row(row["message"], *(f"{row[c] / 1000:.2f}" for c in columns))
    console.print(table)
    for name, needed in result["needed"].items():
        ratio = result["ratios"][name]
        mark = "[green]✔[/green]" if ratio >= needed else "[red]✘[/red]"
        console.print(f"{mark} {name} {ratio:.1f} times as fast as cantools (needed {needed:.0f})")
    console.print(
        f"  receive with range check {result['ratios']['receive']:.1f} times, "
        f"encode against cantools without its checks {result['ratios']['encode_unchecked']:.1f} times"
    )
