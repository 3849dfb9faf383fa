"""``timberhand report``: the page of all experiments at a glance, from their saved results."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def report(
    docs: Annotated[Path, typer.Option(help="The folder with results/, where figures.md is written.")] = Path("docs"),
) -> None:
    """Write figures.md: what every experiment asks, what it reached and missed, beside the papers' figures.

    An experiment that is run with --docs does so by itself; this is for results that came from elsewhere.  Measures
    nothing.

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
                f"{docs / 'results'} holds no result of an experiment; name it by --docs",
                ExitCode.CONFIGURATION,
            )
        print(f"{overview.write(docs)}: {len(found)} experiments")
    except (OSError, ValueError) as error:
        raise CommandFailed(
            "report.results-unusable", f"the results in {docs} cannot be used: {error}", ExitCode.CONFIGURATION
        ) from None
