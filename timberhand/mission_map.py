"""A mission as a map in local metres, north up."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.colors import to_rgba

from autonomy.missions.local_frame import site_frame, yaw_from_bearing
from autonomy.missions.model import ForwardingMission, KnownLog
from autonomy.missions.review import Review
from autonomy.missions.validation import legs
from runtime.plot_style import MOSS, OIL, RUST, STEEL, TIMBER, sheet

LOG_LENGTH_M = 3.0
"""Length of a log whose length is unknown."""


def draw(mission: ForwardingMission, review: Review | None, path: Path) -> None:
    """Write the map as PNG.

    Raises:
        OSError: the file cannot be written.
    """
    frame = site_frame(mission)
    route = frame.points_enu(mission.waypoints)[:, :2]
    fences = [(frame.points_enu(fence.corners)[:, :2], fence.keep_out) for fence in mission.fences]
    logs = frame.points_enu([log.position for log in mission.logs])[:, :2]
    landings = frame.points_enu([landing.position for landing in mission.landings])[:, :2]
    everything = np.concatenate([route, logs, landings, *(ring for ring, _ in fences)])
    low, high = everything.min(axis=0), everything.max(axis=0)
    span = np.maximum(high - low, 5.0)
    margin = 0.06 * float(span.max()) + 1.0
    width, height = _size(span + 2 * margin)
    with sheet(path, width=width, height=height) as axis:
        axis.set_aspect("equal")
        axis.set_xlim(low[0] - margin, low[0] + span[0] + margin)
        axis.set_ylim(low[1] - margin, low[1] + span[1] + margin)
        for ring, keep_out in fences:
            _fence(axis, ring, keep_out)
        if len(route):
            _route(axis, route, legs(mission), review)
        for log, at in zip(mission.logs, logs, strict=True):
            _log(axis, log, at)
        for landing, at in zip(mission.landings, landings, strict=True):
            axis.plot(*at, marker="s", ms=9, mfc="white", mec=MOSS, mew=2.0, ls="none", zorder=6)
            words = {"color": MOSS, "weight": "bold", "parse_math": False}
            axis.annotate(landing.name or "landing", at, (8, 6), textcoords="offset points", **words)
        origin = f"{abs(frame.latitude_deg):.6f}° {'N' if frame.latitude_deg >= 0 else 'S'}, "
        origin += f"{abs(frame.longitude_deg):.6f}° {'E' if frame.longitude_deg >= 0 else 'W'}"
        axis.set_title(mission.name or "mission", parse_math=False)
        axis.set_xlabel(f"east of {origin}, m")
        axis.set_ylabel("north, m")
        _legend(axis, mission, review)


def _size(span: np.ndarray) -> tuple[float, float]:
    """Compute the size of the sheet in inches, so that the map fills it."""
    width = 8.0
    return width, float(np.clip(width * span[1] / span[0] * 0.92 + 1.3, 3.4, 11.0))


def _fence(axis: Any, ring: np.ndarray, keep_out: bool) -> None:
    closed = np.vstack([ring, ring[:1]])
    color = RUST if keep_out else MOSS
    axis.fill(*closed.T, color=color, alpha=0.16 if keep_out else 0.07, lw=0, zorder=1)
    axis.plot(*closed.T, color=color, lw=1.4, ls="-" if keep_out else "--", zorder=2)


def _route(axis: Any, route: np.ndarray, edges: list[tuple[int, int]], review: Review | None) -> None:
    for i, j in edges:
        a, b = route[i], route[j]
        axis.plot(*np.array([a, b]).T, color=OIL, lw=1.6, zorder=3)
        if np.linalg.norm(b - a) > 1.0:
            axis.annotate(
                "", a + 0.56 * (b - a), a + 0.5 * (b - a), arrowprops={"arrowstyle": "-|>", "color": OIL, "lw": 1.6}
            )
    for corner in review.corners if review is not None else ():
        if math.isfinite(corner.switch_m) and corner.turn_rad > 0.05:
            turn = np.linspace(0.0, math.tau, 90)
            circle = route[corner.waypoint] + corner.switch_m * np.stack([np.cos(turn), np.sin(turn)], axis=1)
            axis.plot(*circle.T, color=STEEL, lw=0.7, ls=":", zorder=2)
    axis.plot(*route.T, marker="o", ms=13 if len(route) <= 60 else 3, color=OIL, ls="none", zorder=5)
    if len(route) <= 60:
        for number, at in enumerate(route, 1):
            axis.annotate(str(number), at, ha="center", va="center", color="white", size=8, weight="bold", zorder=6)


def _log(axis: Any, log: KnownLog, at: np.ndarray) -> None:
    if log.sigma_m:
        turn = np.linspace(0.0, math.tau, 60)
        disc = at[:, None] + 2.0 * log.sigma_m * np.stack([np.cos(turn), np.sin(turn)])
        axis.fill(*disc, facecolor=to_rgba(TIMBER, 0.05), edgecolor=to_rgba(TIMBER, 0.4), lw=0.5, zorder=2)
    if log.bearing_deg is None:
        axis.plot(*at, marker="o", ms=5, color=TIMBER, ls="none", zorder=4)
        return
    yaw = yaw_from_bearing(log.bearing_deg)
    half = 0.5 * (log.length_m or LOG_LENGTH_M) * np.array([math.cos(yaw), math.sin(yaw)])
    axis.plot(*np.array([at - half, at + half]).T, color=TIMBER, lw=4.0, solid_capstyle="butt", zorder=4)


def _legend(axis: Any, mission: ForwardingMission, review: Review | None) -> None:
    from matplotlib.lines import Line2D

    entries = []
    if review is not None:
        laps = f" in {mission.options.laps} laps" if mission.options.laps > 1 else ""
        label = f"route, {review.length_m:.0f} m{laps}"
        entries.append(Line2D([], [], color=OIL, lw=1.6, label=label))
    if review is not None and review.corners:
        entries.append(Line2D([], [], color=STEEL, lw=0.7, ls=":", label="turn begins"))
    if any(not fence.keep_out for fence in mission.fences):
        entries.append(Line2D([], [], color=MOSS, lw=1.4, ls="--", label="fence"))
    if any(fence.keep_out for fence in mission.fences):
        entries.append(Line2D([], [], color=RUST, lw=1.4, label="keep out"))
    if mission.logs:
        entries.append(Line2D([], [], color=TIMBER, lw=4.0, label=f"{len(mission.logs)} logs"))
    if any(log.sigma_m for log in mission.logs):
        entries.append(Line2D([], [], color=TIMBER, alpha=0.4, lw=0.8, label="log within, 2 sigma"))
    if mission.landings:
        entries.append(Line2D([], [], marker="s", ms=8, mfc="white", mec=MOSS, mew=2.0, ls="none", label="landing"))
    if entries:
        axis.legend(handles=entries, loc="upper center", bbox_to_anchor=(0.5, -0.1), ncols=min(len(entries), 4))
