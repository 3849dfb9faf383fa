"""``timberhand bench plant``: how fast the plant runs, with the host it ran on."""

from __future__ import annotations

from typing import Annotated

import typer


def plant(
    profile: Annotated[str, typer.Option(help="A shipped profile or a TOML file.")] = "palms_471",
    truth: Annotated[str, typer.Option(help="The plant's hidden truth: nominal, sampled, or a TOML file.")] = "nominal",
    quick: Annotated[bool, typer.Option(help="A few stretches only.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON document on stdout.")] = False,
) -> None:
    """Real-time factors of the crane with 12 logs and of a whole forwarder mission, camera time, cost per log.

    Exit code 6 when a factor is not reached on a quiet host; on a noisy one the figure is called inconclusive.
    """
    import json

    from rich.console import Console
    from rich.table import Table

    from experiments.common.result import environment, judge
    from experiments.plant.bench import LOG_COUNTS, METRICS, measure
    from host.exit_codes import ExitCode

    screen = Console(stderr=as_json, highlight=False, soft_wrap=True)
    metrics, noisy, _ = measure(profile, truth, quick, screen)
    missed, inconclusive = judge(METRICS, metrics, noisy)
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
