"""The guard's parts before anything has happened, at values between -1 and 1, and with numbers that no machine has."""

from __future__ import annotations

from pathlib import Path

import pytest

from can_dbc.frame import Frame
from controller.guard import stream
from controller.guard.__main__ import profile_path
from controller.guard.envelope import Envelope, Kinematics, _axis, read_envelope
from controller.guard.joints import CommandedAxis, MeasuredJoint, MotionWatch, RateCredit
from controller.guard.layout import Field, GuardConfigError, Layout, read_layouts
from controller.guard.reach import Reach
from controller.guard.stream import Punctuality, SentMessage, WatchedMessage
from controller.guard.verdicts import DRIVE_AXIS, FINE, Verdict
from tests.codes import coded
from tests.controller.bench import MS, count_until
from tests.controller.guard_parts import AXIS, ENCODER, PERCENT, resting, spool
from tests.controller.guard_traffic import Traffic
from tests.controller.mach0_bench import LIMITS, Mach0

IDS = bytes(range(16))
PROTECTED = Layout(0x200, 4, {"Counter": Field(8, 4, False, 1.0, 0.0, 15.0)}, IDS, 50 * MS)


def remainder(value: int, polynomial: int) -> int:
    """Of a division of polynomials over GF(2)."""
    while value.bit_length() >= polynomial.bit_length():
        value ^= polynomial << (value.bit_length() - polynomial.bit_length())
    return value


def test_the_table_of_the_checksum_is_the_remainder_of_every_byte() -> None:
    assert stream._crc_table() == bytes(remainder(i << 8, 0x12F) for i in range(256))


# -- before anything has happened --------------------------------------------------------------------------------------


def test_parts_begin_at_zero() -> None:
    command, joint, message = CommandedAxis(AXIS, PERCENT), MeasuredJoint(AXIS, ENCODER), WatchedMessage(PROTECTED)
    assert (command.percent, command.opening, command.speed, joint.position) == (0.0, 0.0, 0.0, 0.0)
    assert (message.word, message.stamp_ns, message.steps, message.counter) == (0, 0, 0, -1)


def test_the_first_command_grows_from_zero_on_either_side() -> None:
    for percent in (7.05, -7.05):
        assert RateCredit(100.0).spent(percent, 0.0)


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_every_side_of_a_spool_was_shut_before_the_start(side: float) -> None:
    for now_ns, found in ((50 * MS, FINE), (50 * MS + 1, (Verdict.SPOOL, 3))):
        assert MotionWatch(3, PERCENT, 12.0, 50 * MS).check(0.0, spool(side * 50.0), now_ns, 0.005) == found


def test_the_silence_before_the_first_command_begins_at_zero() -> None:
    assert Punctuality(5 * MS).late(50 * MS, 1, 50 * MS)
    assert not Punctuality(5 * MS).late(50 * MS + 1, 1, 50 * MS)


def test_questions_have_yes_or_no_for_an_answer() -> None:
    message = WatchedMessage(PROTECTED)
    for counter in (0, 2):  # one may be missing before it is trusted, too
        data = bytes((0, counter, 0, 0))
        crc = stream.checksum(data, IDS[counter])
        effect = message.receive(Frame(counter * MS, 0x200, bytes((crc,)) + data[1:]), counter * MS)
    assert effect is stream.FrameEffect.NEW_WORD and message.old(3 * MS) is False
    sent = SentMessage(PROTECTED, 10 * MS)
    assert sent.due(MS, False) is True and sent.due(2 * MS, False) is False


# -- small values ------------------------------------------------------------------------------------------------------


def test_small_commands_that_stay_cost_nothing_and_that_turn_cost_their_size() -> None:
    credit = RateCredit(100.0)
    assert not any(credit.spent(0.9, 0.0) for _ in range(100))
    credit = RateCredit(100.0)
    assert [credit.spent(0.69 * side, 0.0) for side in (1.0, -1.0) * 6].index(True) == 10


def opened(percent: float, deadbands: tuple[float, float]) -> CommandedAxis:
    command = CommandedAxis(AXIS._replace(deadbands_pct=deadbands), PERCENT)
    command.receive(round(percent * 10.0) & 0xFFFF, 1.0)
    return command


def test_a_small_command_has_the_dead_band_and_the_speed_of_its_side() -> None:
    assert opened(0.5, (0.2, 0.6)).opening == 0.0 and opened(-0.5, (0.2, 0.6)).opening < 0.0
    plus, minus = opened(0.5, (0.0, 0.0)), opened(-0.5, (0.0, 0.0))
    assert (plus.opening, minus.opening) == (pytest.approx(0.5), pytest.approx(-0.5))
    assert (plus.speed, minus.speed) == (pytest.approx(-0.005 * 0.4), pytest.approx(0.005 * 0.2))


