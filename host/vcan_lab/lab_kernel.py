"""The lab's own user-mode kernel, optional: ``make lab-kernel`` (deploy/lab_kernel) builds it into the user's cache."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Final

from host.vcan_lab.spec import PACKAGE_ROOT

CONFIG: Final = Path(PACKAGE_ROOT, "deploy/lab_kernel/lab.config")
MISSING: Final = "the lab kernel has not been built: make lab-kernel"


def find(cache: Path) -> str | None:
    """The newest kernel in the folder ``cache`` that was built from the present configuration; None without one."""
    try:
        recipe = hashlib.sha256(CONFIG.read_bytes()).hexdigest()[:12]
    except FileNotFoundError:  # an installation without the checkout
        return None
    built = sorted(cache.glob(f"linux-*-{recipe}"), key=lambda kernel: kernel.stat().st_mtime)
    return str(built[-1]) if built else None
