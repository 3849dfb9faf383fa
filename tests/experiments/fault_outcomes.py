"""Outcomes for tests of the fault campaign."""

from __future__ import annotations

from typing import Any

from experiments.faults.trial import judge


def outcome(**changed: Any) -> dict[str, Any]:
    """Of an injection that keeps its promise, with some fields changed."""
    row = {
        "seed": "s",
        "at_ms": 1.0,
        "orders": ["encoder-stuck/lift"],
        "expected": "R1",
        "bound_ms": 20.0,
        "seen_ms": 0.0,
        "tip_limit_m": None,
        "reached": {"R1": 15.0},
        "reason": "ENCODER_LOST",
        "refused_ms": None,
        "neutral_ms": 80.0,
        "valves_ms": 70.0,
        "travel_m": 0.02,
        "astray_m": 0.02,
        "standing": True,
        "timeline": [[1.0, "STOP"]],
    } | changed
    return row | judge(row)