def test_a_spool_that_is_hardly_open_has_a_side() -> None:
    for commanded, seen in ((-1.0, 0.5), (1.0, -0.5)):
        watch = MotionWatch(3, PERCENT, 0.2, 50 * MS)
        watch.check(commanded, spool(0.0), 1000 * MS, 0.005)
        assert watch.check(0.0, spool(seen), 1001 * MS, 0.005) == (Verdict.SPOOL, 3)


def test_a_turn_may_have_an_odd_number_of_counts() -> None:
    joint = MeasuredJoint(AXIS._replace(total_counts=5, zero_counts=0, unit=1.0), ENCODER)
    seen = []
    for count in range(5):
        joint.receive(Frame(count * MS, 0x181, bytes((count, 0, count, 0))), count * MS)
        seen.append(joint.position)
    assert seen == [0.0, 1.0, 2.0, -2.0, -1.0]


def test_a_range_includes_the_rounding_at_its_ends() -> None:
    assert Field(0, 8, False, 1.0, 1e-9, 5.0).inside(0) and Field(0, 8, False, 1.0, -5.0, -1e-9).inside(0)


# -- exactly at a limit ------------------------------------------------------------------------------------------------


def test_a_joint_exactly_at_its_limit_has_not_moved() -> None:
    watch, joint = resting()
    joint.position = 0.02
    assert [watch.check(0.0, None, 1505 * MS + k, 0.0) for k in range(5)] == [FINE] * 5


def test_half_a_second_after_its_command_a_joint_still_settles() -> None:
    watch, joint = resting()
    watch.check(5.0, None, 2000 * MS, 0.0)
    assert watch.check(0.0, None, 2000 * MS, 0.0) is FINE
    joint.position = 0.6
    assert [watch.check(0.0, None, 2500 * MS + k, 0.0) for k in range(5)] == [FINE] * 5


def test_after_a_finding_three_more_steps_are_needed() -> None:
    watch, joint = resting()
    for where in (0.5, 1.0):
        joint.position = where
        found = [watch.check(0.0, None, 1505 * MS + k, 0.0) for k in range(3)]
        assert found == [FINE, FINE, (Verdict.MOVING, 1)]


def test_a_joint_without_an_encoder_has_no_motion() -> None:
    assert MotionWatch(1, PERCENT, 12.0, 50 * MS).check(0.0, None, 10**9, 0.005) is FINE


def test_exactly_40_ms_late_is_not_too_late() -> None:
    for more_ns, late in ((0, False), (100, True)):
        punctual = Punctuality(10 * MS)
        assert not punctual.late(1000 * MS, 1, 500 * MS)
        assert punctual.late(1000 * MS + 51_020_408 + more_ns, 1, 500 * MS) is late


@pytest.mark.parametrize("ticks", [0, 1])
def test_a_supply_that_goes_off_is_told_at_once(ticks: int) -> None:
    traffic = Traffic().good()
    traffic.tick(ticks)
    traffic.dropped.add("ValveCmdB")
    count_until(traffic.tick, lambda: not traffic.guard.enabled)
    steps = count_until(traffic.tick, lambda: traffic.pilot[-1]["Supply"] == 0)
    assert steps == 60


def test_the_carrier_s_speed_grows_at_its_rate_to_the_percent() -> None:
    # 100 % x 3 x 4 m/s^2 of 10 m/s are 120 %/s; after 0.77 m/s 0.1 % of the first 7.8 % is left, and 6 % come in 50 ms
    limits = LIMITS._replace(speed_limit_m_s=10.0, drive_acceleration_m_s2=4.0)
    for speed_m_s, found in ((1.375, FINE), (1.385, (Verdict.RATE, DRIVE_AXIS))):
        mach0 = Mach0(limits)
        assert mach0.judged("VehCmd", 0.0, Speed=0.77) == FINE
        assert mach0.judged("VehCmd", 0.05, Speed=speed_m_s) == found


# -- what no machine has -----------------------------------------------------------------------------------------------

VALVE = {
    "signal": "Tilt",
    "deadband_plus_pct": 12.0,
    "deadband_minus_pct": 7.0,
    "full_speed_plus": 0.5,
    "full_speed_minus": 0.25,
    "delay_s": 0.2,
    "lag_s": 0.0,
    "sign": 1,
}
AXIS_LIMITS = {"acceleration_limit": 0.5, "lower": -1.0, "upper": 2.0, "speed_limit": 0.2}


