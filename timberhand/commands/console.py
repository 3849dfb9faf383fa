"""``timberhand console``: serve the operator's web page."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Final

import typer

from host.exit_codes import CommandFailed, ExitCode
from timberhand.commands.options import ProfileOption, refuse_without_effect

DEFAULT_PROFILE: Final = "palms_471"


def console(
    context: typer.Context,
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port of the page.")] = 8471,
    report_port: Annotated[
        int, typer.Option(min=0, max=65535, help="UDP port that receives the controller's state reports.")
    ] = 8472,
    profile: ProfileOption = DEFAULT_PROFILE,
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
    missions: Annotated[
        Path, typer.Option(metavar="DIR", help="Folder of the missions that are planned on the page.")
    ] = Path("missions"),
    bus: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME=ADDRESS", help="Bus whose frames the page may show; may be repeated."),
    ] = None,
    foxglove: Annotated[
        int | None,
        typer.Option(
            min=0,
            max=65535,
            metavar="PORT",
            help="Port that serves the run to Foxglove and Lichtblick, read-only.",
        ),
    ] = None,
    controller: Annotated[
        str | None,
        typer.Option(metavar="HOST:PORT", help="The controller's setpoint port, for the page of commissioning."),
    ] = None,
    commission: Annotated[
        Path, typer.Option(metavar="DIR", help="Folder of calibrated profiles and acceptance protocols.")
    ] = Path("commissioning"),
    passwords: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Accounts of the page's users, from `timberhand operator password`."),
    ] = None,
    tls_cert: Annotated[Path | None, typer.Option(metavar="FILE", help="Certificate of the page, PEM.")] = None,
    tls_key: Annotated[Path | None, typer.Option(metavar="FILE", help="Its key, PEM.")] = None,
    audit: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Log to which every command of the page is appended.")
    ] = None,
    replay: Annotated[
        Path | None, typer.Option(metavar="RUN", help="Show this recorded run, its run.mcap or a stop file instead.")
    ] = None,
) -> None:
    """Serve the operator's page: it shows the machine and stops it.

    Space and Escape press STOP. With --replay it shows a recorded run instead,
    in which nothing can be commanded and Space plays and pauses. Missions are
    planned on its page /plan, which needs neither a controller nor a network.
    Other machines reach it only with --passwords, --tls-cert, --tls-key and
    --audit.

    [bold]Examples[/bold]

      timberhand console --report-port 8472 --operator /run/timberhand-operator/controller

      timberhand console --profile aoro_fc8 --missions missions

      timberhand console --replay runs/demo-1
    """
    from console.__main__ import serve
    from console.exposure import Exposure, StartError

    if replay is not None:
        from timberhand.replay_page import show_recording

        read = {"replay", "profile", "port", "bind", "allow_host"}
        refuse_without_effect(context, context.params.keys() - read, "with --replay")
        show_recording(
            replay, None if profile == DEFAULT_PROFILE else profile, port, bind=bind, allow_hosts=allow_host or ()
        )
        return
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
            missions=missions,
            buses=bus or (),
            foxglove=foxglove,
            exposure=Exposure(passwords, tls_cert, tls_key, audit),
            controller=controller,
            commission=commission,
        )
    except StartError as error:
        raise CommandFailed.from_error(error, ExitCode(error.exit_code)) from error
