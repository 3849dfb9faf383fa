"""Draws a stop: mode, commands, velocities, positions and lateness, from 10 s before it to 5 s after it."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, Final

from can_dbc.dbc.codec import load
from controller.supervisor import LATE_NS
from machine.joints import JOINTS, Joint
from machine.status.modes import Mode
from runtime.plot_style import MOSS, OIL, RUST, STEEL, TIMBER, stack
from timberhand.why.stops import FoundStop
from timberhand.why.timeline import reports_of

COLORS: Final = (OIL, TIMBER, MOSS, RUST, STEEL)
COMMANDS: Final = {"ValveCmdA": ("Slew", "Lift", "Tilt", "Ext"), "ValveCmdB": ("Rot",)}
_NAN: Final = math.nan

Series = list[tuple[float, ...]]


def draw(found: FoundStop, path: Path) -> None:
    """Write the plot as PNG; raises OSError."""
    at_ns = found.stop.at_ns
    reports = list(reports_of(found.ticks))
    times = [(report.stamp_ns - at_ns) / 1e9 for report in reports]
    with stack(path, (1.0, 1.6, 1.6, 1.6, 1.0), width=9.0, height=9.5) as axes:
        mode, commands, velocities, positions, lateness = axes
        _draw_modes(mode, times, [report.mode for report in reports])
        command_times, values = _commands(found)
        _draw_joints(commands, command_times, values, "command [%]")
        commands.legend(
            [joint.name.lower() for joint in JOINTS], ncols=len(JOINTS), loc="lower left", bbox_to_anchor=(0.0, 0.98)
        )
        _draw_joints(velocities, times, [_scaled(report.velocity) for report in reports], "velocity\n[°/s, ext cm/s]")
        _draw_joints(positions, times, [_scaled(report.position) for report in reports], "position\n[°, ext cm]")
        _draw_joints(positions, times, [_scaled(report.reference) for report in reports], "", dashed=True)
        late_ms = [tick.late_ns / 1e6 for tick in found.ticks] or [0.0]
        tick_times = [(tick.now_ns - at_ns) / 1e9 for tick in found.ticks] or [0.0]
        lateness.plot(tick_times, late_ms, color=STEEL, lw=0.8)
        if max(late_ms) > LATE_NS / 2e6:  # else the limit would flatten the curve
            lateness.axhline(LATE_NS / 1e6, color=RUST, lw=0.8, ls="--")
        lateness.set_ylim(min(0.0, *late_ms), max(1.0, 1.1 * max(late_ms)))
        lateness.set_ylabel("lateness\n[ms]")
        lateness.set_xlabel("time from the stop [s]")
        lateness.set_xlim(min(times, default=-1.0), max(times, default=1.0))
        for axis in axes:
            axis.axvline(0.0, color="black", lw=1.2)
        explained = found.stop.explanation
        mode.set_title("\n".join(filter(None, (f"{found.stop.code}: {explained.sentence}", explained.measured))))


def _draw_modes(axis: Any, times: list[float], modes: list[int]) -> None:
    axis.step(times, modes, where="post", color=OIL)
    shown = sorted(set(modes))
    axis.set_yticks(shown, [Mode(mode).name for mode in shown])
    axis.set_ylabel("mode")
    axis.margins(y=0.2)


def _draw_joints(axis: Any, times: list[float], values: Series, label: str, dashed: bool = False) -> None:
    for joint in JOINTS:
        line = [row[joint] for row in values]
        if dashed:
            axis.plot(times, line, color=COLORS[joint], ls=":", lw=0.9)
        else:
            axis.plot(times, line, color=COLORS[joint], ls="-", lw=1.1)
    if label:
        axis.set_ylabel(label)


def _commands(found: FoundStop) -> tuple[list[float], Series]:
    """Collect times and spool commands [%] of every tick that sent them, in ``Joint`` order."""
    database = load("crane")
    command_codecs = {database.message(name).key: (database.message(name), names) for name, names in COMMANDS.items()}
    times: list[float] = []
    rows: Series = []
    for tick in found.ticks:
        row: list[float] = []
        for key, data in tick.frames_out:
            if key in command_codecs:
                codec, names = command_codecs[key]
                values = codec.decode(data)
                row += [_NAN if (value := values[codec.index[name]]) is None else value for name in names]
        if len(row) == len(JOINTS):
            times.append((tick.now_ns - found.stop.at_ns) / 1e9)
            rows.append(tuple(row))
    return times, rows


def _scaled(values: tuple[float, ...]) -> tuple[float, ...]:
    """Convert angles to degrees, the telescope to cm, so that all joints fit on one axis."""
    return tuple(value * 100.0 if joint == Joint.EXT else math.degrees(value) for joint, value in enumerate(values))
