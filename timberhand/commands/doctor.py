"""``timberhand doctor``: check this installation and the real-time readiness of this computer."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from timberhand.commands.options import JsonOption


def doctor(
    rt: Annotated[
        bool, typer.Option("--rt", help="Also check the computer's real-time settings and suggest changes.")
    ] = False,
    cpu: Annotated[
        int | None,
        typer.Option(min=0, metavar="N", help="Processor of the controller (default: from the settings)."),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Check this installation and, with --rt, this computer's real-time settings.

    Suggests changes, the most useful first. Exit code 3 only when something
    prevents every run.

    [bold]Examples[/bold]

      timberhand doctor

      timberhand doctor --rt --cpu 3
    """
    import shutil
    import subprocess

    from rich.console import Console

    from host.doctor import facts, installation, timing
    from host.doctor.finding import Severity
    from host.doctor.show import conclusion, show
    from host.exit_codes import ExitCode

    groups = {"installation": installation.examine()}
    if rt:
        links = "[]"
        if ip := shutil.which("ip", path="/usr/sbin:/sbin:/usr/bin:/bin"):
            answer = subprocess.run([ip, "-details", "-statistics", "-json", "link"], capture_output=True, text=True)
            links = answer.stdout or links
        groups["timing"] = timing.evaluate(facts.read(Path("/"), links, cpu))
    every = [finding for group in groups.values() for finding in group]
    if as_json:
        print(json.dumps({name: [f.document() for f in group] for name, group in groups.items()}, indent=2))
    else:
        console = Console(highlight=False)
        for name, group in groups.items():
            show(console, f"timberhand {name}", group)
        console.print(conclusion(every))
    raise typer.Exit(ExitCode.CONFIGURATION if any(f.severity is Severity.FAULT for f in every) else ExitCode.OK)
