"""The numbers of a reason in words, its one text, its identity in the journal; and the names of stale inputs."""

from __future__ import annotations

import math

import pytest

from machine.joints import ARTICULATION, JOINTS, Joint
from machine.status.evidence import EVIDENCE, quantities
from machine.status.explanation import describe, explain, message_id, part_of, priority, sentence_of
from machine.status.faults import FAULTS
from machine.status.reasons import DetailKind, Reaction, Reason, pack
from machine.status.stale_inputs import CARRIER_BIT, CRANE_INPUT_BITS, ENCODER_BIT, STALE_INPUT_NAMES
from tests.codes import numbers_in


def numbers_text(reason: Reason, detail: int, numbers: tuple[float | None, ...]) -> str:
    return explain(pack(reason, detail), numbers).measured


@pytest.mark.parametrize(
    ("detail", "shown"),
    [
        (Joint.LIFT, ("90.00°", "80.00°")),
        (Joint.EXT, ("1.571 m", "1.396 m")),
    ],
)
def test_the_unit_of_a_joint_is_degrees_or_metres(detail: int, shown: tuple[str, ...]) -> None:
    text = numbers_text(Reason.POSITION_OUTSIDE, detail, (math.pi / 2, math.radians(80), math.nan))
    assert all(value in text for value in shown)


def test_unknown_numbers_are_left_out() -> None:
    assert numbers_in(numbers_text(Reason.GUARD_LOST, 0, (math.nan, 50.0, None))) == [50.0]
    assert numbers_text(Reason.GUARD_LOST, 0, ()) == ""
    assert numbers_text(Reason.OPERATOR_STOP, 0, (1.0, 2.0, 3.0)) == ""


def test_bits_and_reasons_are_readable() -> None:
    assert "0021h" in numbers_text(Reason.PLC_FAULT, 0, (0x21, math.nan, math.nan))
    text = numbers_text(Reason.SETPOINTS_REFUSED, 0, (7.0, math.nan, float(pack(Reason.JOINT_SPEED, 2))))
    assert numbers_in(text) == [7] and Reason.JOINT_SPEED.name in text


def test_values_stay_in_si_units_for_programs() -> None:
    first, second, third = quantities(Reason.JOINT_RUNAWAY, Joint.EXT, (0.3, 0.5, 0.0))
    assert (first.value, first.unit, second.unit, third.name) == (0.3, "m/s", "m/s", "commanded")


def test_the_one_text_has_sentence_numbers_advice_and_code() -> None:
    reason = pack(Reason.ENCODER_LOST, Joint.LIFT)
    sentence, advice = sentence_of(Reason.ENCODER_LOST, Joint.LIFT), FAULTS[Reason.ENCODER_LOST].advice
    numbers = (20.04, 15.0, 0.0)
    measured = numbers_text(Reason.ENCODER_LOST, Joint.LIFT, numbers)
    assert "lift" in sentence and numbers_in(measured) == [20.0, 15.0, 0]
    assert measured == ", ".join(quantity.text for quantity in quantities(Reason.ENCODER_LOST, Joint.LIFT, numbers))
    assert describe(reason, numbers=numbers) == f"{sentence} ({measured}). {advice} [ENCODER_LOST]"
    assert describe(Reason.NONE) == f"{sentence_of(Reason.NONE)}. {FAULTS[Reason.NONE].advice}"
    found = explain(reason, numbers)
    assert found.text == describe(reason, numbers=numbers)
    assert (found.code, found.sentence) == ("ENCODER_LOST", f"{sentence}.")


@pytest.mark.parametrize(
    ("reason", "detail", "part"),
    [
        (Reason.ENCODER_LOST, Joint.TILT, "tilt"),
        (Reason.POSITION_OUTSIDE, ARTICULATION, "articulation"),
        (Reason.SAFETY_NODE_LOST, 0x10, part_of(DetailKind.NODE, 0x10)),
        (Reason.FOREIGN_CONTROLLER, 1, part_of(DetailKind.BUS, 1)),
        (Reason.ARM_STUCK, 1, part_of(DetailKind.ARM, 1)),
    ],
)
def test_a_description_names_the_part(reason: Reason, detail: int, part: str) -> None:
    assert part.lower() in describe(pack(reason, detail)).lower()


def test_every_text_is_made_for_every_reason_and_detail() -> None:
    for reason in FAULTS:
        for detail in (0, 3, 5, 17, 255):
            text = describe(pack(reason, detail), numbers=(1.0, math.nan, math.inf))
            assert "{" not in text and text.endswith(f"[{reason.name}]") is (reason is not Reason.NONE)


def test_only_a_reason_about_a_joint_has_the_unit_of_a_joint() -> None:
    about_joints = {reason for reason, fault in FAULTS.items() if fault.about is DetailKind.JOINT}
    for reason, measured in EVIDENCE.items():
        if "joint" in (measured.unit.partition("/")[0], measured.other_unit.partition("/")[0]):
            assert reason in about_joints, reason
        assert FAULTS[reason].reaction >= Reaction.DEGRADE, f"nobody takes the evidence of {reason.name}"


def test_the_journal_knows_a_reason_by_a_number_that_never_changes() -> None:
    numbers = {message_id(reason) for reason in Reason}
    assert len(numbers) == len(Reason)
    assert message_id(Reason.ENCODER_LOST) == "627996cecfa7575e9754666b55c67cfe"
    assert (priority(Reason.ENCODER_LOST), priority(Reason.LEASE_LOST), priority(Reason.OPERATOR_STOP)) == (3, 4, 5)


def test_every_input_has_a_bit_of_its_own_and_a_name() -> None:
    bits = [*CRANE_INPUT_BITS.values(), CARRIER_BIT, *(ENCODER_BIT + j for j in (*JOINTS, ARTICULATION))]
    assert len(set(bits)) == len(bits) and all(0 <= bit < 16 for bit in bits)
    assert set(STALE_INPUT_NAMES) == set(bits)
