"""Names that stand in a profile and in the DBC must be the same; no floor below can check both."""

from __future__ import annotations

import pytest

from can_dbc import codec
from machine.load import load_profile, shipped_profiles


@pytest.mark.parametrize("name", shipped_profiles())
def test_every_encoder_and_valve_of_a_profile_is_in_the_dbc(name: str) -> None:
    crane = codec.load("crane")
    commands = {s.name for m in ("ValveCmdA", "ValveCmdB") for s in crane.message(m).signals}
    for joint in load_profile(name).joints.values():
        assert joint.valve.signal in commands
        if joint.encoder is not None:
            message = crane.message(joint.encoder.message)
            assert message.key == 0x180 + joint.encoder.node, "TPDO1 of the encoder's node"
            assert "Position" in message.index
