"""The unit files and the settings that they read."""

from __future__ import annotations

import re
from pathlib import Path

DEPLOY = Path(__file__).parents[2] / "deploy"
UNITS = sorted((DEPLOY / "units").glob("*.service"))
CONF = dict(
    line.split("=", 1)
    for line in (DEPLOY / "timberhand.conf").read_text().splitlines()
    if not line.startswith("#") and line
)
EXPOSURE = {
    "controller": 1.3,
    "guard": 1.0,
    "autonomy": 1.0,
    "recorder": 1.1,
    "console": 1.1,
    "plc": 1.4,
    "can@": 1.1,
    "update": 1.2,
    "perception": 1.5,
}
"""Exposure of each unit by systemd-analyze, of 10; at most 1.5."""


def short(unit: Path) -> str:
    """The name without what all names have."""
    return unit.stem.removeprefix("timberhand-")


def setting(unit: Path, name: str) -> list[str]:
    """Every value of a setting."""
    return re.findall(rf"^{name}=(.*)$", unit.read_text(), re.MULTILINE)
