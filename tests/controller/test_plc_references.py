"""The joint references on crane0: only for a PLC that closes the joint loops, and only within the frames' range."""

from __future__ import annotations

import math
from typing import Any

import msgspec
import pytest

from can_dbc.dbc.codec import load
from can_dbc.frame import RawFrame
from controller.crane.outputs import CraneWriter
from machine.loading.profile_file import load_profile
from machine.profile import Plc, Profile
from runtime.errors import ConfigError
from tests.codes import coded

DATABASE = load("crane")
NAMES = ("JointRefA", "JointRefB", "JointRefC")
HERE, SPEEDS = (0.1, 0.7, -1.6, 0.5, 3.0), (0.35, -0.15, 0.28, 0.25, -1.0)


def profile(role: str | None) -> Profile:
    return msgspec.structs.replace(load_profile("palms_471"), plc=Plc(role) if role else None)  # type: ignore[arg-type]


def decoded(frames: list[RawFrame]) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for (key, data), name in zip(frames, NAMES, strict=True):
        codec = DATABASE.message(name)
        assert key == codec.key
        found |= dict(zip((s.name for s in codec.signals), codec.receive(data), strict=True))
    return found


@pytest.mark.parametrize("role", [None, "valves"])
def test_only_a_plc_with_role_references_gets_them(role: str | None) -> None:
    frames: list[RawFrame] = []
    CraneWriter(DATABASE, profile(role)).references(HERE, SPEEDS, True, frames)
    assert not frames


def test_references_carry_position_and_commanded_velocity() -> None:
    frames: list[RawFrame] = []
    CraneWriter(DATABASE, profile("references")).references(HERE, SPEEDS, True, frames)
    found = decoded(frames)
    for name, position, speed in zip(("Slew", "Lift", "Tilt", "Ext", "Rot"), HERE, SPEEDS, strict=True):
        assert found[name] == pytest.approx(position, abs=1.01e-4)
        assert found[f"{name}Rate"] == pytest.approx(speed, abs=5.01e-4)


def test_references_at_rest_unknown_or_out_of_range_are_not_available() -> None:
    writer, frames = CraneWriter(DATABASE, profile("references")), list[RawFrame]()
    writer.references(HERE, SPEEDS, False, frames)
    assert decoded(frames)["Slew"] is decoded(frames)["RotRate"] is None
    frames.clear()
    strange = (math.nan, 0.7, 1e9, 0.5, -math.inf)
    writer.references(strange, (0.0, 2.0, 0.0, 0.1, 0.0), True, frames)
    found = decoded(frames)
    assert [found[n] for n in ("Slew", "Lift", "Tilt", "Rot")] == [None] * 4
    assert found["Ext"] == pytest.approx(0.5, abs=1e-4) and found["ExtRate"] == pytest.approx(0.1, abs=1e-3)


def test_joint_range_beyond_the_frames_is_refused_at_start() -> None:
    wide = profile("references")
    slew = msgspec.structs.replace(wide.joints["slew"], upper=3.5)
    with pytest.raises(ConfigError, check=coded("config.reference-range")):
        CraneWriter(DATABASE, msgspec.structs.replace(wide, joints=wide.joints | {"slew": slew}))
