"""Looks as the rows of numbers that the tracer's kernel reads (``struct Look`` in ``kernel/surfaces.h``)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

import numpy as np

BARK_KINDS: Final = ("scaly", "plated", "furrowed", "birch", "smooth", "peeled", "wild")
KINDS: Final = (*BARK_KINDS, "earth", "leaves", "stones", "needles", "leaf", "paint", "ground")
FLOATS: Final = 102


def packed_look(look: Mapping[str, Any]) -> np.ndarray:
    """A look as FLOATS float32."""
    what = look["what"]
    kind = look["kind"] if what in ("bark", "end") else what
    row = [
        _number(kind), look.get("seed", 0.0), look.get("scale", 1.0), look.get("relief", 0.0), look.get("moss", 0.0),
        look.get("lichen", 0.0), look.get("snow", 0.0), look.get("wet", 0.0), look.get("rings", 20.0),
        look.get("heart", 0.0), look.get("dirt", 0.0), look.get("radius_m", 0.1), look.get("bast", 0.0),
        look.get("patch_scale", 1.0), look.get("snow_scale", 1.0), float(look.get("puddles", False)),
        *look.get("wild", [1.0] * 8), *_tones(look.get("tones", []), 4), *_tones(look.get("end_tones", []), 3),
        *_tones(look.get("moss_tones", []), 2), *look.get("lichen_tone", [0.4, 0.4, 0.4]),
    ]  # fmt: skip
    for name in ("first", "second"):
        own = look.get(name, {"kind": "earth", "tones": []})
        row += [_number(own["kind"]), own.get("scale", 1.0), own.get("warp", 0.0), 0.0, *_tones(own["tones"], 4)]
        row += [float(max(2, min(4, len(own["tones"])))), *own.get("wild", [1.0] * 8)[:7]]
    return np.array(row, np.float32)


def _number(kind: str) -> float:
    known = {"photo": "wild", "grassy": "earth"}.get(kind, kind)
    return float(KINDS.index(known))


def _tones(tones: Any, count: int) -> list[float]:
    """Exactly ``count`` colours; the last is repeated."""
    rows = list(tones)[:count] or [[0.3, 0.3, 0.3]]
    rows += [rows[-1]] * (count - len(rows))
    return [float(c) for row in rows for c in row]
