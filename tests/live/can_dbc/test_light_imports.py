"""Imports at run time: cantools only inside ``load``."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import can_dbc

MODULES = ["dbc.codec", "protocols.e2e", "protocols.canopen", "protocols.nmea2000", "trace.candump"]


def test_codecs_do_not_import_cantools_after_start() -> None:
    """The E2E, CANopen and NMEA 2000 modules and the codec import cantools only inside ``load``."""
    program = (
        f"import sys, {', '.join(f'can_dbc.{name}' for name in MODULES)}\n"
        "print([m for m in ('cantools', 'can', 'canopen', 'numpy') if m in sys.modules])"
    )
    shown = subprocess.run(
        [sys.executable, "-c", program],
        capture_output=True,
        text=True,
        check=True,
        cwd=Path(can_dbc.__file__).parents[1],
    )
    assert shown.stdout.strip() == "[]"
