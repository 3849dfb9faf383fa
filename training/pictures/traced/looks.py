"""How logs, ground, plants and light of a traced scene look: random, as plain data for the drawing process.

Colours are linear, 0..1.  What is a log: a stem that lies and is at least 5 cm thick and 1 m long.  Branches, twigs and
slash of up to 4 cm, stumps and standing trees are not.
"""

from __future__ import annotations

import math
import random
from collections.abc import Sequence
from typing import Any, Final

Look = dict[str, Any]
Tones = list[list[float]]

BARKS: Final = ("scaly", "plated", "furrowed", "birch", "smooth", "peeled", "furrowed", "wild")
BARK_SHARES: Final = (2.0, 2.0, 2.5, 2.2, 1.3, 1.0, 1.5, 2.5)
"""Kinds of bark and how often they are drawn."""
TONES: Final[dict[str, Sequence[Tones]]] = {
    "scaly": (
        [[0.035, 0.024, 0.02], [0.13, 0.09, 0.07], [0.26, 0.2, 0.17]],
        [[0.05, 0.03, 0.02], [0.2, 0.11, 0.07], [0.32, 0.22, 0.16]],
        [[0.05, 0.05, 0.045], [0.17, 0.16, 0.14], [0.33, 0.31, 0.28]],
    ),
    "plated": (
        [[0.03, 0.018, 0.013], [0.2, 0.09, 0.05], [0.4, 0.22, 0.13]],
        [[0.025, 0.02, 0.018], [0.14, 0.1, 0.08], [0.3, 0.25, 0.22]],
        [[0.05, 0.025, 0.015], [0.34, 0.15, 0.06], [0.55, 0.3, 0.15]],
    ),
    "furrowed": (
        [[0.02, 0.016, 0.013], [0.1, 0.075, 0.06], [0.23, 0.19, 0.16]],
        [[0.03, 0.03, 0.028], [0.14, 0.13, 0.115], [0.31, 0.3, 0.28]],
        [[0.015, 0.012, 0.01], [0.06, 0.045, 0.035], [0.13, 0.1, 0.08]],
    ),
    "birch": (
        [[0.02, 0.018, 0.016], [0.42, 0.39, 0.35], [0.72, 0.7, 0.66]],
        [[0.05, 0.035, 0.03], [0.5, 0.44, 0.38], [0.78, 0.74, 0.69]],
        [[0.02, 0.02, 0.02], [0.26, 0.23, 0.2], [0.55, 0.52, 0.48]],
    ),
    "smooth": (
        [[0.03, 0.03, 0.025], [0.18, 0.19, 0.13], [0.36, 0.36, 0.28]],
        [[0.03, 0.028, 0.024], [0.2, 0.19, 0.17], [0.36, 0.35, 0.33]],
    ),
    "peeled": (
        [[0.18, 0.09, 0.05], [0.5, 0.34, 0.19], [0.66, 0.5, 0.31]],
        [[0.12, 0.09, 0.07], [0.3, 0.28, 0.25], [0.48, 0.46, 0.43]],
        [[0.1, 0.05, 0.03], [0.42, 0.24, 0.12], [0.6, 0.4, 0.22]],
    ),
    "wild": (
        [[0.04, 0.03, 0.02], [0.15, 0.1, 0.08], [0.3, 0.25, 0.2]],
        [[0.02, 0.02, 0.018], [0.1, 0.09, 0.075], [0.5, 0.46, 0.4]],
        [[0.3, 0.28, 0.25], [0.12, 0.1, 0.08], [0.05, 0.04, 0.035]],
        [[0.07, 0.05, 0.04], [0.09, 0.07, 0.055], [0.12, 0.095, 0.075]],
    ),
}
ENDS: Final[Sequence[Tones]] = (
    [[0.42, 0.28, 0.15], [0.62, 0.46, 0.28], [0.5, 0.3, 0.16]],
    [[0.5, 0.38, 0.23], [0.72, 0.58, 0.4], [0.62, 0.45, 0.28]],
    [[0.3, 0.17, 0.09], [0.46, 0.29, 0.17], [0.28, 0.13, 0.07]],
    [[0.2, 0.18, 0.155], [0.34, 0.31, 0.28], [0.22, 0.19, 0.16]],
    [[0.5, 0.25, 0.1], [0.68, 0.42, 0.2], [0.45, 0.18, 0.07]],
)
SOILS: Final[dict[str, Sequence[Tones]]] = {
    "earth": (
        [[0.02, 0.015, 0.01], [0.07, 0.05, 0.025], [0.05, 0.065, 0.02], [0.12, 0.1, 0.06]],
        [[0.03, 0.02, 0.014], [0.09, 0.06, 0.04], [0.19, 0.14, 0.1]],
        [[0.012, 0.01, 0.008], [0.04, 0.03, 0.023], [0.09, 0.07, 0.055]],
        [[0.1, 0.08, 0.06], [0.25, 0.2, 0.15], [0.42, 0.36, 0.28]],
    ),
    "grassy": (
        [[0.03, 0.04, 0.012], [0.09, 0.12, 0.03], [0.2, 0.2, 0.07]],
        [[0.05, 0.045, 0.02], [0.2, 0.17, 0.08], [0.38, 0.33, 0.18]],
        [[0.015, 0.03, 0.008], [0.05, 0.1, 0.02], [0.12, 0.18, 0.05]],
    ),
    "leaves": (
        [[0.05, 0.028, 0.014], [0.2, 0.1, 0.04], [0.38, 0.22, 0.09]],
        [[0.08, 0.06, 0.04], [0.22, 0.17, 0.12], [0.4, 0.34, 0.25]],
    ),
    "stones": ([[0.04, 0.038, 0.035], [0.2, 0.19, 0.18], [0.42, 0.41, 0.39]], [[0.06, 0.05, 0.04], [0.3, 0.26, 0.21]]),
    "needles": (
        [[0.03, 0.02, 0.012], [0.13, 0.075, 0.035], [0.27, 0.17, 0.09]],
        [[0.02, 0.022, 0.01], [0.08, 0.075, 0.03], [0.2, 0.17, 0.1]],
    ),
    "wild": (
        [[0.03, 0.025, 0.02], [0.12, 0.1, 0.07], [0.3, 0.26, 0.2]],
        [[0.1, 0.1, 0.1], [0.2, 0.2, 0.2], [0.3, 0.3, 0.3]],
        [[0.02, 0.03, 0.01], [0.1, 0.07, 0.04], [0.3, 0.3, 0.15]],
    ),
}
MOSS: Final[Sequence[Tones]] = ([[0.025, 0.05, 0.01], [0.1, 0.15, 0.03]], [[0.05, 0.07, 0.015], [0.22, 0.24, 0.06]])
GREENS: Final[Sequence[Tones]] = (
    [[0.03, 0.06, 0.01], [0.1, 0.17, 0.03], [0.22, 0.26, 0.07]],
    [[0.05, 0.08, 0.01], [0.18, 0.2, 0.05], [0.3, 0.25, 0.1]],
    [[0.2, 0.14, 0.06], [0.4, 0.32, 0.16], [0.55, 0.46, 0.27]],
)
WOODS: Final[Sequence[Tones]] = (
    [[0.03, 0.022, 0.016], [0.16, 0.12, 0.09]],
    [[0.09, 0.08, 0.07], [0.36, 0.33, 0.3]],
    [[0.06, 0.03, 0.02], [0.28, 0.16, 0.1]],
)


