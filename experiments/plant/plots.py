"""Plots of the plant experiment, one function per plot."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from runtime.plot_style import MOSS, OIL, RUST, STEEL, TIMBER, limit_band, sheet

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
    _boom_stop(metrics, traces, out / "boom-stop.png")
    _sharing(traces["sharing"], out / "sharing.png")
    _slew_stop(traces, out / "slew-stop.png")
    _pendulum(traces, out / "pendulum.png")
    _cylinder(traces, out / "cylinder.png")
    _turning(traces["turning"], out / "turning.png")
    _braking(traces["braking"], out / "braking.png")
    _energy(traces, out / "energy.png")
    _endurance(traces["endurance"], out / "endurance.png")
    _cost(traces["step_ms"], out / "cost.png")


def _time(values: Sequence[float] | np.ndarray, step_s: float) -> np.ndarray:
    return np.arange(len(values)) * step_s


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
        left.set_xlabel("deepest penetration of a jaw [mm]")
        left.set_ylabel("good grasps")
        middle.hist(rows[:, 1], bins=np.linspace(0, 4, 25), color=TIMBER)
        middle.axvline(3.0, color=RUST, ls="--", lw=0.8)
        middle.set_xlabel("highest speed of a log [m/s]")
        right.plot(rows[:, 2], rows[:, 3], "o", ms=3, color=MOSS)
        top = max(10.0, *rows[:, 2:].max(axis=0)) if len(rows) else 10.0
        right.plot([0, top], [0, top], color=STEEL, lw=0.8)
        right.set_xlabel("true load [kg]")
        right.set_ylabel("load cell [kg]")
        left.set_title("Penetration")
        middle.set_title("Log speed")
        right.set_title("Load cell")


def _sag(rows: list[dict[str, float]], path: Path) -> None:
    load = [r["load_kg"] for r in rows]
    with sheet(path, 2) as (left, right):
        left.plot(load, [1e3 * r["sag_m"] for r in rows], "o-", label="sag of the true tip")
        left.plot(load, [1e3 * r["encoder_drop_m"] for r in rows], "s-", label="drop shown by encoders")
        left.plot([250, 250], [80, 120], color=RUST, lw=5, alpha=0.3, solid_capstyle="butt", label="80 to 120 mm")
        left.set_xlabel("load on the hook at 6 m [kg]")
        left.set_ylabel("[mm]")
        left.set_title("Structure")
        left.legend()
        right.plot(load, [1e-3 * r["force_n"] for r in rows], "o", label="pA AA - pB AB")
        right.plot(load, [1e-3 * r["static_n"] for r in rows], "-", label="statics")
        right.set_xlabel("load [kg]")
        right.set_ylabel("lift cylinder [kN]")
        pressure = right.twinx()
        pressure.plot(load, [1e-6 * r["pressure_pa"] for r in rows], color=MOSS, ls=":", label="pA")
        pressure.set_ylabel("pA [MPa]", color=MOSS)
        pressure.grid(visible=False)
        right.set_title("Oil")
        right.legend()


def _boom_stop(m: Metrics, traces: dict[str, Any], path: Path) -> None:
    with sheet(path) as axis:
        for name, colour in (("empty", OIL), ("250kg", TIMBER)):
            heights = np.array(traces["boom_stop"][name])
            label = f"{name}: {m[f'ring_hz_{name}']:.2f} Hz, zeta {m[f'ring_zeta_{name}']:.3f}"
            t = _time(heights, traces["boom_stop_step_s"])
            axis.plot(t, 1e3 * (heights - heights[-len(heights) // 4 :].mean()), color=colour, label=label)
        axis.axvline(1.5, color=STEEL, lw=0.8, ls="--")
        axis.set_ylim(-350, 250)
        axis.set_xlabel("time [s]")
        axis.set_ylabel("true tip height from rest [mm]")
        axis.set_title("A boom stop rings")
        axis.legend()


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
        axis.set_ylabel("speed at full spool")
        axis.set_title("One pump for all functions")
        axis.legend()


def _slew_stop(traces: dict[str, Any], path: Path) -> None:
    angles = np.degrees(traces["slew_stop"])
    t = _time(angles, traces["slew_stop_step_s"])
    with sheet(path) as axis:
        axis.plot(t, angles, label="fork hinge")
        axis.axvspan(0, 1.5, color=TIMBER, alpha=0.12, lw=0, label="slewing")
        period = 1.0 / traces["slew_stop_hz"]
        after = np.flatnonzero(t > 2.2)
        peak = t[after[np.argmax(np.abs(angles[after]))]]
        for k in range(int((t[-1] - peak) / period) + 1):
            axis.axvline(peak + k * period, color=RUST, lw=0.7, ls=":", label=None if k else "theory, every period")
        axis.set_xlabel("time [s]")
        axis.set_ylabel("[deg]")
        axis.set_title("A grasped log swings after a slew stop")
        axis.legend(loc="upper right")


def _pendulum(traces: dict[str, Any], path: Path) -> None:
    with sheet(path, 2) as axes:
        for axis, (name, p) in zip(axes, traces["pendulum"].items(), strict=True):
            angles = np.degrees(p["angle_rad"])
            t = _time(angles, traces["pendulum_step_s"])
            envelope = angles[0] * np.exp(-p["zeta"] * 2.0 * math.pi * p["hz"] * t)
            axis.plot(t, angles)
            axis.plot(t, envelope, color=RUST, ls="--", lw=0.9)
            axis.plot(t, -envelope, color=RUST, ls="--", lw=0.9)
            axis.set_xlabel("time [s]")
            axis.set_ylabel("[deg]")
            axis.set_title(f"{name} hinge, theory {p['hz']:.3f} Hz, zeta {p['zeta']:.3f}")


def _cylinder(traces: dict[str, Any], path: Path) -> None:
    with sheet(path) as axis:
        y = 1e3 * np.array(traces["cylinder"])
        axis.plot(_time(y, 0.0025), y)
        axis.set_xlabel("time [s]")
        axis.set_ylabel("joint [mrad]")
        axis.set_title(f"Oil spring of the lift cylinder, theory {traces['cylinder_hz']:.2f} Hz")


def _turning(turns: list[dict[str, Any]], path: Path) -> None:
    with sheet(path, 1, 5.0, 4.6) as axis:
        for turn, colour in zip(turns, (OIL, TIMBER), strict=True):
            xy, (x, y), r = np.array(turn["path"]), turn["centre"], turn["radius"]
            a = np.linspace(0, 2 * math.pi, 200)
            axis.plot(x + r * np.cos(a), y + r * np.sin(a), color=colour, lw=0.8, ls="--")
            label = f"{math.degrees(turn['articulation_rad']):.1f} deg: theory R = {r:.2f} m"
            axis.plot(*xy.T, color=colour, lw=2.2, label=label)
        axis.set_aspect("equal")
        axis.set_xlabel("east [m]")
        axis.set_ylabel("north [m]")
        axis.set_title("Path of the front axle")
        axis.get_figure().legend(loc="outside lower center")


def _braking(b: dict[str, Any], path: Path) -> None:
    with sheet(path) as axis:
        t = _time(b["hang_rad"], b["step_s"])
        axis.plot(t, np.degrees(b["hang_rad"]), label="grapple from the vertical [deg]")
        axis.plot(t, b["speed_m_s"], label="speed [m/s]")
        axis.axvline(6.0, color=STEEL, lw=0.8, ls="--")
        axis.set_xlabel("time [s]")
        axis.set_title("Driving off, cruising, braking")
        axis.legend()


def _energy(traces: dict[str, Any], path: Path) -> None:
    with sheet(path, 2) as (left, right):
        kinetic = np.maximum(traces["kinetic_j"], 1e-6)
        left.semilogy(_time(kinetic, traces["kinetic_step_s"]), kinetic)
        left.set_xlabel("time after all spools are closed [s]")
        left.set_ylabel("kinetic energy [J]")
        left.set_title("Undisturbed machine")
        falling = np.array(traces["falling_j"])
        right.plot(_time(falling, traces["falling_step_s"]), falling, color=TIMBER)
        right.set_xlabel("time [s]")
        right.set_ylabel("kinetic + potential [J]")
        right.set_title("Falling pile")


def _endurance(rows: list[dict[str, float]], path: Path) -> None:
    minutes = [r["time_s"] / 60.0 for r in rows]
    with sheet(path, 2) as (left, right):
        left.plot(minutes, [r["resident_mb"] for r in rows], "o-", ms=2)
        left.set_xlabel("work [min]")
        left.set_ylabel("resident memory [MB]")
        left.set_ylim(bottom=0)
        left.set_title("Memory")
        first = rows[min(3, len(rows) - 1)]
        for key, label in (("tip_z_m", "true tip"), ("encoder_z_m", "encoders")):
            right.plot(minutes, [1e3 * (r[key] - first[key]) for r in rows], "o-", ms=2, label=label)
        right.set_ylim(-15, 15)
        limit_band(right, -10.0, 10.0)
        right.set_xlabel("work [min]")
        right.set_ylabel("tip height at home [mm]")
        right.set_title("Drift")
        right.legend()


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
        axis.set_xlabel("logs on the ground")
        axis.set_ylabel("physics step [ms]")
        axis.set_title("Cost of a 2.5 ms step")
        axis.legend()
