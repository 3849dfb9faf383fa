"""Writes the generated reference pages, the README's table of results and the journal's catalog.

With ``--check`` it only says which are stale.

Exit codes: 0 fine, 2 usage, 6 a page is stale (``--check``).
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from host.exit_codes import ExitCode
from timberhand.reference import (
    cli_page,
    errors_page,
    faults_page,
    frames_page,
    journal_catalog,
    results_table,
    transitions_page,
)

REPOSITORY = Path(__file__).resolve().parents[2]


def pages(repository: Path = REPOSITORY) -> dict[Path, str]:
    """The text of every generated page by its path."""
    made = {
        "cli": cli_page.page(),
        "errors": errors_page.page(repository),
        "faults": faults_page.page(),
        "frames": frames_page.page(),
        "transitions": transitions_page.page(),
    }
    reference = {repository / "docs" / "reference" / f"{name}.md": text for name, text in made.items()}
    catalog = repository / "deploy" / "system" / "timberhand.catalog"
    return reference | {repository / "README.md": results_table.readme(repository), catalog: journal_catalog.page()}


def stale(repository: Path = REPOSITORY) -> list[Path]:
    """The pages whose text on disk is not what the code says now."""
    made = pages(repository)
    return [path for path, text in made.items() if not path.is_file() or path.read_text() != text]


def main(arguments: list[str] | None = None) -> int:
    """Command line; returns the exit code."""
    parser = argparse.ArgumentParser(prog="python -m timberhand.reference", description="Generate the reference pages.")
    parser.add_argument("--check", action="store_true", help="write nothing; fail if a page is stale")
    options = parser.parse_args(arguments)
    if options.check:
        old = stale()
        for path in old:
            print(f"{path.relative_to(REPOSITORY)} is stale; run `python -m timberhand.reference`.", file=sys.stderr)
        return ExitCode.FIGURE_MISSED if old else ExitCode.OK
    for path, text in pages().items():
        path.write_text(text)
        print(f"{path.relative_to(REPOSITORY)} written")
    return ExitCode.OK


if __name__ == "__main__":
    sys.exit(main())
