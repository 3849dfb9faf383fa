"""``timberhand plan learn`` and ``demonstrate``: crane motions learned from demonstrations (paper B 3.2.5)."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from host.exit_codes import CommandFailed, ExitCode
from timberhand.commands.options import ProfileOption, TruthOption, truth_of


def learn(
    recording: Annotated[
        Path,
        typer.Argument(
            metavar="RECORDING", help="Directory of a run, run.mcap, CAN recording, or demonstrations (.csv)."
        ),
    ],
    out: Annotated[Path, typer.Option("--out", metavar="FILE", help="Movement primitives to write (JSON).")],
    profile: Annotated[str | None, typer.Option(help="Machine profile (default: the recorded one).")] = None,
    plot: Annotated[
        Path | None, typer.Option(metavar="PNG", help="Plot of the demonstrated and learned motions.")
    ] = None,
    csv: Annotated[Path | None, typer.Option(metavar="FILE", help="Also write the demonstrations (CSV).")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON document on stdout.")] = False,
) -> None:
    """Learn the motions between bunk and log from a recording of manual operation.

    The encoder frames on the bus suffice. Record several motions, each from rest
    to rest, out to logs and back.

    [bold]Examples[/bold]

      timberhand plan learn runs/by-hand --out forwarder.json --plot learned.png

      timberhand plan learn crane0.log --profile aoro_fc8 --out forwarder.json
    """
    import json

    from autonomy.motion.movement_primitives import encode, learn_primitives
    from runtime.errors import InputRefused
    from training.motion.demonstration_recordings import motions_in

    machine, motions = motions_in(recording, profile)
    try:
        primitives = learn_primitives(machine, motions)
    except InputRefused as error:
        raise CommandFailed("plan.demonstrations", f"{recording}: {error}", ExitCode.CONFIGURATION) from None
    _write(out, encode(primitives))
    if csv is not None:
        from autonomy.motion.demonstration import format_demonstrations

        _write(csv, format_demonstrations(machine.name, motions).encode())
    if plot is not None:
        from training.motion.primitives_plot import plot_primitives

        plot_primitives(plot, machine, motions, primitives)
    facts = {
        "profile": machine.name,
        "motions": len(motions),
        "out": primitives.out.demonstrations,
        "back": primitives.back.demonstrations,
        "out_s": round(primitives.out.duration_s, 2),
        "back_s": round(primitives.back.duration_s, 2),
    }
    if as_json:
        typer.echo(json.dumps(facts))
        return
    typer.echo(
        f"{out}: learned from {facts['out']} motions out and {facts['back']} back of {len(motions)} of {machine.name}, "
        f"{primitives.out.duration_s:.1f} s and {primitives.back.duration_s:.1f} s"
    )


def demonstrate(
    out: Annotated[Path, typer.Argument(metavar="OUT", help="Demonstrations to write (.csv).")],
    profile: ProfileOption = "aoro_fc8",
    seed: Annotated[int, typer.Option(help="Chooses the targets and the tremor of the hand.")] = 1,
    targets: Annotated[int, typer.Option(min=1, max=40, help="Number of targets, each out and back.")] = 6,
    truth: TruthOption = "nominal",
    record: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Also record the run into DIR, for `plan learn DIR`.")
    ] = None,
) -> None:
    """Let an emulated operator move the plant's crane with its hand levers, and write the motions.

    [bold]Examples[/bold]

      timberhand plan demonstrate demonstrations.csv

      timberhand plan demonstrate shown.csv --targets 2 --record runs/by-hand
    """
    from rich.console import Console
    from rich.progress import Progress

    from autonomy.motion.demonstration import format_demonstrations, joint_track, segment_motions
    from can_dbc.dbc.codec import load
    from hil.demonstrations import demonstrate as demonstrate_motions
    from machine.loading.profile_file import ProfileError, load_profile
    from recorder.manifest import describe
    from recorder.recorder import Recorder
    from runtime.errors import InputRefused

    error_console = Console(stderr=True)
    try:
        machine = load_profile(profile)
        buses = tuple(name for name in (machine.crane_bus, machine.machine_bus) if name)
        recorder = Recorder(record, machine, describe(machine, buses, seed)) if record is not None else None
        with Progress(console=error_console, transient=True, disable=not error_console.is_terminal) as bar:
            task = bar.add_task("motions", total=None)
            frames = demonstrate_motions(
                profile,
                seed,
                targets,
                truth_of(profile, truth),
                recorder,
                lambda done, total: bar.update(task, completed=done, total=total),
            )
        if recorder is not None:
            recorder.close()
    except (ProfileError, ValueError, InputRefused) as error:
        raise CommandFailed.from_error(error, ExitCode.CONFIGURATION) from None
    motions = segment_motions(machine, joint_track(machine, load("crane"), frames))
    _write(out, format_demonstrations(machine.name, motions).encode())
    typer.echo(f"{out}: {len(motions)} motions of {machine.name}")


def _write(path: Path, data: bytes) -> None:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data)
    except OSError as error:
        raise CommandFailed(
            "plan.output-not-written",
            f"{path} cannot be written ({error.strerror}); choose another file",
            ExitCode.CONFIGURATION,
        ) from None
