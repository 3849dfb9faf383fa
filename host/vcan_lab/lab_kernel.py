"""The optional user-mode kernel of the lab; ``make lab-kernel`` (deploy/lab_kernel) builds it into the user's cache."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Final

from host.vcan_lab.spec import PACKAGE_ROOT

CONFIG: Final = Path(PACKAGE_ROOT, "deploy/lab_kernel/lab.config")
MISSING: Final = "the lab kernel is not built: make lab-kernel"


def find(cache: Path) -> str | None:
    """The newest kernel in the folder ``cache`` built from the present configuration; None when there is none."""
    try:
        digest = hashlib.sha256(CONFIG.read_bytes()).hexdigest()[:12]
    except FileNotFoundError:  # an installation without the checkout
        return None
    built = sorted(cache.glob(f"linux-*-{digest}"), key=lambda kernel: kernel.stat().st_mtime)
    return str(built[-1]) if built else None