@pytest.mark.parametrize(
    "changed", [{}, {"deadband_plus_pct": 0.0}, {"deadband_minus_pct": 0.5}, {"deadband_plus_pct": 49.0}]
)
def test_any_dead_band_of_a_valve_is_taken(changed: dict) -> None:
    axis = _axis(2, {"valve": VALVE | changed}, AXIS_LIMITS)
    assert axis.closing_ns == 300_000_000


@pytest.mark.parametrize(
    "changed",
    [
        {"deadband_plus_pct": -0.5},
        {"deadband_plus_pct": 60.0},
        {"delay_s": 2.0},
        {"full_speed_minus": 0.0},
        {"full_speed_plus": -0.5},
    ],
)
def test_a_valve_that_no_machine_has_is_refused(changed: dict) -> None:
    with pytest.raises(ValueError):
        _axis(2, {"valve": VALVE | changed}, AXIS_LIMITS)


def test_a_carrier_that_is_faster_than_its_envelope_is_refused(tmp_path: Path) -> None:
    text = profile_path("aoro_fc8").read_text()
    assert "speed_limit_m_s = 1.0" in text
    path = tmp_path / "fast.toml"
    path.write_text(text)
    assert read_envelope(path).carrier is not None
    path.write_text(text.replace("speed_limit_m_s = 1.0", "speed_limit_m_s = 1.1"))
    with pytest.raises(GuardConfigError, check=coded("guard.profile-exceeds-envelope")):
        read_envelope(path)


def test_a_place_needs_all_of_its_numbers() -> None:
    arm = Kinematics(1.0, 0.1, 0.3, 3.0, 0.2, 0.15, -0.1, 1.5)
    flat = Reach(Envelope((), 5 * MS, arm, -1.0, (((0.0, 0.0), (1.0, 1.0)),), None))  # type: ignore[arg-type]
    with pytest.raises(ValueError):
        flat.depth_m([0.0] * 4)
    with pytest.raises(ValueError):
        Reach(Envelope((), 5 * MS, arm, -1.0, (), None)).deeper([0.0] * 4, [0.0] * 3)


@pytest.mark.parametrize(
    ("signal", "readable"),
    [
        ("0|1@1+ (1,0) [0|1]", True),
        ("0|64@1+ (1,0) [0|1]", True),
        ("63|1@1+ (1,0) [0|1]", True),
        ("0|0@1+ (1,0) [0|1]", False),
        ("0|65@1+ (1,0) [0|1]", False),
        ("64|1@1+ (1,0) [0|1]", False),
        ("0|8@1+ (1,5) [0|1]", False),
        ("0|8@0+ (1,0) [0|1]", False),
    ],
)
def test_a_signal_has_1_to_64_bits_of_a_frame_and_no_offset(tmp_path: Path, signal: str, readable: bool) -> None:
    path = tmp_path / "one.dbc"
    path.write_text(f'BO_ 5 One: 8 Node\n SG_ X : {signal} "" Node\n\n')
    if readable:
        assert list(read_layouts(path, ["One"])["One"].fields) == ["X"]
    else:
        with pytest.raises(GuardConfigError, check=coded("guard.signal-unreadable")):
            read_layouts(path, ["One"])


@pytest.mark.parametrize("encoding", ["cp1252", "utf-8", "utf-8-sig"])
def test_a_database_is_read_whatever_the_encoding_of_its_units_and_comments(tmp_path: Path, encoding: str) -> None:
    path = tmp_path / "one.dbc"
    path.write_text('BO_ 5 One: 8 Node\n SG_ X : 0|8@1+ (1,0) [0|1] "°C" Node\n\nCM_ "Öl";\n', encoding=encoding)
    assert list(read_layouts(path, ["One"])["One"].fields) == ["X"]


def test_the_numbers_of_the_verdicts_are_those_that_recordings_hold() -> None:
    """They are on both buses (GuardStat, GuardAlive): a new rule gets a new number, and none is used again."""
    names = (
        "GOOD NO_COMMAND CORRUPT OTHER_GUARD RANGE RATE NOT_ARMED ESTOP ENCODER OUTSIDE CALMING STALE ESTOP_LOST "
        "LATCHED SPOOL MOVING PERSON REACH DISAGREE BOTH CARRIER_LOST OVERSPEED"
    )
    assert {verdict.name: verdict.value for verdict in Verdict} == {n: i for i, n in enumerate(names.split())}
