"""``timberhand bench motion``: clear ways, how long they take to plan and to drive."""

from __future__ import annotations

from typing import Annotated

import typer


def motion(
    seeds: Annotated[int, typer.Option(min=1, help="So many scenes of every kind.")] = 6,
    profile: Annotated[list[str] | None, typer.Option(help="A profile; may be repeated. Default: both.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON document on stdout.")] = False,
) -> None:
    """Plan the motions of a cycle in the simulator's scenes: CPU time, duration beside always going at full height.

    [bold]Examples[/bold]

      timberhand bench motion

      timberhand bench motion --profile aoro_fc8 --seeds 20 --json
    """
    import json

    from rich.console import Console
    from rich.progress import Progress

    from experiments.benches.motion import GOAL_MS, run
    from host.exit_codes import CommandFailed, ExitCode
    from machine.loading.profile_file import ProfileError, load_profile

    error = Console(stderr=True)
    found = {}
    for name in profile or ["palms_471", "aoro_fc8"]:
        try:
            machine = load_profile(name)
            with Progress(console=error, transient=True, disable=not error.is_terminal) as bar:
                task = bar.add_task(name, total=None)
                bench = run(machine, seeds, lambda done, total, t=task: bar.update(t, completed=done, total=total))
        except (ProfileError, ValueError) as trouble:
            raise CommandFailed.from_error(trouble, ExitCode.CONFIGURATION) from None
        found[name] = bench.metrics()
        if not as_json:
            m = bench.metrics()
            typer.echo(
                f"{name}: {m['motions']} motions, {m['blocked']} blocked, {m['no_grasp']} scenes without a grasp\n"
                f"  planned in {m['cpu_p50_ms']:.0f} ms of CPU (median), {m['cpu_p95_ms']:.0f} ms (95 %); "
                f"best of 4: {m['cpu_best_p50_ms']:.0f} and {m['cpu_best_p95_ms']:.0f} ms (goal: {GOAL_MS:.0f})\n"
                f"  driven in {m['ours_mean_s']:.2f} s (mean), always at full height in {m['travel_mean_s']:.2f} s, "
                f"which comes too near {m['travel_too_near']} times"
            )
            for sentence in bench.blocked[:5]:
                typer.echo(f"  {sentence}")
    if as_json:
        typer.echo(json.dumps(found, indent=2))
