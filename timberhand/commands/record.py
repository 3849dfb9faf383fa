"""``timberhand record``: run the recorder in the foreground."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from host.exit_codes import CommandFailed, ExitCode
from runtime.errors import LinkError
from timberhand.commands.options import ProfileOption


def record(
    out: Annotated[Path, typer.Option(help="Directory of the recording; it must not hold one already.")],
    bus: Annotated[
        list[str] | None,
        typer.Option(help="NAME=ADDRESS of a bus; may be repeated (default: the buses of the profile)."),
    ] = None,
    report_port: Annotated[int, typer.Option(help="UDP port of the controller's state reports.")] = 8474,
    profile: ProfileOption = "palms_471",
    ticks: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Ring of the controller's tick records in shared memory.")
    ] = None,
    timing: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Timing page of the controller, recorded once per second.")
    ] = None,
) -> None:
    """Record the buses, the controller's ticks and its reports until Ctrl-C.

    [bold]Examples[/bold]

      timberhand record --out runs/field-1

      timberhand record --out runs/field-1 --bus crane0=socketcan:can0
    """
    from can_dbc.bus.factory import default_address
    from machine.loading.profile_file import load_profile
    from recorder.__main__ import main

    try:
        machine = load_profile(profile)
        names = [name for name in (machine.crane_bus, machine.machine_bus) if name]
        buses = bus or [f"{name}={default_address(name)}" for name in names]
    except LinkError as error:
        raise CommandFailed.from_error(error, ExitCode.BUS) from error
    arguments = ["--out", str(out), "--report-port", str(report_port), *(("--ticks", str(ticks)) if ticks else ())]
    arguments += ["--timing", str(timing)] if timing else []
    code = main([*arguments, "--profile", profile, *(x for b in buses for x in ("--bus", b))])
    raise typer.Exit(code)
