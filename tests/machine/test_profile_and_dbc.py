"""The names in profiles and in the DBC agree."""

from __future__ import annotations

import pytest

from can_dbc.dbc import codec
from machine.loading.checks import IMU_MESSAGE
from machine.loading.profile_file import load_profile, shipped_profiles
from machine.loading.ranges import _RANGES
from machine.profile import Carrier


@pytest.mark.parametrize("name", shipped_profiles())
def test_every_encoder_and_valve_of_a_profile_is_in_the_dbc(name: str) -> None:
    crane = codec.load("crane")
    commands = {s.name for m in ("ValveCmdA", "ValveCmdB") for s in crane.message(m).signals}
    profile = load_profile(name)
    encoders = [joint.encoder for joint in profile.joints.values()]
    if profile.carrier is not None:
        encoders.append(profile.carrier.articulation_encoder)
    assert all(joint.valve.signal in commands for joint in profile.joints.values())
    for encoder in filter(None, encoders):
        message = crane.message(encoder.message)
        assert message.key == 0x180 + encoder.node, "TPDO1 of the encoder's node"
        assert "Position" in message.index


def test_the_only_message_of_a_sensor_on_the_grapple_is_in_the_dbc() -> None:
    message = codec.load("crane").message(IMU_MESSAGE)
    assert message.key == 0x180 + 0x23, "TPDO1 of node 23h"


@pytest.mark.parametrize(
    ("limit", "signal"), [("articulation_rate_limit_rad_s", "ArticRate"), ("speed_limit_m_s", "Speed")]
)
def test_every_carrier_limit_that_a_profile_may_have_fits_its_command(limit: str, signal: str) -> None:
    """A command out of the DBC's range is refused by the codec, and would end the tick."""
    message = codec.load("machine").message("VehCmd")
    values = [0.0] * len(message.signals)
    for side in (-1.0, 1.0):
        values[message.index[signal]] = side * _RANGES[Carrier][limit][1]
        assert message.encode(*values)
