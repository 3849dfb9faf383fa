"""Plots of the log-localization experiment."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np

from autonomy.perception.fitting.cylinder import CylinderBatch, outline_distance, pixel_rays
from autonomy.perception.log_detector import Perception
from autonomy.perception.papers import position_in_box
from experiments.log_localization.metrics import CM, DEGREES, PAPER_M, VIEWS
from experiments.log_localization.site import STOP_M, Site
from experiments.log_localization.trial import RANGES_M, Segmenter, detected
from hil.plant.picture import depth_colors
from machine.profile import Profile
from runtime.plot_style import OIL, RUST, STEEL, TIMBER, sheet

BIN_CM, MAX_SHOWN_CM = 2.0, 80.0
MARGIN_PX: Final = 70
MIN_ROWS: Final = 190


def draw(outcomes: Mapping[str, Any], out: Path) -> None:
    """Write histograms and curves into ``out``."""
    _histograms(outcomes, out / "errors.png")
    _curves(outcomes, out / "curve.png")


def _histograms(outcomes: Mapping[str, Any], path: Path) -> None:
    with sheet(path, 3, width=9.0, height=2.8) as axes:
        for axis, degrees in zip(axes, DEGREES, strict=True):
            rows = [r for n, o in outcomes.items() if n.startswith(f"approach/{degrees}/") for r in o["logs"]]
            bins = np.arange(0.0, MAX_SHOWN_CM + BIN_CM, BIN_CM)
            for key, colour, label in (("faithful_error_m", TIMBER, "paper B's pipeline"), ("error_m", OIL, "ours")):
                values = [CM * r[key] for r in rows if not math.isnan(r[key])]
                alpha = 1.0 if key == "error_m" else 0.5
                axis.hist(np.minimum(values, MAX_SHOWN_CM), bins=bins, color=colour, alpha=alpha, label=label)
            axis.axvline(CM * PAPER_M[degrees], color=RUST, lw=1.0, ls="--", label="paper B reports")
            axis.set(
                title=f"{degrees}°: {VIEWS[degrees]}", xlabel="error [cm]", xlim=(0.0, MAX_SHOWN_CM), ylabel="logs"
            )
        axes[0].legend(fontsize=8)


def _curves(outcomes: Mapping[str, Any], path: Path) -> None:
    trials: dict[float, list[dict[str, Any]]] = {}
    for name, outcome in outcomes.items():
        if name.startswith("curve/"):
            trials.setdefault(float(name.split("/")[1]), []).append(outcome)
    if not trials:
        return
    angles = sorted(trials)
    near = RANGES_M.index(5.0)
    with sheet(path, 2, width=9.0, height=3.2) as (left, right):
        for key, colour, label in (("faithful", TIMBER, "paper B's pipeline"), ("ours", OIL, "ours")):
            over_angle = [[t[key][near] for t in trials[a]] for a in angles]
            over_range = [[t[key][i] for a in angles for t in trials[a]] for i in range(len(RANGES_M))]
            for axis, x, groups in ((left, angles, over_angle), (right, RANGES_M, over_range)):
                low, middle, high = (
                    [CM * float(np.nanpercentile(g, p)) if np.isfinite(g).any() else math.nan for g in groups]
                    for p in (10, 50, 90)
                )
                axis.fill_between(x, low, high, color=colour, alpha=0.2, lw=0)
                axis.plot(x, middle, color=colour, label=label, marker="o", ms=3)
        left.set(title="5 m away", xlabel="angle to the view [°]", ylabel="error of one frame [cm]", ylim=(0.0, None))
        right.set(title="All angles", xlabel="range [m]", ylabel="error of one frame [cm]", ylim=(0.0, None))
        left.legend()


def overlay(profile: Profile, truth: str, seed: int, segment: Segmenter, path: Path) -> None:
    """Draw the estimates of both pipelines on colour and depth of one frame at each angle."""
    with sheet(path, 3, width=9.0, height=6.0) as axes:
        for axis, degrees in zip(axes, DEGREES, strict=True):
            site = Site(profile, truth, seed, degrees)
            try:
                shot = site.shot(-STOP_M)
                frame = site.frame(shot, 0)
            finally:
                site.close()
            instances = segment(frame, shot)
            fits = Perception(profile).fits(frame, instances)
            v, u = np.nonzero(shot.picture.mask == 1)
            half = max(MIN_ROWS, int(max(np.ptp(u), np.ptp(v)))) // 2 + MARGIN_PX // 2
            top, left = max(0, int(v.mean()) - half), max(0, int(u.mean()) - half)
            window = (slice(top, top + 2 * half), slice(left, left + 2 * half))
            colours, depth = frame.rgb[window], depth_colors(frame.depth_m[window])
            axis.imshow(np.concatenate([colours, depth], axis=0), interpolation="nearest")
            rows, columns = colours.shape[:2]
            vv, uu = np.mgrid[top : top + rows, left : left + columns]
            rays = pixel_rays(frame.intrinsics, uu.ravel(), vv.ravel())
            for fit in fits:
                gap = outline_distance(CylinderBatch.of(fit.body), rays)[0].reshape(rows, columns)
                ends = frame.intrinsics.project(
                    fit.body.center_m + np.outer((-0.5, 0.5), fit.body.length_m * fit.body.axis)
                ) - (left, top)
                for shift in (0, rows):
                    axis.contour(np.arange(columns), np.arange(rows) + shift, gap, levels=[0.0], colors=[RUST])
                    axis.plot(ends[:, 0], ends[:, 1] + shift, color=RUST, lw=0.8, ls=":")
            for one in instances:
                point = position_in_box(frame, detected(frame, one.mask))
                if point is not None:
                    x, y = frame.intrinsics.project(point[None])[0] - (left, top)
                    if not (0 <= x < columns and 0 <= y < rows):
                        continue
                    axis.plot([x, x], [y, y + rows], color=OIL, marker="+", ms=9, ls="none", mew=1.8)
            axis.set_title(f"{degrees}°: {VIEWS[degrees]}", color=STEEL)
            axis.set(xlim=(0, columns), ylim=(2 * rows, 0), xticks=[], yticks=[])
            axis.grid(False)
