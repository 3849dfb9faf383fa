"""State reports for tests."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from can_dbc.messages.crane import StateReport
from machine.loading.profile_file import load_profile, profile_hash
from machine.status.modes import Mode
from machine.status.reasons import Reason, pack

REPORT = StateReport(
    sequence=7,
    profile_hash=profile_hash(load_profile("palms_471")),
    stamp_ns=5_000_000_000,
    mode=Mode.ACTIVE,
    grapple_state=4,
    reason=pack(Reason.JOINT_STUCK, 2),
    setpoint_sequence=3,
    refusal=0,
    refused=4,
    stale_mask=1 << 4 | 1,
    position=(0.1, 0.2, -1.0, 0.5, 0.3),
    velocity=(0.0,) * 5,
    reference=(0.2, 0.2, -1.0, 0.5, 0.3),
    opening_pct=60.0,
    clamp_bar=120.0,
    load_kg=200.0,
    tick_ns=600_000,
    late_ns=80_000,
    missed_ticks=2,
    frames_received=1000,
)
STANDING = replace(
    REPORT,
    sequence=1,
    grapple_state=0,
    reason=0,
    setpoint_sequence=1,
    refused=0,
    stale_mask=0,
    opening_pct=50.0,
    clamp_bar=12.0,
    load_kg=0.0,
    tick_ns=0,
    late_ns=0,
    missed_ticks=0,
    frames_received=0,
)
"""Nothing is wrong, and nothing is held."""


def at(q: tuple[float, ...], stamp_ns: int, mode: int = Mode.ACTIVE, **changes: Any) -> StateReport:
    """Of a crane that stands where it should: at ``q``."""
    return replace(STANDING, **{"position": q, "reference": q, "stamp_ns": stamp_ns, "mode": mode} | changes)
