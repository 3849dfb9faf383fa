"""Scenes for the path tracer from settled piles: plain data, drawn from a seed."""

from __future__ import annotations

import math
import random
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from machine.geometry.optics import Intrinsics
from sim.camera.geometry import View, look_at, quaternion_matrix
from sim.camera.scene import LogPose
from training.pictures.piles import Pile, ground_of, profile_of
from training.pictures.props import Steel
from training.pictures.traced import looks

VERSION: Final = 1  # incremented when the same seed would give another scene
REACH_M, CELL_M, FINER = 9.0, 0.25, 4  # of the ground around the logs
MAX_GROWTH: Final = 1.5  # by which a pile is enlarged, to 45 cm
BASELINES_M: Final = (0.05, 0.063, 0.12)  # of the stereo cameras in use


@dataclass(frozen=True, slots=True)
class Format:
    """Size of the pictures [px], samples of each pixel, views of a scene, share of views with a second eye."""

    size_px: int = 512
    samples: int = 10
    views: int = 3
    stereo_share: float = 0.15


def describe(pile: Pile, seed: int, form: Format) -> dict[str, Any]:
    """Describe the scene of a pile, drawn from ``seed``."""
    rng = random.Random(f"traced {VERSION} {pile.machine} {pile.number} {seed}")
    growth = math.exp(rng.uniform(math.log(0.7), math.log(MAX_GROWTH)))
    logs = _logs(pile, growth, rng)
    snow = rng.uniform(0.15, 1.0) if rng.random() < 0.2 else 0.0
    middle = np.mean([log.position_m for log in logs], axis=0)
    dropped = _loose(middle, rng) if rng.random() < 0.25 else []
    kinds = rng.choices(looks.BARKS, looks.BARK_SHARES, k=rng.choice((1, 1, 2, 3)))
    barks = [looks.bark(rng, kind, snow) for kind in (*kinds, *kinds)]
    everything = [*logs, *dropped]
    number = [replace(log, instance=k) for k, log in enumerate(everything, 1)]
    clear = [[float(p[0]), float(p[1]), 0.25 + log.diameter_m] for log in number for p in log.spine(12)[0]]
    views = [_view(number, k, rng, form) for k in range(form.views)]
    wide = [*([x, y, r + 0.5] for x, y, r in clear), *([*v["eye_m"][:2], 1.6] for v in views)]
    wide += [[*(0.5 * (np.array(v["eye_m"][:2]) + v["target_m"][:2])).tolist(), 1.0] for v in views]
    return {
        "version": VERSION,
        "pile": f"{pile.machine} {pile.number} {pile.kind}",
        "seed": rng.getrandbits(30),
        "logs": [_log(log, rng, len(barks)) for log in number],
        "barks": barks,
        "ground": looks.ground(rng, snow) | _heights(pile, growth, middle, snow, rng),
        "crowds": looks.crowds(rng, middle.tolist(), wide, clear, snow),
        "boxes": _steel(pile, growth, middle, rng),
        "views": views,
    }


def log_poses(scene: Mapping[str, Any]) -> tuple[LogPose, ...]:
    """Return the logs of a described scene."""
    names = ("position_m", "quaternion", "length_m", "diameter_m", "taper_m_m", "sweep_m")
    return tuple(LogPose(log["number"], *(log[name] for name in names)) for log in scene["logs"])


def view_of(view: Mapping[str, Any]) -> View:
    """Return the camera of a described view."""
    pin = Intrinsics(
        view["width_px"], view["height_px"], view["focal_px"], view["focal_px"], view["cx_px"], view["cy_px"]
    )
    return View(pin, np.array(view["eye_m"]), np.array(view["turn"]))


def _logs(pile: Pile, growth: float, rng: random.Random) -> list[LogPose]:
    """Enlarge the pile as a whole, so that logs still touch; some are gone from the top, some lengths differ."""
    logs = sorted(pile.logs, key=lambda log: log.position_m[2])
    if len(logs) > 1 and rng.random() < 0.3:
        logs = logs[: rng.randint(1, len(logs))]
    longer = rng.choice((1.0, 1.0, rng.uniform(0.75, 1.7)))
    return [
        replace(
            log,
            position_m=tuple(growth * x for x in log.position_m),
            length_m=longer * growth * log.length_m,
            diameter_m=growth * log.diameter_m,
            taper_m_m=log.taper_m_m / longer,
            sweep_m=growth * log.sweep_m,
        )
        for log in logs
    ]


