"""The mask of stale inputs: every bit belongs to one input and has a name."""

from machine.joints import ARTICULATION, JOINTS
from machine.status.stale_inputs import CARRIER_BIT, CRANE_INPUT_BITS, ENCODER_BIT, STALE_INPUT_NAMES


def test_every_input_has_a_bit_of_its_own_and_a_name():
    bits = [*CRANE_INPUT_BITS.values(), CARRIER_BIT, *(ENCODER_BIT + j for j in (*JOINTS, ARTICULATION))]
    assert len(set(bits)) == len(bits) and all(0 <= bit < 16 for bit in bits)
    assert set(STALE_INPUT_NAMES) == set(bits)
