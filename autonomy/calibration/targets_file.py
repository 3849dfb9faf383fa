"""Targets of a camera survey as a CSV file: their positions, and their pixels and depths in the camera's image."""

from __future__ import annotations

import csv
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from runtime.errors import InputRefused

COLUMNS: Final = ("u_px", "v_px", "x_m", "y_m", "z_m")
DEPTH_COLUMN: Final = "depth_m"


@dataclass(frozen=True, slots=True)
class SurveyTargets:
    """Pixels (N, 2), depths (N,) [m], NaN where unknown, and positions in the crane's base frame (N, 3) [m]."""

    pixels_px: np.ndarray
    depths_m: np.ndarray
    places_m: np.ndarray


def load_targets(path: Path) -> SurveyTargets:
    """Load the targets of a file with the columns ``COLUMNS`` and, where the camera measures depth, ``DEPTH_COLUMN``.

    Raises:
        InputRefused: the file cannot be read, a column is missing or a value is not a finite number.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise InputRefused("targets.unreadable", f"{path}: cannot be read as text: {error}") from None
    rows = csv.DictReader(text.splitlines(), skipinitialspace=True)
    names = [(name or "").strip() for name in rows.fieldnames or ()]
    missing = [name for name in COLUMNS if name not in names]
    if missing:
        raise InputRefused(
            "targets.column-missing",
            f"{path}:1: column {missing[0]} is missing; the first line is {','.join((*COLUMNS, DEPTH_COLUMN))}",
        )
    rows.fieldnames = names
    values, depths = [], []
    for row in rows:
        where = f"{path}:{rows.line_num}"
        values.append([_number(row[name], name, where) for name in COLUMNS])
        depth = (row.get(DEPTH_COLUMN) or "").strip()
        depths.append(_number(depth, DEPTH_COLUMN, where) if depth else math.nan)
    table = np.array(values, float).reshape(-1, len(COLUMNS))
    return SurveyTargets(table[:, :2], np.array(depths), table[:, 2:])


def _number(text: str | None, name: str, where: str) -> float:
    try:
        value = float(text or "")
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise InputRefused(
            "targets.not-a-number", f"{where}: {name} is {text!r}, not a number; write decimals with a point"
        )
    return value
