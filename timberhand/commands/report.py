"""``timberhand report``: the overview page of all experiments, from their saved results."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def report(
    docs: Annotated[Path, typer.Option(help="Folder that holds results/ and gets figures.md.")] = Path("docs"),
) -> None:
    """Write figures.md: the results of every experiment beside the limits and the papers' figures.

    An experiment with --docs does this itself; use this command for results from
    elsewhere. Measures nothing.

    [bold]Examples[/bold]

      timberhand report

      timberhand report --docs /srv/timberhand/docs
    """
    from experiments.common import overview
    from host.exit_codes import CommandFailed, ExitCode

    try:
        found = overview.results_in(docs)
        if not found:
            raise CommandFailed(
                "report.no-results",
                f"{docs / 'results'} holds no results of experiments; name the folder with --docs",
                ExitCode.CONFIGURATION,
            )
        print(f"{overview.write(docs)}: {len(found)} experiments")
    except (OSError, ValueError) as error:
        raise CommandFailed(
            "report.results-unusable", f"the results in {docs} cannot be used: {error}", ExitCode.CONFIGURATION
        ) from None
