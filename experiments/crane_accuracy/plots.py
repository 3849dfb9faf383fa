"""Plots of the crane-accuracy experiment."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np

from experiments.crane_accuracy.metrics import MM, PAPER
from experiments.crane_accuracy.plan import GOALS_M, OWN, UNCOMPENSATED, UNSHAPED
from machine.geometry.kinematics import pin_position
from machine.profile import Kinematics
from runtime.plot_style import MOSS, OIL, RUST, STEEL, TIMBER, sheet

COLOURS: Final = {"slew": OIL, "lift": TIMBER, "tilt": MOSS, "ext": STEEL}
BIN_MM: Final = 1.0
LONGEST_MM: Final = 100.0


def draw(outcomes: Mapping[str, Any], kinematics: Kinematics, out: Path) -> None:
    """Write all plots into ``out``; without motions the axes stay empty."""
    own, bare = (_motions(outcomes, variant) for variant in (OWN, UNCOMPENSATED))
    _histogram(own, out / "histogram.png")
    _points([("encoder_m", own, OIL)], _from_above, ("x [mm]", "y [mm]"), out / "points.png")
    clouds = [("true_m", bare, TIMBER), ("true_m", own, OIL)]
    _points(clouds, _from_beside, ("outward [mm]", "up [mm]"), out / "true_points.png")
    _motion({v: _traced(outcomes, v) for v in (OWN, UNSHAPED, UNCOMPENSATED)}, kinematics, out / "motion.png")


def _motions(outcomes: Mapping[str, Any], variant: str) -> list[dict[str, Any]]:
    return [m for name, o in outcomes.items() if name.endswith(f"/{variant}") for m in o["motions"] if not m["failed"]]


def _traced(outcomes: Mapping[str, Any], variant: str) -> dict[str, Any] | None:
    traces = (o["trace"] for name, o in outcomes.items() if name.endswith(f"/{variant}") and "trace" in o)
    return next(traces, None)


def _histogram(own: list[dict[str, Any]], path: Path) -> None:
    error = MM * np.array([m["encoder_m"] for m in own]).reshape(-1, 3)
    kinds = (
        ("3-D [mm]", np.linalg.norm(error, axis=1), "encoder_error_mean_m"),
        ("horizontal [mm]", np.hypot(error[:, 0], error[:, 1]), "encoder_error_xy_mean_m"),
        ("height [mm]", np.abs(error[:, 2]), "encoder_error_z_mean_m"),
    )
    with sheet(path, 3, width=9.0, height=2.8) as axes:
        for axis, (title, values, name) in zip(axes, kinds, strict=True):
            axis.hist(np.minimum(values, LONGEST_MM), bins=np.arange(0.0, LONGEST_MM + BIN_MM, BIN_MM), color=OIL)
            axis.axvline(MM * PAPER[name], color=RUST, lw=1.0, ls="--")
            if len(values):
                axis.axvline(values.mean(), color=TIMBER, lw=1.2)
                axis.annotate(
                    f"mean {values.mean():.1f}",
                    (values.mean(), 0.82),
                    xycoords=("data", "axes fraction"),
                    xytext=(4, 0),
                    textcoords="offset points",
                    color=TIMBER,
                )
            axis.annotate(
                f"paper B {MM * PAPER[name]:.0f}",
                (MM * PAPER[name], 0.94),
                xycoords=("data", "axes fraction"),
                xytext=(-4, 0),
                textcoords="offset points",
                ha="right",
                color=RUST,
            )
            axis.set(title=title, xlim=(0.0, LONGEST_MM), ylabel="motions")


def _from_above(error_m: np.ndarray, goal: int) -> np.ndarray:
    return error_m[:, :2]


def _from_beside(error_m: np.ndarray, goal: int) -> np.ndarray:
    outward = np.array(GOALS_M[goal][:2]) / np.hypot(*GOALS_M[goal][:2])
    return np.column_stack([error_m[:, :2] @ outward, error_m[:, 2]])


def _points(
    clouds: list[tuple[str, list[dict[str, Any]], str]],
    view: Callable[[np.ndarray, int], np.ndarray],
    labels: tuple[str, str],
    path: Path,
) -> None:
    with sheet(path, len(GOALS_M), width=11.0, height=3.1) as axes:
        spans = [MM * np.abs(view(np.array([m[key]]), m["goal"])).max() for key, cloud, _ in clouds for m in cloud]
        span = 1.1 * max(spans, default=10.0)
        for goal, axis in enumerate(axes):
            for key, cloud, colour in clouds:
                for loaded, marker in ((False, "s"), (True, "x")):
                    points = [m[key] for m in cloud if m["goal"] == goal and (m["load_kg"] > 0.0) == loaded]
                    x, y = MM * view(np.array(points).reshape(-1, 3), goal).T
                    face = {"markerfacecolor": "none"} if marker == "s" else {}
                    axis.plot(x, y, marker, ms=3.5, mew=0.7, ls="", color=colour, **face)
            x, y, _ = GOALS_M[goal]
            axis.plot([0.0], [0.0], "+", color=RUST, ms=9)
            axis.set(title=f"{goal + 1}: ({x:g}, {y:g}) m", xlim=(-span, span), ylim=(-span, span), aspect="equal")
            axis.set_xlabel(labels[0])
        axes[0].set_ylabel(labels[1])


def _motion(traces: Mapping[str, dict[str, Any] | None], kinematics: Kinematics, path: Path) -> None:
    with sheet(path, 4, width=13.0, height=3.1) as (pin_path, error, spools, lean):
        own = traces[OWN]
        if own is not None:
            time = np.array(own["time_s"])
            true, encoder = np.array(own["true_m"]), np.array(own["encoder_m"])
            reference = np.array([pin_position(kinematics, q) for q in own["reference"]])
            for points, colour, label in ((true, OIL, "true"), (encoder, STEEL, "encoders")):
                pin_path.plot(np.hypot(points[:, 0], points[:, 1]), points[:, 2], color=colour, label=label)
            x, y, z = own["goal_m"]
            pin_path.plot([np.hypot(x, y)], [z], "+", color=RUST, ms=10, label="goal")
            error.plot(
                time, MM * np.linalg.norm(encoder - reference, axis=1), color=STEEL, label="encoders, to reference"
            )
            error.plot(time, MM * np.linalg.norm(true - own["goal_m"], axis=1), color=OIL, label="true, to goal")
            for name, curve in own["spools"].items():
                spools.plot(curve["time_s"], curve["percent"], color=COLOURS[name], lw=0.9, label=name)
        bare = traces[UNCOMPENSATED]
        if bare is not None:
            off = MM * np.linalg.norm(np.array(bare["true_m"]) - bare["goal_m"], axis=1)
            error.plot(bare["time_s"], off, color=TIMBER, lw=0.9, label="the same without sag")
        for variant, colour, label in ((UNSHAPED, TIMBER, "unshaped"), (OWN, OIL, "shaped")):
            curves = traces[variant]
            if curves is not None:
                lean.plot(curves["time_s"], curves["lean_deg"], color=colour, label=label)
        pin_path.set(title="pin", xlabel="from slew axis [m]", ylabel="height [m]", aspect="equal")
        error.set(title="errors of the pin [mm]", yscale="log", ylim=(1.0, None))
        spools.set(title="valve commands [%]")
        lean.set(title="lean of the grapple [deg]")
        for axis in (error, spools, lean):
            axis.set_xlabel("time [s]")
        for axis in (pin_path, error, spools, lean):
            axis.legend(fontsize=7)