def varied(tones: Tones, rng: random.Random, spread: float = 0.2) -> Tones:
    """Give tones another brightness and hue."""
    gain = math.exp(rng.gauss(0.0, 1.3 * spread))
    tint = [math.exp(rng.gauss(0.0, 0.35 * spread)) for _ in range(3)]
    return [[min(0.85, gain * t * c) for t, c in zip(tint, tone, strict=True)] for tone in tones]


def wild(rng: random.Random) -> list[float]:
    """Draw stretches, sizes and thresholds of a surface that nobody named."""
    return [
        math.exp(rng.uniform(-3.0, 2.5)),
        rng.choice((0.0, 0.05, 0.2)),
        math.exp(rng.uniform(-1.2, 1.2)),
        math.exp(rng.uniform(-2.0, 0.5)),
        math.exp(rng.uniform(-2.5, 2.5)),
        rng.choice((0.0, 0.0, 0.5, 1.0)),
        math.exp(rng.uniform(-1.0, 0.8)),
        rng.uniform(0.02, 0.3),
    ]


def bark(rng: random.Random, kind: str, snow: float) -> Look:
    """Draw the look of a log."""
    return {
        "kind": kind,
        "tones": varied(rng.choice(TONES[kind]), rng),
        "seed": rng.uniform(0.0, 80.0),
        "scale": math.exp(rng.gauss(0.0, 0.3)),
        "relief": rng.uniform(0.3, 1.0),
        "moss": rng.uniform(0.2, 1.0) if rng.random() < 0.2 else 0.0,
        "moss_tones": rng.choice(MOSS),
        "lichen": rng.uniform(0.2, 1.0) if rng.random() < 0.35 else 0.0,
        "lichen_tone": rng.choice(([0.45, 0.48, 0.42], [0.3, 0.36, 0.25], [0.5, 0.45, 0.12])),
        "snow": snow * rng.uniform(0.3, 1.0),
        "wet": rng.uniform(0.3, 1.0) if rng.random() < 0.25 else 0.0,
        "end_tones": varied(rng.choice(ENDS), rng, 0.15),
        "rings": rng.uniform(12.0, 40.0),
        "heart": rng.uniform(0.0, 0.9),
        "dirt": rng.uniform(0.1, 0.8),
        "bast": rng.uniform(0.0, 1.0),
        "wild": wild(rng),
    }


