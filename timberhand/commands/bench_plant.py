"""``timberhand bench plant``: real-time factor of the plant on this host."""

from __future__ import annotations

from typing import Annotated

import typer

from timberhand.commands.options import JsonOption, ProfileOption, TruthOption, truth_of


def plant(
    profile: ProfileOption = "palms_471",
    truth: TruthOption = "nominal",
    quick: Annotated[bool, typer.Option(help="Fewer repetitions.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Measure the real-time factors of a crane with 12 logs and of a whole mission, camera time and cost per log.

    Exit code 6 when a factor is missed on a quiet host; on a noisy host the
    figure is reported as inconclusive.
    """
    import json

    from rich.console import Console
    from rich.table import Table

    from experiments.common.result import environment, evaluate
    from experiments.plant.bench import LOG_COUNTS, METRICS, measure
    from host.exit_codes import ExitCode

    screen = Console(stderr=as_json, highlight=False, soft_wrap=True)
    metrics, noisy, _ = measure(profile, truth_of(profile, truth), quick, screen)
    missed, inconclusive = evaluate(METRICS, metrics, noisy)
    if as_json:
        verdict = {"missed": missed, "inconclusive": inconclusive, "noisy": noisy}
        typer.echo(json.dumps({"environment": environment(), "metrics": metrics, **verdict}, indent=2))
    else:
        screen.print("  ".join(f"[dim]{name}[/dim] {value}" for name, value in environment().items()))
        for f in METRICS:
            word = "inconclusive" if f.name in inconclusive else "missed" if f.name in missed else "reached"
            ratio = metrics[f.name.replace("_ms", "") + "_per_reference"]
            screen.print(f"{f.title}: [bold]{f.text(metrics[f.name])}[/bold] ({f.limit_text()}: {word})")
            screen.print(f"  [dim]{ratio:.2f} times the fixed work measured beside it[/dim]")
        table = Table(box=None, header_style="bold", pad_edge=False)
        for count in LOG_COUNTS:
            table.add_column(f"{count} logs", justify="right")
        table.add_row(*(f"{metrics[f'step_ms_{count}_logs']:.3f} ms" for count in LOG_COUNTS))
        screen.print("physics step of 2.5 ms with logs on the ground")
        screen.print(table)
        screen.print(
            f"[dim]host: {100 * metrics['host_stolen']:.0f} % of the time taken away, fixed work unequal by "
            f"{100 * metrics['host_unequal']:.0f} %{': noisy' if noisy else ''}[/dim]"
        )
    if missed:
        raise typer.Exit(ExitCode.FIGURE_MISSED)
