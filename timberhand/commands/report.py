"""``timberhand report``: writes the result pages again from the saved results."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from host.exit_codes import CommandFailed, ExitCode

if TYPE_CHECKING:
    from experiments.common.result import Result


def report(
    docs: Annotated[Path, typer.Option(help="Folder that holds results/ and the pages.")] = Path("docs"),
    check: Annotated[
        bool, typer.Option("--check", help="Write nothing; fail when a result is stale or cannot be verified.")
    ] = False,
) -> None:
    """Write the page of every experiment and the overview results.md from the saved results.

    Measures nothing: numbers, plots and commits stay as they are. An experiment
    with --docs writes its page itself; use this command for results from
    elsewhere, and after a change of the text of a page. A page says when the
    sources of its result have changed since, or its commit is not in the history.

    [bold]Examples[/bold]

      timberhand report

      timberhand report --check       exit code 6 when a result is not of the present sources

      timberhand report --docs /srv/timberhand/docs
    """
    from experiments.common import overview, result_page
    from experiments.loop_design import page as loop_design

    try:
        results = overview.results_in(docs)
        if not results:
            raise CommandFailed(
                "report.no-results", f"{docs / 'results'} holds no results of experiments; name the folder with --docs"
            )
        if check:
            _check(results)
            return
        written = result_page.rewrite(docs)
        if (docs / "results" / "loop-design.json").exists() and (docs / "loop-design.md").exists():
            written = [loop_design.rewrite(docs), *written]
        print("\n".join(map(str, written)))
        print(f"{len(results)} experiments")
    except (OSError, ValueError) as error:
        raise CommandFailed("report.results-unusable", f"the results in {docs} cannot be used: {error}") from None


def _check(results: dict[str, Result]) -> None:
    """Print every result that is not current, and why."""
    from experiments.common.registry import EXPERIMENTS
    from experiments.common.standing import Standing, judge

    old = []
    for name, result in results.items():
        verdict = judge(result.commit, EXPERIMENTS[name])
        if verdict.standing is Standing.CURRENT:
            continue
        old.append(name)
        files = verdict.changed
        file_list = f" ({len(files)} files: {', '.join(files[:3])}{', ...' if len(files) > 3 else ''})" if files else ""
        print(f"{name}: {verdict.standing}. {verdict.why}{file_list}")
    if old:
        raise CommandFailed(
            "report.stale",
            f"{len(old)} of {len(results)} results are not of the present sources; repeat them with "
            "timberhand experiment NAME --docs docs",
            ExitCode.FIGURE_MISSED,
        )
    print(f"all {len(results)} results are of the present sources")