def soil(rng: random.Random) -> Look:
    """Draw one kind of ground."""
    kinds = {"earth": 3.0, "grassy": 1.8, "leaves": 1.5, "stones": 1.0, "needles": 1.5, "wild": 1.5}
    kind = rng.choices(list(kinds), list(kinds.values()))[0]
    return {
        "kind": kind,
        "tones": varied(rng.choice(SOILS[kind]), rng),
        "scale": math.exp(rng.gauss(0.0, 0.4)),
        "warp": rng.choice((0.0, 0.0, 0.5, 1.5)),
        "wild": wild(rng),
    }


def ground(rng: random.Random, snow: float) -> Look:
    """Draw the look of the ground."""
    return {
        "first": soil(rng),
        "second": soil(rng),
        "seed": rng.uniform(0.0, 60.0),
        "patch_scale": rng.uniform(0.4, 2.5),
        "relief": rng.uniform(0.3, 1.0),
        "wet": rng.choice((0.0, 0.0, 0.5, 0.9)),
        "snow": snow,
        "snow_scale": rng.uniform(0.5, 2.5),
        "puddles": rng.random() < 0.12,
    }


def light(rng: random.Random, eye: Sequence[float], target: Sequence[float]) -> Look:
    """Draw sun and sky, or dusk with work lights at the camera."""
    kind = rng.choices(("sunny", "low", "overcast", "photo", "dusk"), (3.0, 1.6, 1.6, 1.6, 0.7))[0]
    up = {
        "sunny": rng.uniform(18, 62),
        "low": rng.uniform(3, 18),
        "overcast": 60.0,
        "photo": rng.uniform(8, 60),
        "dusk": rng.uniform(2, 6),
    }[kind]
    warm = max(0.0, 1.0 - up / 30.0) * rng.uniform(0.4, 1.0)
    look: Look = {
        "sky": "nishita",
        "sky_strength": rng.uniform(0.12, 0.4),
        "elevation_rad": math.radians(up),
        "azimuth_rad": rng.uniform(-math.pi, math.pi),
        "dust": rng.uniform(0.5, 4.0),
        "tone": [0.8, 0.86, 0.95],
        "sun_strength": rng.uniform(2.0, 6.0),
        "sun_angle_rad": math.radians(rng.choice((0.5, 0.5, 2.0))),
        "sun_tone": [1.0, 1.0 - 0.3 * warm, 1.0 - 0.6 * warm],
        "lamps": [],
    }
    if kind == "overcast":
        grey = rng.uniform(0.5, 1.0)
        look |= {
            "sky": "flat",
            "tone": [grey, 1.03 * grey, grey * rng.uniform(1.0, 1.2)],
            "sky_strength": 1.0,
            "sun_strength": rng.choice((0.0, 0.5, 1.2)),
            "sun_angle_rad": 0.6,
        }
    elif kind == "photo":
        look |= {
            "sky": rng.choice(("forest", "sunrise", "sunset", "courtyard", "city")),
            "sky_strength": 1.0,
            "sun_strength": rng.choice((0.0, 1.5, 4.0)),
        }
    elif kind == "dusk":
        look |= {"sky": "flat", "tone": [0.3, 0.4, 0.7], "sky_strength": rng.uniform(0.02, 0.25), "sun_strength": 0.0}
        for _ in range(rng.choice((1, 2, 2, 3))):
            at = [eye[k] + rng.uniform(-1.2, 1.2) for k in range(2)] + [eye[2] + rng.uniform(0.1, 1.2)]
            there = [target[k] + rng.gauss(0.0, 0.8) for k in range(2)] + [target[2]]
            tone = rng.choice(([1.0, 0.95, 0.85], [0.85, 0.92, 1.0], [1.0, 0.8, 0.55]))
            look["lamps"].append({"watts": rng.uniform(400, 1500), "at_m": at, "target_m": there, "tone": tone})
    return {**look, "own": _own_sky(rng, kind, look, warm)}


