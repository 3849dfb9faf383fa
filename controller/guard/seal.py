"""Seals an envelope file after a person has checked it: ``python -m controller.guard.seal FILE``.

Writes its last line, the digest that the guard verifies at its start.  Exit codes: 0 sealed, 3 no such file.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from controller.guard.envelope import SEAL, digest


def main(arguments: list[str] | None = None) -> int:
    """Seal a file; returns the exit code."""
    parser = argparse.ArgumentParser(prog="python -m controller.guard.seal", description="Seals a guard's envelope.")
    parser.add_argument("file", type=Path, help="envelope file, checked by a person")
    path: Path = parser.parse_args(arguments).file
    try:
        text = path.read_bytes()
        body = text.partition(SEAL)[0]
        path.write_bytes(body + SEAL + digest(body) + b"\n")
    except OSError as error:
        sys.stderr.write(f"seal: {path}: {error.strerror}.\n")
        return 3
    return 0


if __name__ == "__main__":
    sys.exit(main())
