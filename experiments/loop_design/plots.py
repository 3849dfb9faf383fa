"""Plots of every joint's loop: Bode diagram of the nominal and the worst machine, and the margins of all machines."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from experiments.loop_design.loop import FREQUENCY_RAD_S
from experiments.loop_design.study import MIN_GAIN_DB, MIN_PHASE_DEG, JointStudy
from runtime.plot_style import OIL, RUST, STEEL, sheet


def plot_name(machine: str, loop: str) -> str:
    """File name of the plot of a loop."""
    return f"{machine}-{loop.replace(' ', '-')}.png"


def draw(machine: str, studies: Sequence[JointStudy], out: Path) -> list[Path]:
    """Write one plot per loop into ``out``; returns the files."""
    files = []
    for joint in studies:
        path = out / plot_name(machine, joint.name)
        with sheet(path, 3, width=11.0, height=3.4) as (gain, phase, cloud):
            hz = FREQUENCY_RAD_S / (2.0 * math.pi)
            for loop, colour, name in ((joint.nominal_loop, OIL, "nominal"), (joint.worst_loop, RUST, "worst")):
                gain.semilogx(hz, 20.0 * np.log10(np.abs(loop)), color=colour, label=name)
                degrees = np.degrees(np.unwrap(np.angle(loop)))
                phase.semilogx(hz, degrees - (360.0 if degrees[0] > 0.0 else 0.0), color=colour)
            gain.axhline(0.0, color=STEEL, lw=0.8)
            gain.set_ylim(-60, 40)
            gain.set_title(f"{joint.name}: loop gain [dB]")
            gain.legend()
            phase.axhline(-180.0, color=STEEL, lw=0.8)
            phase.set_ylim(-540, 0)
            phase.set_title("phase [deg]")
            for axis in (gain, phase):
                axis.set_xlabel("frequency [Hz]")
            delays = [1e3 * case.delay_s for case in joint.cases]
            shown = cloud.scatter(
                [m.phase_deg for m in joint.margins], [m.gain_db for m in joint.margins], c=delays, s=7, cmap="viridis"
            )
            cloud.figure.colorbar(shown, label="dead time [ms]")
            cloud.axvline(MIN_PHASE_DEG, color=RUST, lw=0.8, ls="--")
            cloud.axhline(MIN_GAIN_DB, color=RUST, lw=0.8, ls="--")
            cloud.set_xlabel("phase margin [deg]")
            cloud.set_title("gain margin [dB], all machines")
        files.append(path)
    return files
