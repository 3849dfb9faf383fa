"""``python -m host.service_lab``: test the services under a real systemd; the result as JSON on stdout.

Exit status: 0 every check passed, 2 usage, 4 no lab, 6 a check failed.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

from host.exit_codes import ExitCode
from host.service_lab.host import PARTS, run
from host.vcan_lab.spec import LabError


def main() -> int:
    """Run the command; return its exit status."""
    parser = argparse.ArgumentParser(prog="python -m host.service_lab", description=__doc__.split("\n")[0])
    parser.add_argument("--wheel", type=Path, help="wheel to install (default: built from this checkout)")
    parser.add_argument(
        "--timeout", type=float, default=1500.0, metavar="S", help="time limit of each part (default 1500)"
    )
    parser.add_argument("--only", choices=PARTS, help="this part alone")
    parser.add_argument("--quiet", action="store_true", help="do not print the steps on stderr")
    options = parser.parse_args()
    try:
        result = run(
            options.wheel,
            options.timeout,
            lambda line: None if options.quiet else print(line, file=sys.stderr),
            [options.only] if options.only else PARTS,
        )
    except LabError as error:
        print(f"service lab: {error} [{error.code}]", file=sys.stderr)
        return ExitCode.BUS
    print(json.dumps(result, indent=2))
    return ExitCode.FIGURE_MISSED if result["failed"] else ExitCode.OK


if __name__ == "__main__":
    sys.exit(main())
