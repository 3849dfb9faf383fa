"""``timberhand bench motion``: planning time and duration of collision-free crane motions."""

from __future__ import annotations

from typing import Annotated

import typer

from timberhand.commands.options import JsonOption


def motion(
    seeds: Annotated[int, typer.Option(min=1, help="Scenes of each kind.")] = 6,
    profile: Annotated[
        list[str] | None, typer.Option(help="Machine profile; may be repeated (default: both shipped ones).")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Plan the motions of a crane cycle in simulated scenes; compare them with motions at full travel height.

    [bold]Examples[/bold]

      timberhand bench motion

      timberhand bench motion --profile aoro_fc8 --seeds 20 --json
    """
    import json

    from rich.console import Console
    from rich.progress import Progress, TaskID

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

                def progress(done: int, total: int, bar: Progress = bar, task: TaskID = task) -> None:
                    bar.update(task, completed=done, total=total)

                bench = run(machine, seeds, progress)
        except (ProfileError, ValueError) as trouble:
            raise CommandFailed.from_error(trouble, ExitCode.CONFIGURATION) from None
        found[name] = bench.metrics()
        if not as_json:
            m = bench.metrics()
            typer.echo(
                f"{name}: {m['motions']} motions, {m['blocked']} blocked, {m['no_grasp']} scenes without a grasp\n"
                f"  planned in {m['cpu_p50_ms']:.0f} ms of CPU (median), {m['cpu_p95_ms']:.0f} ms (95 %); "
                f"best of 4: {m['cpu_best_p50_ms']:.0f} and {m['cpu_best_p95_ms']:.0f} ms (goal: {GOAL_MS:.0f} ms)\n"
                f"  duration {m['ours_mean_s']:.2f} s (mean); at full travel height {m['travel_mean_s']:.2f} s, "
                f"with {m['travel_too_near']} clearance violations"
            )
            for sentence in bench.blocked[:5]:
                typer.echo(f"  {sentence}")
    if as_json:
        typer.echo(json.dumps(found, indent=2))
