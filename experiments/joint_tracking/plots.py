"""Plots of the joint-tracking experiment."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import product
from pathlib import Path
from typing import Any, Final

from experiments.joint_tracking.metrics import KILO, LAWS, MM, PERCENT, REST_M, SHUT
from experiments.joint_tracking.trial import DIVERGED_M
from runtime.plot_style import MOSS, OIL, RUST, STEEL, TIMBER, limit_band, sheet

COLOURS: Final = dict(zip(LAWS, (OIL, STEEL, TIMBER, "black", MOSS, RUST), strict=True))
SHADES: Final = (("calibrated", -0.19, 1.0), ("shipped", 0.19, 0.45))
PANELS: Final = (
    ("rest_m", "rests [mm]", MM, None, REST_M),
    ("tip_rms_m", "on the way, rms [mm]", MM, None, None),
    ("settle_s", "settled within 15 mm [s]", 1.0, None, None),
    ("shut_share", "valves shut [%]", PERCENT, SHUT, None),
    ("chatter_pct_s", "chatter [%/s]", 1.0, None, None),
    ("ripple_bar", "pressure ripple [bar]", 1.0, None, None),
    ("energy_j", "energy [kJ]", KILO, None, None),
)


def draw(metrics: Mapping[str, float], outcomes: Mapping[str, Any], machines: Mapping[str, str], out: Path) -> None:
    """Write all plots into ``out``."""
    traces = {name.split("/")[1]: outcome["trace"] for name, outcome in outcomes.items() if "trace" in outcome}
    for short in machines:
        _compare(metrics, short, out / f"{short}.png")
    _traces({law: traces[law] for law in LAWS if law in traces}, out / "traces.png")
    _stops(traces.get("stop", {}), out / "stop.png")
    _wide(outcomes, machines, out / "wide.png")


def _stops(curves: Mapping[str, Any], path: Path) -> None:
    with sheet(path, 2, width=9.0) as axes:
        for axis, (name, title) in zip(axes, (("lift", "boom, up and down"), ("slew", "slew, across")), strict=True):
            for how, colour, label in (("plain", STEEL, "without"), ("damped", OIL, "with")):
                if curve := curves.get(f"{name}_loaded_{how}"):
                    axis.plot(curve[0], [MM * x for x in curve[1]], color=colour, label=label)
            axis.set_xlim(-0.5, 3.5)
            axis.set_title(f"{title} [mm]")
            axis.set_xlabel("time after the stop [s]")
            axis.legend()


def _wide(outcomes: Mapping[str, Any], machines: Mapping[str, str], path: Path) -> None:
    with sheet(path, len(machines), width=4.5 * len(machines)) as axes:
        for axis, short in zip(axes, machines, strict=True):
            for (i, law), (state, shift, shade) in product(enumerate(LAWS), SHADES):
                own = [f"{short}/{law}/{state}/{kind}/" for kind in ("wide", "corner")]
                wobbles_m = [o["wobble_m"] for name, o in outcomes.items() if name.startswith(tuple(own))]
                axis.scatter(
                    [i + shift] * len(wobbles_m), [MM * x for x in wobbles_m], s=14, color=COLOURS[law], alpha=shade
                )
            axis.set_yscale("log")
            axis.set_xticks(range(len(LAWS)), list(LAWS.values()))
            axis.set_title(f"{machines[short]}: wobble of the tip [mm]")
            axis.axhline(MM * DIVERGED_M, color=RUST, lw=0.8, ls="--")


def _compare(metrics: Mapping[str, float], short: str, path: Path) -> None:
    with sheet(path, len(PANELS), width=1.95 * len(PANELS)) as axes:
        for axis, (key, title, scale, least, most) in zip(axes, PANELS, strict=True):
            for i, law in enumerate(LAWS):
                for state, shift, shade in SHADES:
                    value = metrics.get(f"{short}_{law}_{state}_cycle_{key}", float("nan"))
                    axis.bar(i + shift, scale * value, 0.36, color=COLOURS[law], alpha=shade)
            axis.set_xticks(range(len(LAWS)), [name.replace(" ", "\n").replace("-", "-\n") for name in LAWS.values()])
            axis.tick_params(axis="x", labelsize=6)
            axis.set_title(title)
            if key in ("rest_m", "tip_rms_m", "settle_s"):
                axis.set_yscale("log")
            limit_band(axis, None if least is None else scale * least, None if most is None else scale * most)


def _traces(traces: Mapping[str, Any], path: Path) -> None:
    with sheet(path, 2, width=9.0) as (error, spool):
        for law, trace in traces.items():
            error.plot(trace["time_s"], [MM * e for e in trace["error_m"]], color=COLOURS[law], label=LAWS[law])
            spool.plot(trace["time_s"], trace["spool_pct"], color=COLOURS[law], lw=0.8)
        error.axhline(MM * REST_M, color=RUST, lw=0.8, ls="--")
        error.set_yscale("log")
        error.set_title("error of the tip [mm]")
        error.legend(fontsize=7)
        spool.set_title("slew spool [%]")
        for axis in (error, spool):
            axis.set_xlabel("time [s]")
