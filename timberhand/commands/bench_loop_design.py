"""``timberhand bench loop-design``: stability margins of every loop over the whole spread of machines."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from timberhand.commands.options import JsonOption


def loop_design(
    profile: Annotated[
        list[str] | None, typer.Option(help="Machine profile; may be repeated (default: both shipped ones).")
    ] = None,
    truth: Annotated[
        str, typer.Option(help="Ground truth of the plant and its spread: nominal or a TOML file.")
    ] = "nominal",
    out: Annotated[Path | None, typer.Option(help="Folder for plots (default: none).")] = None,
    docs: Annotated[
        Path | None, typer.Option(help="Folder of the page loop-design.md, written again with plots.")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Compute phase margin, gain margin and bandwidth of every control loop, for the worst machine.

    Linear models of every joint and of the carrier with their control laws, over
    near, working and far reach, empty and loaded, and the whole spread of dead
    times and gains; of the heading loop slow and fast, near a waypoint and far
    from it. Exit code 6 when a phase margin is below 40 deg or a gain margin
    below 6 dB.

    [bold]Examples[/bold]

      timberhand bench loop-design

      timberhand bench loop-design --profile my.toml --out runs/loops

      timberhand bench loop-design --docs docs
    """
    import json

    from rich.console import Console
    from rich.table import Table

    from experiments.loop_design import carrier
    from experiments.loop_design.study import MIN_GAIN_DB, MIN_PHASE_DEG, case_set, study
    from host.exit_codes import CommandFailed, ExitCode
    from machine.loading.profile_file import ProfileError, load_profile

    screen = Console(stderr=as_json, highlight=False, soft_wrap=True)
    documents: dict[str, Any] = {}
    machines = []
    holds = True
    for source in profile or ["palms_471", "aoro_fc8"]:
        try:
            machine = load_profile(source)
            with screen.status(f"{machine.name}: margins over all machines"):
                work = case_set(source, truth)
                studies = study(machine, work) + carrier.studies(machine, work)
        except (ProfileError, ValueError) as error:
            raise CommandFailed.from_error(error, ExitCode.CONFIGURATION) from None
        table = Table(box=None, header_style="bold", pad_edge=False, title=machine.title, title_justify="left")
        for column in ("joint", "law", "kp 1/s", "phase deg", "gain dB", "bandwidth Hz", "worst machine"):
            table.add_column(column, justify="left" if column in ("joint", "law", "worst machine") else "right")
        for joint in studies:
            mark = "[green]✔[/green]" if joint.holds else "[red]✘[/red]"
            law = joint.spec.law
            table.add_row(
                f"{mark} {joint.name}",
                law.kind,
                f"{law.kp_1_s:g}",
                f"{joint.phase_deg:.0f}",
                f"{joint.gain_db:.1f}",
                f"{joint.bandwidth_hz:.2f}",
                str(joint.worst),
            )
            holds = holds and joint.holds
        screen.print(table)
        machines.append((machine, studies, work))
        documents[machine.name] = {joint.name: joint.document() for joint in studies}
        if out is not None:
            from experiments.loop_design.page import draw

            for file in draw(machine.name, studies, out):
                screen.print(f"[dim]{file}[/dim]")
    if docs is not None:
        from experiments.loop_design.page import write

        with screen.status("every law"):
            holds = write(machines, docs) and holds
        screen.print(f"[dim]{docs / 'loop-design.md'}[/dim]")
    needed = {"phase_deg": MIN_PHASE_DEG, "gain_db": MIN_GAIN_DB}
    if as_json:
        typer.echo(json.dumps({"needed": needed, "reached": holds, "machines": documents}, indent=2))
    else:
        screen.print(f"needed everywhere: {MIN_PHASE_DEG:.0f} deg and {MIN_GAIN_DB:.0f} dB")
    if not holds:
        raise typer.Exit(ExitCode.FIGURE_MISSED)