def _loose(middle: np.ndarray, rng: random.Random) -> list[LogPose]:
    """Draw a crooked heap as a harvester leaves it; its logs may sink a little into each other and into soft ground."""
    heap_logs, azimuth_rad = [], rng.uniform(-math.pi, math.pi)
    distance_m = rng.uniform(1.5, 3.5)
    base = middle + np.array([distance_m * math.cos(azimuth_rad), distance_m * math.sin(azimuth_rad), 0.0])
    base[2] = min(base[2], middle[2])
    thick, long, main = rng.uniform(0.08, 0.3), rng.uniform(1.8, 4.5), rng.uniform(-math.pi, math.pi)
    for k in range(rng.randint(1, 6)):
        d = max(0.06, thick * rng.uniform(0.7, 1.3))
        turn = main + rng.gauss(0.0, 0.3)
        pitch = math.pi / 2 + rng.gauss(0.0, 0.04)
        at = base + np.array([rng.gauss(0.0, 0.45), rng.gauss(0.0, 0.3), 0.45 * thick + 0.8 * thick * (k // 3)])
        c, s = math.cos(turn / 2), math.sin(turn / 2)
        cp, sp = math.cos(pitch / 2), math.sin(pitch / 2)
        quaternion = (-s * sp, c * sp, s * cp, c * cp)
        sweep = rng.choice((0.0, 0.0, 0.05)) * rng.random()
        heap_logs.append(
            LogPose(1, tuple(at), quaternion, long * rng.uniform(0.85, 1.1), d, 0.01 * rng.random(), sweep)
        )
    return heap_logs


def _log(log: LogPose, rng: random.Random, barks: int) -> dict[str, Any]:
    s = np.linspace(-0.5, 0.5, 13)
    spine = np.stack([-4.0 * log.sweep_m * s * s, np.zeros_like(s), s * log.length_m], axis=1)
    radii = np.maximum(0.025, (log.diameter_m - log.taper_m_m * s * log.length_m) / 2)
    return {
        "number": log.instance,
        "quaternion": list(log.quaternion),
        "length_m": log.length_m,
        "diameter_m": log.diameter_m,
        "taper_m_m": log.taper_m_m,
        "sweep_m": log.sweep_m,
        "position_m": list(log.position_m),
        "turn": quaternion_matrix(log.quaternion).tolist(),
        "spine_m": spine.tolist(),
        "radii_m": radii.tolist(),
        "bark": rng.randrange(barks),
        "oval": rng.uniform(0.0, 0.1),
        "bump": rng.uniform(0.004, 0.03),
        "flare": rng.uniform(0.1, 0.4) if rng.random() < 0.2 else 0.0,
        "knots": rng.choice((0, 0, 3, 8)),
    }


def _heights(pile: Pile, growth: float, middle: np.ndarray, snow: float, rng: random.Random) -> dict[str, Any]:
    """Describe the ground around the logs, with ruts beside them; it is a little higher where snow or soft soil took
    them in."""
    ground = ground_of(pile)
    n = round(2 * REACH_M / CELL_M) + 1
    x0, y0 = float(middle[0]) - REACH_M, float(middle[1]) - REACH_M
    at = np.arange(n) * CELL_M
    h = np.array([[growth * ground.height((x0 + x) / growth, (y0 + y) / growth) for y in at] for x in at])
    h += rng.choice((0.0, 0.01, 0.03 if snow else 0.0))
    if rng.random() < 0.25:
        turn, offset = rng.uniform(0.0, math.pi), rng.uniform(2.0, 4.0)
        across = (at[:, None] + x0 - middle[0]) * math.cos(turn) + (at[None] + y0 - middle[1]) * math.sin(turn)
        for side in (0.0, rng.uniform(1.6, 2.2)):
            h -= rng.uniform(0.08, 0.25) * np.exp(-(((across - offset - side) / 0.3) ** 2))
    return {
        "x0_m": x0,
        "y0_m": y0,
        "cell_m": CELL_M,
        "heights_m": h.round(4).tolist(),
        "finer": FINER,
        "rough_m": rng.uniform(0.002, 0.014),
    }


def _view(logs: Sequence[LogPose], number: int, rng: random.Random, form: Format) -> dict[str, Any]:
    """Draw a camera on a carrier, on the stick, or over the grapple."""
    size, spines = form.size_px, [log.spine(8)[0] for log in logs]
    for _ in range(60):
        points = rng.choice(spines)
        target = points[rng.randrange(9)] + np.array([rng.gauss(0.0, 0.4), rng.gauss(0.0, 0.4), 0.0])
        azimuth_rad, kind = rng.uniform(-math.pi, math.pi), rng.random()
        if kind < 0.55:
            up, flat = rng.uniform(1.5, 3.4), rng.uniform(2.0, 7.5)
        elif kind < 0.85:
            reach, slope = rng.uniform(2.2, 6.0), math.radians(rng.uniform(25.0, 75.0))
            up, flat = reach * math.sin(slope), reach * math.cos(slope)
        else:
            up, flat = rng.uniform(2.4, 4.2), rng.uniform(0.05, 0.8)
        eye = target + np.array([flat * math.cos(azimuth_rad), flat * math.sin(azimuth_rad), up])
        if all(np.linalg.norm(s - eye, axis=1).min() > 1.2 for s in spines):
            break
    angle = math.radians(rng.uniform(52.0, 95.0))
    focal = 0.5 * size / math.tan(0.5 * angle)
    pin = Intrinsics(size, size, focal, focal, 0.5 * (size - 1), 0.5 * (size - 1))
    aside = target + np.array([rng.gauss(0.0, 0.12), rng.gauss(0.0, 0.12), rng.gauss(0.0, 0.1)]) * float(
        np.linalg.norm(eye - target)
    )
    view = look_at(eye.tolist(), aside.tolist(), pin)
    roll = rng.gauss(0.0, 0.05)
    c, s = math.cos(roll), math.sin(roll)
    turn = view.rotation @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return {
        "eye_m": eye.tolist(),
        "target_m": target.tolist(),
        "turn": turn.tolist(),
        "focal_px": focal,
        "cx_px": pin.cx_px,
        "cy_px": pin.cy_px,
        "width_px": size,
        "height_px": size,
        "samples": form.samples,
        "seed": rng.getrandbits(30),
        "light": looks.light(rng, eye.tolist(), target.tolist()),
        "baseline_m": rng.choice(BASELINES_M) if rng.random() < form.stereo_share else 0.0,
        "number": number,
    }


def _steel(pile: Pile, growth: float, middle: np.ndarray, rng: random.Random) -> list[dict[str, Any]]:
    """Describe the bunk around a load, and sometimes grapple, boom and boxes."""
    steel, profile = Steel(rng), profile_of(pile.machine)
    if pile.kind == "bunk":
        steel.bunk(profile, np.zeros(3), 0.0)
    if rng.random() < 0.25:
        above = middle + np.array([rng.gauss(0.0, 0.6), rng.gauss(0.0, 0.6), rng.uniform(0.9, 2.4)])
        steel.grapple(profile, above, rng.uniform(-math.pi, math.pi), rng.random())
    if rng.random() < 0.15:
        steel.boom(middle + np.array([rng.gauss(0.0, 1.0), rng.gauss(0.0, 1.0), rng.uniform(1.2, 2.2)]))
    boxes = steel.build()
    grow = growth if pile.kind == "bunk" else 1.0
    return [
        {"centre_m": (grow * c).tolist(), "turn": a.tolist(), "half_m": (grow * h).tolist(), "colour": k.tolist()}
        for c, a, h, k in zip(boxes.centre_m, boxes.axes, boxes.half_m, boxes.colour, strict=True)
    ]
