"""``timberhand console``: serve the operator's web page."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from timberhand.commands.options import ProfileOption


def console(
    port: Annotated[int, typer.Option(help="Port of the page.")] = 8471,
    report_port: Annotated[int, typer.Option(help="UDP port that receives the controller's state reports.")] = 8472,
    profile: ProfileOption = "palms_471",
    operator: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="The controller's socket for operators; without it the page is read-only."),
    ] = None,
    planner: Annotated[
        str | None, typer.Option(metavar="HOST:PORT", help="Operator command port of the planner (its --order-port).")
    ] = None,
    scene: Annotated[
        str | None, typer.Option(metavar="HOST:PORT", help="Log detector that lists the logs for the drawing.")
    ] = None,
    bind: Annotated[str, typer.Option(help="Address to serve on; by default this computer only.")] = "127.0.0.1",
    allow_host: Annotated[
        list[str] | None, typer.Option(help="Further host name to accept in requests; may be repeated.")
    ] = None,
    key_file: Annotated[Path | None, typer.Option(help="File with the key that authenticates datagrams.")] = None,
    timing: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Timing page of the controller, to be shown.")
    ] = None,
) -> None:
    """Serve the operator's page: it shows the machine and stops it.

    Space and Escape press STOP.

    [bold]Examples[/bold]

      timberhand console --report-port 8472 --operator /run/timberhand-operator/controller
    """
    from console.__main__ import StartError, serve
    from host.exit_codes import CommandFailed, ExitCode

    try:
        serve(
            port=port,
            report_port=report_port,
            profile=profile,
            operator=operator,
            planner=planner,
            scene=scene,
            bind=bind,
            allow_hosts=allow_host or (),
            key_file=key_file,
            timing=timing,
        )
    except StartError as error:
        raise CommandFailed.from_error(error, ExitCode(error.exit_code)) from error
