"""``timberhand console``: the operator's web page."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def console(
    port: Annotated[int, typer.Option(help="Port of the page.")] = 8471,
    report_port: Annotated[int, typer.Option(help="UDP port on which the controller's reports arrive.")] = 8472,
    profile: Annotated[str, typer.Option(help="A shipped profile or a TOML file.")] = "palms_471",
    controller: Annotated[
        str | None, typer.Option(metavar="HOST:PORT", help="Where commands go; without it the page only watches.")
    ] = None,
    planner: Annotated[
        str | None, typer.Option(metavar="HOST:PORT", help="Where the orders to a mission go: its --order-port.")
    ] = None,
    scene: Annotated[
        str | None, typer.Option(metavar="HOST:PORT", help="A detector to ask for the logs that lie there.")
    ] = None,
    bind: Annotated[str, typer.Option(help="Address to serve on; the default is this machine only.")] = "127.0.0.1",
    allow_host: Annotated[
        list[str] | None, typer.Option(help="A host name to serve besides this machine's own; may be repeated.")
    ] = None,
    key_file: Annotated[Path | None, typer.Option(help="File with the key of authenticated datagrams.")] = None,
    timing: Annotated[
        Path | None, typer.Option(metavar="FILE", help="The controller's timing page, to be shown too.")
    ] = None,
) -> None:
    """Serve the page that shows the crane and stops it; STOP is also on Space and Escape.

    [bold]Examples[/bold]

    timberhand console --report-port 8472 --controller 127.0.0.1:8470
    """
    from console.__main__ import Refused, serve
    from host.exit_codes import CommandFailed, ExitCode

    try:
        serve(
            port=port,
            report_port=report_port,
            profile=profile,
            controller=controller,
            planner=planner,
            scene=scene,
            bind=bind,
            allow_hosts=allow_host or (),
            key_file=key_file,
            timing=timing,
        )
    except Refused as refused:
        raise CommandFailed.from_error(refused, ExitCode(refused.code)) from refused
