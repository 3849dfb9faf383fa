"""Writes the generated reference pages, the README's table of results and the journal's catalog.

Commands, error codes and CAN frames change with every second commit and are not committed: `docs/conf.py` writes them
whenever the site is built.  The others are read in review.  With ``--check`` it only says which of those are stale.

Exit codes: 0 fine, 2 usage, 6 a page is stale (``--check``).
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Final

from host.exit_codes import ExitCode
from timberhand.reference import (
    cli_page,
    controller_pages,
    errors_page,
    frames_page,
    results_table,
)

REPOSITORY = Path(__file__).resolve().parents[2]


BUILT: Final[dict[str, Callable[[], str]]] = {
    "docs/reference/cli.md": cli_page.page,
    "docs/reference/errors.md": lambda: errors_page.page(REPOSITORY),
    "docs/reference/frames.md": frames_page.page,
}
"""Pages that are not committed."""


def committed(repository: Path = REPOSITORY) -> dict[Path, str]:
    """The text of every generated page that is committed, by its path."""
    made = {
        "docs/reference/faults.md": controller_pages.faults(),
        "docs/reference/transitions.md": controller_pages.transitions(),
        "deploy/system/timberhand.catalog": controller_pages.catalog(),
        "README.md": results_table.readme(repository),
    }
    return {repository / name: text for name, text in made.items()}


def stale(made: dict[Path, str]) -> list[Path]:
    """The pages whose text on disk is not this one."""
    return [path for path, text in made.items() if not path.is_file() or path.read_text() != text]


def write(made: dict[Path, str]) -> None:
    """Write the pages that are stale, and say which."""
    for path in stale(made):
        path.write_text(made[path])
        print(f"{path.relative_to(REPOSITORY)} written")


def write_built() -> None:
    """Write the pages that are not committed."""
    write({REPOSITORY / name: page() for name, page in BUILT.items()})


def main(arguments: list[str] | None = None) -> int:
    """Command line; returns the exit code."""
    parser = argparse.ArgumentParser(prog="python -m timberhand.reference", description="Generate the reference pages.")
    parser.add_argument("--check", action="store_true", help="write nothing; fail if a committed page is stale")
    options = parser.parse_args(arguments)
    if options.check:
        old = stale(committed())
        for path in old:
            print(f"{path.relative_to(REPOSITORY)} is stale; run `python -m timberhand.reference`.", file=sys.stderr)
        return ExitCode.FIGURE_MISSED if old else ExitCode.OK
    write(committed())
    write_built()
    return ExitCode.OK


if __name__ == "__main__":
    sys.exit(main())