def _own_sky(rng: random.Random, kind: str, look: Look, warm: float) -> Look:
    """Describe the same light for the tracer, which knows only its own skies: two tones, a glow, perhaps a forest's
    edge."""
    bright = {"sunny": 0.35, "low": 0.25, "overcast": 1.0, "photo": 0.7, "dusk": 0.05}[kind] * math.exp(
        rng.gauss(0, 0.3)
    )
    blue = rng.uniform(0.2, 1.0) if kind in ("sunny", "low", "dusk") else rng.uniform(0.0, 0.25)
    sun = (look["sun_strength"] if kind != "photo" else rng.choice((0.0, 1.5, 4.0))) / math.pi
    deep = rng.random() < 0.55
    return {
        "zenith": [bright * (1.0 - 0.65 * blue), bright * (1.0 - 0.4 * blue), bright],
        "horizon": [bright * (1.2 + 1.2 * warm), bright * (1.2 + 0.4 * warm), bright * (1.2 - 0.3 * warm)],
        "below": [0.3 * bright, 0.27 * bright, 0.22 * bright],
        "sun_tone": [sun * c for c in look["sun_tone"]],
        "sun_edge": 1.7 * look["sun_angle_rad"],
        "glow": rng.uniform(0.0, 0.5) * (kind in ("sunny", "low")),
        "backdrop": float(deep),
        "backdrop_height": rng.uniform(0.1, 0.7),
        "backdrop_seed": rng.uniform(0.0, 50.0),
        "trees": [bright * c for c in rng.choice(([0.1, 0.15, 0.06], [0.06, 0.09, 0.05], [0.2, 0.16, 0.08]))],
    }


def crowds(
    rng: random.Random,
    middle: Sequence[float],
    clear: list[list[float]],
    near: list[list[float]],
    snow: float,
) -> list[Look]:
    """Draw what grows and lies around: ``clear`` (x, y, radius) is kept free of big things, ``near`` of stems."""
    crowd_looks: list[Look] = []

    def add(kind: str, count: int, size_m: float, thick_m: float, tones: Tones, **more: Any) -> None:
        crowd_looks.append(
            {
                "kind": kind,
                "count": count,
                "size_m": size_m,
                "thick_m": thick_m,
                "tones": varied(tones, rng),
                "shapes": 5,
                "parts": 14,
                "lean": 0.5,
                "scales": [0.5, 1.4],
                "lifts_m": [-0.005, 0.005],
                "clumps": False,
                "middle_m": list(middle[:2]),
                "reach_m": rng.uniform(3.5, 7.0),
                "keep_clear_m": [],
                **more,
            }
        )

    green = 0.35 if snow else 1.0
    if rng.random() < 0.75 * green:
        for _ in range(rng.choice((1, 1, 2))):
            add(
                "grass",
                int(math.exp(rng.uniform(4.5, 7.6))),
                rng.uniform(0.08, 0.45),
                rng.uniform(0.002, 0.006),
                rng.choice(GREENS),
                parts=rng.randint(8, 22),
                lean=rng.uniform(0.2, 1.0),
                clumps=rng.random() < 0.7,
            )
    if rng.random() < 0.25 * green:
        add("fern", rng.randint(5, 60), rng.uniform(0.25, 0.6), 0.0, rng.choice(GREENS), parts=9, clumps=True)
    if rng.random() < 0.35:
        add(
            "leaves",
            rng.randint(20, 90),
            rng.uniform(0.6, 1.2),
            rng.uniform(0.02, 0.05),
            rng.choice(SOILS["leaves"]),
            parts=60,
            scales=[0.8, 1.2],
        )
    if rng.random() < 0.75:
        add(
            "twigs",
            int(math.exp(rng.uniform(2.5, 5.2))),
            rng.uniform(0.4, 1.8),
            rng.uniform(0.004, 0.018),
            rng.choice(WOODS),
            parts=rng.randint(0, 5),
            lifts_m=[0.0, 0.06],
            shapes=7,
        )
    if rng.random() < 0.3:
        add(
            "slash",
            rng.randint(4, 40),
            rng.uniform(0.8, 2.2),
            rng.uniform(0.008, 0.018),
            rng.choice(WOODS),
            parts=rng.randint(4, 12),
            needle_tones=rng.choice(GREENS),
            lifts_m=[0.0, 0.15],
            scales=[0.7, 1.2],
        )
    if rng.random() < 0.4:
        tones = rng.choice(SOILS["stones"])
        add(
            "stones",
            rng.randint(3, 60),
            math.exp(rng.uniform(-3.6, -1.3)),
            0.0,
            tones,
            scales=[0.4, 1.3],
            lifts_m=[-0.05, 0.0],
            keep_clear_m=near,
        )
    for kind, share in (("stumps", 0.3), ("trees", 0.4)):
        if rng.random() < share:
            look = bark(rng, rng.choices(BARKS, BARK_SHARES)[0], snow)
            high, reach = (rng.uniform(0.1, 0.4), 5.0) if kind == "stumps" else (9.0, 12.0)
            add(
                kind,
                rng.randint(1, 6) if kind == "stumps" else rng.randint(2, 22),
                high,
                rng.uniform(0.07, 0.2),
                look["tones"],
                bark=look,
                shapes=3,
                scales=[1.0, 1.0],
                reach_m=reach,
                keep_clear_m=clear,
            )
    return crowd_looks
