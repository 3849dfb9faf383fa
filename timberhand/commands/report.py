"""``timberhand report``: writes the result pages again from the saved results."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def report(
    docs: Annotated[Path, typer.Option(help="Folder that holds results/ and the pages.")] = Path("docs"),
) -> None:
    """Write the page of every experiment and the overview results.md from the saved results.

    Measures nothing: numbers, plots and commits stay as they are. An experiment
    with --docs writes its page itself; use this command for results from
    elsewhere, and after a change of the text of a page.

    [bold]Examples[/bold]

      timberhand report

      timberhand report --docs /srv/timberhand/docs
    """
    from experiments.common import overview, pages
    from experiments.loop_design import page as loop_design
    from host.exit_codes import CommandFailed, ExitCode

    try:
        found = overview.results_in(docs)
        if not found:
            raise CommandFailed(
                "report.no-results",
                f"{docs / 'results'} holds no results of experiments; name the folder with --docs",
                ExitCode.CONFIGURATION,
            )
        written = pages.rewrite(docs)
        if (docs / "results" / "loop-design.json").exists() and (docs / "loop-design.md").exists():
            written = [loop_design.rewrite(docs), *written]
        print("\n".join(map(str, written)))
        print(f"{len(found)} experiments")
    except (OSError, ValueError) as error:
        raise CommandFailed(
            "report.results-unusable", f"the results in {docs} cannot be used: {error}", ExitCode.CONFIGURATION
        ) from None
