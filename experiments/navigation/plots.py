"""Plots of the navigation experiment: Figs 13 to 15 of paper B, and ours."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from autonomy.navigation.clothoid_path import Point2
from experiments.navigation import measure
from experiments.navigation.measure import Drive
from experiments.navigation.metrics import CM, GROUNDS
from machine.profile import Carrier
from runtime.plot_style import MOSS, OIL, RUST, STEEL, TIMBER, limit_band, sheet

COLOURS: Final = (OIL, TIMBER, MOSS, RUST, STEEL, "#8a6fae")
SHOWN: Final = (0, 2, 4)
"""Starts in the plots with three."""
LIMIT_CM: Final = 8.0


def draw(outcomes: Mapping[str, Any], points: Sequence[Point2], carrier: Carrier, out: Path) -> None:
    """Write all plots of the first trial; those of one ground show the first ground driven."""
    grounds = [g for g in GROUNDS if any(name.split("/")[1:3] == [g, "0"] for name in outcomes)]
    drives = {
        (method, ground): [
            Drive(o) for name, o in outcomes.items() if name.split("/")[:3] == [method, ground, "0"] and o["rows"]
        ]
        for method in ("faithful", "ours")
        for ground in grounds
    }
    faithful, ours = drives["faithful", grounds[0]], drives["ours", grounds[0]]
    _paths(faithful, points, out / "paths.png")
    _headings(faithful, points, out / "heading.png")
    _all(faithful, ours, points, out / "all.png")
    _steering(faithful, ours, carrier, out / "steering.png")
    _lateral({g: drives["ours", g] for g in grounds}, points, carrier, out / "lateral.png")


def _some(drives: Sequence[Drive]) -> list[Drive]:
    return [drives[i] for i in SHOWN if i < len(drives)]


def _field(axis: Any, points: Sequence[Point2], title: str) -> None:
    axis.plot(*np.array(points).T, "D", color="black", ms=4, zorder=4)
    axis.set(title=title, xlabel="east [m]", ylabel="north [m]", aspect="equal", xlim=(-21, 21), ylim=(-18, 16))


def _path(axis: Any, drive: Drive, colour: str, width: float = 1.1) -> None:
    x, y = drive["x_m"], drive["y_m"]
    axis.plot(x, y, color=colour, lw=width)
    axis.plot(x[0], y[0], "s", color=colour, ms=6, zorder=5)
    axis.plot(x[-1], y[-1], "o", color=colour, ms=5, zorder=5)


def _paths(drives: Sequence[Drive], points: Sequence[Point2], path: Path) -> None:
    some = _some(drives)
    with sheet(path, max(1, len(some)), width=9.5, height=3.1) as axes:
        for i, (axis, drive) in enumerate(zip(np.atleast_1d(axes), some, strict=True)):
            _field(axis, points, f"start {i + 1}")
            _path(axis, drive, COLOURS[i])


def _headings(drives: Sequence[Drive], points: Sequence[Point2], path: Path) -> None:
    some = _some(drives)
    with sheet(path, max(1, len(some)), width=9.5, height=2.6) as axes:
        for i, (axis, drive) in enumerate(zip(np.atleast_1d(axes), some, strict=True)):
            error = np.degrees(measure.heading_error(drive, points))
            axis.plot(drive.distance_m, error, color=COLOURS[i], lw=1.0)
            axis.set(title=f"start {i + 1}", xlabel="distance [m]", ylim=(-100, 180), yticks=(-90, 0, 90, 180))
            if not i:
                axis.set_ylabel("bearing less heading [deg]")


def _all(faithful: Sequence[Drive], ours: Sequence[Drive], points: Sequence[Point2], path: Path) -> None:
    with sheet(path, 2, width=9.5, height=4.2) as axes:
        for axis, drives, title in zip(axes, (faithful, ours), ("paper B's law", "ours"), strict=True):
            _field(axis, points, title)
            for i, drive in enumerate(drives):
                _path(axis, drive, COLOURS[i % len(COLOURS)], 0.9)


def _steering(faithful: Sequence[Drive], ours: Sequence[Drive], carrier: Carrier, path: Path) -> None:
    limit = math.degrees(carrier.articulation_limit_rad)
    with sheet(path, 2, width=9.5, height=2.6) as axes:
        for axis, drives, title in zip(axes, (faithful, ours), ("paper B's law", "ours"), strict=True):
            if drives:
                axis.plot(
                    drives[0].distance_m, np.degrees(drives[0]["bend_rad"]), color=OIL, lw=1.0, label="articulation"
                )
                axis.plot(
                    drives[0].distance_m, np.degrees(drives[0]["wanted_rad"]), color=TIMBER, lw=0.7, label="wanted"
                )
            axis.set(title=title, xlabel="distance [m]", ylim=(-1.1 * limit, 1.1 * limit))
            for end in (-limit, limit):
                axis.axhline(end, color=RUST, lw=0.8, ls="--")
        axes[0].set_ylabel("articulation [deg]")
        axes[1].legend(fontsize=8, loc="lower right")


def _lateral(drives: Mapping[str, Sequence[Drive]], points: Sequence[Point2], carrier: Carrier, path: Path) -> None:
    with sheet(path, len(drives), width=9.5, height=2.8) as axes:
        for axis, (ground, ground_drives) in zip(np.atleast_1d(axes), drives.items(), strict=True):
            for i, drive in enumerate(ground_drives):
                planned_path = measure.planned(drive, points, carrier)
                distances_m, offsets_m = measure.lateral(drive, planned_path)
                after = distances_m > measure.corner_end_m(planned_path, points[0])
                begin = distances_m[int(np.argmax(after))]
                axis.plot(distances_m[after] - begin, CM * offsets_m[after], color=COLOURS[i % len(COLOURS)], lw=0.8)
            axis.set(title=GROUNDS[ground], xlabel="distance after the first bend [m]", ylim=(-12, 12))
            limit_band(axis, -LIMIT_CM, LIMIT_CM)
        np.atleast_1d(axes)[0].set_ylabel("off the path, + left [cm]")
