"""Plots of the plant experiment, one function per plot."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from experiments.plant.runs import SAMPLE_S, WARM_CYCLES
from runtime.plot_style import MOSS, OIL, RUST, STEEL, TIMBER, limit_band, sheet
from sim.world import STEP_S

Metrics = dict[str, float]
RATES: Final = (
    ("single_success", "single log\nlifted", 0.98, True),
    ("pile3_success", "three-log pile\nlifted whole", 0.98, True),
    ("unload_success", "laid into\nthe bunk", 0.98, True),
    ("yaw90_lifted", "90 deg off:\nlifted", 0.02, False),
    ("off1m_lifted", "1 m off:\nlifted", 0.02, False),
)


def draw(metrics: Metrics, traces: dict[str, Any], out: Path) -> None:
    """Write every plot into ``out``."""
    _grasps(metrics, out / "grasps.png")
    _grasp_quality(traces["good"], out / "grasp-quality.png")
    _sag(traces["sag"], out / "sag.png")
    _boom_stop(metrics, traces["boom_stop"], out / "boom-stop.png")
    _sharing(traces["sharing"], out / "sharing.png")
    _slew_stop(metrics, traces["slew_stop"], out / "slew-stop.png")
    _pendulum(metrics, traces["pendulum"], out / "pendulum.png")
    _cylinder(metrics, traces["cylinder"], out / "cylinder.png")
    _turning(traces["turning"], out / "turning.png")
    _braking(traces["braking"], out / "braking.png")
    _energy(traces["kinetic_j"], traces["falling_j"], out / "energy.png")
    _endurance(traces["endurance"], out / "endurance.png")
    _cost(traces["step_ms"], out / "cost.png")


def _time(values: Sequence[float] | np.ndarray, step_s: float = SAMPLE_S) -> np.ndarray:
    return np.arange(len(values)) * step_s


def _labels(axis: Any, title: str, x: str, y: str = "", *, legend: bool = False) -> None:
    axis.set_title(title)
    axis.set_xlabel(x)
    axis.set_ylabel(y)
    if legend:
        axis.legend()


def _grasps(m: Metrics, path: Path) -> None:
    with sheet(path, 2) as axes:
        for axis, rates in zip(axes, (RATES[:3], RATES[3:]), strict=True):
            above = rates[0][3]
            for i, (name, _, limit, _) in enumerate(rates):
                value, low, high = (100.0 * m[n] for n in (name, f"{name}_low", f"{name}_high"))
                colour = MOSS if (value >= 100.0 * limit if above else value <= 100.0 * limit) else RUST
                axis.plot([i, i], [low, high], color=colour, lw=3, solid_capstyle="round")
                axis.plot(i, value, "o", color=colour, ms=7)
                axis.text(i + 0.08, value, f"{value:.1f} %", va="center")
            axis.set_xticks(range(len(rates)), [label for _, label, _, _ in rates])
            axis.set_xlim(-0.5, len(rates) - 0.3)
            worst = (min if above else max)(100.0 * m[f"{name}_{'low' if above else 'high'}"] for name, *_ in rates)
            axis.set_ylim(*((min(96.0, worst - 1.0), 100.4) if above else (-0.4, max(4.0, worst + 1.0))))
            limit_band(axis, 98.0 if above else None, None if above else 2.0)
            axis.set_ylabel("share of trials [%]")
        axes[0].set_title(f"Well aimed, {m['single_success_n']:.0f} trials each")
        axes[1].set_title("Badly aimed")


def _grasp_quality(good: list[list[float]], path: Path) -> None:
    with sheet(path, 3, 9.0) as (left, middle, right):
        rows = np.array(good) if good else np.zeros((0, 4))
        left.hist(1e3 * rows[:, 0], bins=np.linspace(0, 6, 25), color=OIL)
        left.axvline(5.0, color=RUST, ls="--", lw=0.8)
        _labels(left, "Penetration", "deepest penetration of a jaw [mm]", "good grasps")
        middle.hist(rows[:, 1], bins=np.linspace(0, 4, 25), color=TIMBER)
        middle.axvline(3.0, color=RUST, ls="--", lw=0.8)
        _labels(middle, "Log speed", "highest speed of a log [m/s]")
        right.plot(rows[:, 2], rows[:, 3], "o", ms=3, color=MOSS)
        top = max(10.0, *rows[:, 2:].max(axis=0)) if len(rows) else 10.0
        right.plot([0, top], [0, top], color=STEEL, lw=0.8)
        _labels(right, "Load cell", "true load [kg]", "load cell [kg]")


def _sag(rows: list[dict[str, float]], path: Path) -> None:
    load = [r["load_kg"] for r in rows]
    with sheet(path, 2) as (left, right):
        left.plot(load, [1e3 * r["sag_m"] for r in rows], "o-", label="sag of the true tip")
        left.plot(load, [1e3 * r["encoder_drop_m"] for r in rows], "s-", label="drop shown by encoders")
        left.plot([250, 250], [80, 120], color=RUST, lw=5, alpha=0.3, solid_capstyle="butt", label="80 to 120 mm")
        _labels(left, "Structure", "load on the hook at 6 m [kg]", "[mm]", legend=True)
        right.plot(load, [1e-6 * r["pressure_pa"] for r in rows], "o-", color=MOSS)
        _labels(right, "Oil", "load [kg]", "lift cylinder, chamber A [MPa]")


def _boom_stop(m: Metrics, stops: dict[str, list[float]], path: Path) -> None:
    with sheet(path) as axis:
        for name, colour in (("empty", OIL), ("250kg", TIMBER)):
            heights = np.array(stops[name])
            label = f"{name}: {m[f'ring_hz_{name}']:.2f} Hz, zeta {m[f'ring_zeta_{name}']:.3f}"
            axis.plot(_time(heights), 1e3 * (heights - heights[-len(heights) // 4 :].mean()), color=colour, label=label)
        axis.axvline(1.5, color=STEEL, lw=0.8, ls="--")
        axis.set_ylim(-350, 250)
        _labels(axis, "A boom stop rings", "time [s]", "true tip height from rest [mm]", legend=True)


def _sharing(sharing: dict[str, dict[str, float]], path: Path) -> None:
    names = list(sharing["alone"])
    units = {"ext": "m/s"}
    with sheet(path) as axis:
        for i, name in enumerate(names):
            alone, together = (abs(sharing[k][name]) for k in ("alone", "together"))
            axis.bar(i - 0.18, alone, 0.34, color=STEEL, label="alone" if i == 0 else None)
            axis.bar(i + 0.18, together, 0.34, color=OIL, label="all four together" if i == 0 else None)
            axis.text(i + 0.18, together, f"{100 * together / alone:.0f} %", ha="center", va="bottom")
        axis.set_xticks(range(len(names)), [f"{n} [{units.get(n, 'rad/s')}]" for n in names])
        _labels(axis, "One pump for all functions", "", "speed at full spool", legend=True)


def _slew_stop(m: Metrics, angles_rad: list[float], path: Path) -> None:
    with sheet(path) as axis:
        axis.plot(_time(angles_rad), np.degrees(angles_rad), label=f"fork hinge: {m['slew_pendulum_hz']:.3f} Hz")
        axis.axvspan(0, 1.5, color=TIMBER, alpha=0.12, lw=0, label="slewing")
        _labels(axis, "A grasped log swings after a slew stop", "time [s]", "[deg]", legend=True)


def _pendulum(m: Metrics, swings: dict[str, list[float]], path: Path) -> None:
    with sheet(path, 2) as axes:
        for axis, (name, angles_rad) in zip(axes, swings.items(), strict=True):
            axis.plot(_time(angles_rad), np.degrees(angles_rad))
            _labels(
                axis, f"{name} hinge, {m[f'{name}_period_s']:.3f} s, zeta {m[f'{name}_zeta']:.3f}", "time [s]", "[deg]"
            )


def _cylinder(m: Metrics, angles_rad: list[float], path: Path) -> None:
    with sheet(path) as axis:
        axis.plot(_time(angles_rad, STEP_S), 1e3 * np.array(angles_rad))
        _labels(axis, f"Oil spring of the lift cylinder, {m['cylinder_hz']:.2f} Hz", "time [s]", "joint [mrad]")


def _turning(turns: list[dict[str, Any]], path: Path) -> None:
    with sheet(path, 1, 5.0, 4.6) as axis:
        for turn, colour in zip(turns, (OIL, TIMBER), strict=True):
            label = f"{math.degrees(turn['articulation_rad']):.1f} deg: R = {turn['radius_m']:.2f} m"
            axis.plot(*np.array(turn["path"]).T, color=colour, lw=2.2, label=label)
        axis.set_aspect("equal")
        _labels(axis, "Path of the front axle", "east [m]", "north [m]")
        axis.get_figure().legend(loc="outside lower center")


def _braking(b: dict[str, Any], path: Path) -> None:
    with sheet(path) as axis:
        t = _time(b["hang_rad"])
        axis.plot(t, np.degrees(b["hang_rad"]), label="grapple from the vertical [deg]")
        axis.plot(t, b["speed_m_s"], label="speed [m/s]")
        axis.axvline(6.0, color=STEEL, lw=0.8, ls="--")
        _labels(axis, "Driving off, cruising, braking", "time [s]", legend=True)


def _energy(kinetic_j: list[float], falling_j: list[float], path: Path) -> None:
    with sheet(path, 2) as (left, right):
        left.semilogy(_time(kinetic_j), np.maximum(kinetic_j, 1e-6))
        _labels(left, "Undisturbed machine", "time after all spools are closed [s]", "kinetic energy [J]")
        right.plot(_time(falling_j, STEP_S), falling_j, color=TIMBER)
        _labels(right, "Falling pile", "time [s]", "kinetic + potential [J]")


def _endurance(rows: list[dict[str, float]], path: Path) -> None:
    minutes = [r["time_s"] / 60.0 for r in rows]
    with sheet(path, 2) as (left, right):
        left.plot(minutes, [r["resident_mb"] for r in rows], "o-", ms=2)
        left.set_ylim(bottom=0)
        _labels(left, "Memory", "work [min]", "resident memory [MB]")
        first = rows[min(WARM_CYCLES, len(rows) - 1)]
        for key, label in (("tip_z_m", "true tip"), ("encoder_z_m", "encoders")):
            right.plot(minutes, [1e3 * (r[key] - first[key]) for r in rows], "o-", ms=2, label=label)
        right.set_ylim(-15, 15)
        limit_band(right, -10.0, 10.0)
        _labels(right, "Drift", "work [min]", "tip height at home [mm]", legend=True)


def _cost(step_ms: dict[str, float], path: Path) -> None:
    counts = [int(k) for k in step_ms]
    with sheet(path) as axis:
        axis.loglog(counts, list(step_ms.values()), "o-")
        axis.axhline(2.5, color=RUST, ls="--", lw=0.8, label="real time")
        for n, ms in zip(counts, step_ms.values(), strict=True):
            axis.annotate(f"{ms:.2f} ms", (n, ms), textcoords="offset points", xytext=(0, 6), ha="center")
        axis.set_xticks(counts, [str(n) for n in counts])
        axis.set_yticks([0.1, 0.2, 0.5, 1.0, 2.0, 5.0], ["0.1", "0.2", "0.5", "1", "2", "5"])
        axis.minorticks_off()
        _labels(axis, "Cost of a 2.5 ms step", "logs on the ground", "physics step [ms]", legend=True)
