"""Plot of the calibration experiment: errors of every joint."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from experiments.calibration.metrics import DEADBAND_PCT, DELAY_MS, GAIN
from runtime.plot_style import MOSS, OIL, STEEL, limit_band, sheet


def draw(path: Path, outcomes: Sequence[dict[str, Any]]) -> None:
    """Plot the errors of every joint: dead-band, full speed, dead time."""
    ended = [o for o in outcomes if not o["failure"]]
    names = list(dict.fromkeys(n for o in ended for n in o["joints"]))
    with sheet(path, 3, 9.0, 3.0) as (deadband, gain, delay):
        for x, name in enumerate(names):
            found = [o["joints"][name] for o in ended]
            for axis, values in (
                (deadband, [r["deadband_pct"] for r in found]),
                (gain, [[100.0 * e for e in r["gain"]] for r in found]),
                (delay, [[r["delay_ms"]] for r in found]),
            ):
                for i, color in ((0, OIL), (-1, MOSS)):
                    axis.plot(
                        [x + 0.12 * (1 if i else -1)] * len(values), [v[i] for v in values], ".", ms=4, color=color
                    )
        for axis, title, bound in (
            (deadband, "dead-band error [% of spool]", DEADBAND_PCT),
            (gain, "full speed error [%]", 100.0 * GAIN),
            (delay, "dead time error [ms]", DELAY_MS),
        ):
            axis.set(title=title, xticks=range(len(names)), xticklabels=names, ylim=(-1.4 * bound, 1.4 * bound))
            limit_band(axis, -bound, bound)
            axis.axhline(0.0, color=STEEL, lw=0.6)
