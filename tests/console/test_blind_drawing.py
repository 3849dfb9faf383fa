"""Drawing of a crane whose rotator has no encoder."""

from __future__ import annotations

import json
from math import nan

import pytest

from can_dbc.messages.crane import StateReport
from can_dbc.messages.datagrams import encode
from console.state import CraneState
from machine.loading.profile_file import load_profile, profile_hash
from machine.status.modes import Mode

FORWARDER, PALMS = load_profile("aoro_fc8"), load_profile("palms_471")
MEASURED = (0.5, 0.9, -2.0, 0.5, nan)


def drawn(profile, told: float) -> dict:
    crane_state = CraneState(profile)
    report = StateReport(
        1,
        profile_hash(profile),
        5_000_000_000,
        Mode.ACTIVE,
        0,
        0,
        1,
        0,
        0,
        0,
        MEASURED,
        (0.0,) * 5,
        (*MEASURED[:4], told),
        nan,
        nan,
        nan,
        0,
        0,
        0,
        0,
    )
    assert crane_state.on_report(encode(report), 0)
    state = crane_state.state(0)
    json.dumps(state, allow_nan=False)
    return state


def test_a_rotator_without_encoder_is_drawn_at_its_reference():
    across = drawn(FORWARDER, nan)["jaws"]["yaw_rad"]
    assert drawn(FORWARDER, 0.3)["jaws"]["yaw_rad"] == pytest.approx(across + 0.3)
    assert drawn(FORWARDER, 0.3)["position"][4] is None and drawn(FORWARDER, 0.3)["opening_pct"] is None
    assert drawn(PALMS, 0.3)["points"] is None, "a lost encoder is not guessed"
