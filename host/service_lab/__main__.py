"""``python -m host.service_lab``: the services under a real systemd; the result as JSON on stdout.

Exit status: 0 every check passed (or could not be judged: see ``inconclusive``), 2 usage, 4 no lab, 6 a check failed.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

from host.exit_codes import ExitCode
from host.service_lab.host import run
from host.vcan_lab.spec import LabError


def _say(line: str) -> None:
    print(line, file=sys.stderr)


def _nothing(_line: str) -> None:
    pass


def main() -> int:
    """The command."""
    parser = argparse.ArgumentParser(prog="python -m host.service_lab", description=__doc__.split("\n")[0])
    parser.add_argument("--wheel", type=Path, help="what is installed (default: built from this checkout)")
    parser.add_argument("--timeout", type=float, default=600.0, metavar="S", help="for everything (default 600)")
    parser.add_argument("--quiet", action="store_true", help="no steps on stderr")
    options = parser.parse_args()
    try:
        result = run(
            options.wheel, options.timeout, lambda line: None if options.quiet else print(line, file=sys.stderr)
        )
    except LabError as reason:
        print(f"service lab: {reason}", file=sys.stderr)
        return ExitCode.BUS
    print(json.dumps(result, indent=2))
    return ExitCode.FIGURE_MISSED if result["failed"] else ExitCode.OK


if __name__ == "__main__":
    sys.exit(main())
