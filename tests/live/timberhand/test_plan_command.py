"""``timberhand plan``: what it says of good and of bad files, its JSON, its exit codes, its pictures."""

from __future__ import annotations

import subprocess
import sys


def test_help_loads_nothing_heavy() -> None:
    heavy = ("numpy", "pymap3d", "matplotlib", "msgspec")
    code = f"import sys, timberhand.cli; print([m for m in {heavy} if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
