"""Every limit of the guard's parts: what is still allowed at it, and what is not just beyond it."""

from __future__ import annotations

import math
import tomllib
from pathlib import Path

import pytest

from can_dbc.frame import Frame
from controller.guard import stream
from controller.guard.__main__ import profile_path
from controller.guard.envelope import CarrierLimits, Envelope, Kinematics, _axis, read_envelope
from controller.guard.joints import CommandedAxis, MeasuredJoint, MotionWatch, RateCredit
from controller.guard.layout import Field, GuardConfigError, Layout, read_layouts
from controller.guard.reach import Reach
from controller.guard.stream import Punctuality, SentMessage, WatchedMessage
from controller.guard.verdicts import FINE, Verdict
from tests.codes import coded
from tests.controller.bench import MS, count_until
from tests.controller.guard_parts import AXIS, AXIS_LIMITS, ENCODER, PERCENT, POSITION, VALVE, resting, spool
from tests.controller.guard_traffic import Traffic

# -- fields ------------------------------------------------------------------------------------------------------------


def test_a_field_reads_its_own_bits_and_both_signs() -> None:
    field = Field(4, 8, True, 0.5, -64.0, 63.5)
    assert [field.raw(value << 4 | 0xF00F) for value in (0, 0x7F, 0x80, 0xFF)] == [0, 127, -128, -1]
    assert Field(4, 8, False, 1.0, 0.0, 255.0).raw(0xFF0) == 255
    assert field.put(0x1A5) == 0xA50


def test_a_value_at_the_end_of_its_range_is_inside() -> None:
    assert PERCENT.inside(1000) and PERCENT.inside(-1000)
    assert not PERCENT.inside(1001) and not PERCENT.inside(-1001)
    exact = Field(0, 16, True, 1.0, -10.0, 10.0)
    assert [exact.inside(v) for v in (-11, -10, 10, 11)] == [False, True, True, False]


# -- commands ----------------------------------------------------------------------------------------------------------


def test_a_command_may_grow_by_its_credit_and_then_by_its_rate() -> None:
    credit = RateCredit(100.0)  # 0.04 s of the rate and 3 %: 7 %
    assert not credit.spent(7.0, 0.0)
    assert credit.spent(7.1, 0.0)
    assert not credit.spent(8.0, 0.0095)
    assert credit.spent(9.1, 0.01), "1 % in 0.01 s, and no more"


def test_a_long_pause_gives_no_more_credit_than_the_first_one() -> None:
    credit = RateCredit(100.0)
    assert credit.spent(7.5, 10.0)
    credit = RateCredit(100.0)
    assert not credit.spent(-7.0, 10.0)


def test_closing_costs_nothing_and_the_other_side_costs_all_of_it() -> None:
    credit = RateCredit(100.0)
    assert not credit.spent(6.0, 0.0) and not credit.spent(2.0, 0.0) and not credit.spent(3.0, 0.0)
    assert credit.spent(-1.0, 0.0), "nothing is left: 6 and 1 of 7 % are spent"
    credit = RateCredit(100.0)
    assert not credit.spent(3.0, 0.0)
    assert not credit.spent(-4.0, 0.0)
    assert not credit.spent(-4.0, 0.0)
    assert credit.spent(-4.5, 0.0)
    assert not credit.spent(0.0, 0.0)


def test_growth_that_is_refused_leaves_no_debt() -> None:
    credit = RateCredit(100.0)
    assert credit.spent(50.0, 0.0)
    assert not credit.spent(51.0, 0.0101)


def axis(percent: float, elapsed_s: float = 1.0) -> tuple[Verdict, CommandedAxis]:
    command = CommandedAxis(AXIS, PERCENT)
    return command.receive(round(percent * 10.0) & 0xFFFF, elapsed_s), command


def test_the_opening_is_the_part_of_a_command_past_the_dead_band_of_its_side() -> None:
    verdict, command = axis(24.0)
    assert (verdict, command.percent, command.opening) == (Verdict.GOOD, 24.0, pytest.approx(5.0))
    assert command.speed == pytest.approx(0.05 * 0.4 * -1)
    verdict, command = axis(-14.5)
    assert (verdict, command.opening) == (Verdict.GOOD, pytest.approx(-5.0))
    assert command.speed == pytest.approx(-0.05 * 0.2 * -1)
    assert axis(20.0)[1].opening == axis(15.0)[1].opening == axis(0.0)[1].opening == 0.0
    assert axis(-10.0)[1].opening == axis(-5.0)[1].opening == 0.0


def test_a_command_outside_its_range_or_too_fast_is_told() -> None:
    assert axis(100.1)[0] is Verdict.RANGE
    assert axis(60.0)[0] is Verdict.RATE
    assert axis(25.5)[0] is Verdict.GOOD, "7 % past the dead-band"
    assert axis(25.7)[0] is Verdict.RATE


# -- encoders ----------------------------------------------------------------------------------------------------------


def encoder_frame(position: int, stamp: int, at_ns: int, length: int = 4) -> Frame:
    return Frame(at_ns, 0x181, (position | stamp << 16).to_bytes(4, "little")[:length])


def test_an_encoder_is_silent_from_the_start_and_after_90_ms() -> None:
    joint = MeasuredJoint(AXIS, ENCODER)
    assert joint.silent(1) and not joint.silent(0)
    joint.receive(encoder_frame(8192 + 100, 1, 1000 * MS), 1001 * MS)
    assert joint.position == pytest.approx(-0.1) and joint.stamp_ns == 1000 * MS
    assert not joint.silent(1090 * MS) and joint.silent(1090 * MS + 1)


def test_an_encoder_whose_time_stands_still_or_whose_frame_is_short_counts_as_silent() -> None:
    joint = MeasuredJoint(AXIS, ENCODER)
    joint.receive(encoder_frame(8192, 0, 10 * MS), 10 * MS)
    assert joint.stamp_ns == 10 * MS, "its first stamp may be 0"
    joint.receive(encoder_frame(9000, 0, 20 * MS), 20 * MS)
    joint.receive(encoder_frame(9000, 5, 30 * MS, 3), 30 * MS)
    assert (joint.position, joint.stamp_ns) == (0.0, 10 * MS)


def test_a_frame_from_the_future_has_the_present_time() -> None:
    joint = MeasuredJoint(AXIS, ENCODER)
    joint.receive(encoder_frame(8192, 1, 99 * MS), 20 * MS)
    assert joint.stamp_ns == 20 * MS


@pytest.mark.parametrize(("counts", "offset"), [(8192 + 8191, 8191), (8192 - 8192, -8192), (100, 100 - 8192)])
def test_a_rotary_encoder_counts_half_a_turn_to_either_side(counts: int, offset: int) -> None:
    joint = MeasuredJoint(AXIS, ENCODER)
    joint.receive(encoder_frame(counts, 1, MS), MS)
    assert joint.position == pytest.approx(-0.001 * offset)
    far = MeasuredJoint(AXIS._replace(zero_counts=100), ENCODER)
    far.receive(encoder_frame(16383, 1, MS), MS)
    assert far.position == pytest.approx(-0.001 * -101)


def test_a_linear_encoder_has_neither_turns_nor_a_time() -> None:
    layout = Layout(0x185, 2, {"Position": POSITION["Position"]}, b"", 0)
    joint = MeasuredJoint(AXIS._replace(total_counts=0, zero_counts=0, unit=1e-4), layout)
    for at_ns in (MS, 2 * MS):
        joint.receive(Frame(at_ns, 0x185, (60_000).to_bytes(2, "little")), at_ns)
    assert joint.position == pytest.approx(6.0) and joint.stamp_ns == 2 * MS


@pytest.mark.parametrize(("counts", "told_at"), [(4, None), (-4, None), (6, 5), (-6, 5), (30, 3)])
def test_a_joint_that_lasts_above_its_speed_is_told_once(counts: int, told_at: int | None) -> None:
    """One frame each 20 ms: its limit is 4 counts a frame, the place follows by 4.4, and 4 counts are its slack."""
    joint, told = MeasuredJoint(AXIS, ENCODER), []
    for k in range(60):
        moved = min(k, 50) * counts
        joint.receive(encoder_frame(8192 + moved, k + 1, (1000 + 20 * k) * MS), (1000 + 20 * k) * MS)
        told.append(joint.too_fast())
        if told[-1]:
            assert not joint.too_fast(), "its place is where it is now"
            break
    assert (told.index(True) if told_at else any(told)) == (told_at or False)


@pytest.mark.parametrize(
    ("number", "asked_rad_s", "told"),
    [(4, 0.1, False), (4, -0.1, False), (4, 0.101, True), (4, -0.101, True), (3, 0.0, True)],
)
def test_a_rotator_that_its_valve_does_not_turn_follows_a_log(number: int, asked_rad_s: float, told: bool) -> None:
    """The log turns it by 0.1 rad at once; 0.004 rad are the slack of a joint that its valve moves."""
    joint = MeasuredJoint(AXIS._replace(number=number), ENCODER)
    joint.expect(asked_rad_s)
    for k in range(4):
        joint.receive(encoder_frame(8192 + (k > 0) * 100, k + 1, (1000 + 5 * k) * MS), (1000 + 5 * k) * MS)
    assert joint.too_fast() is told
    joint.expect(asked_rad_s)
    for k in range(4):
        joint.receive(encoder_frame(8192 + 100 + (k > 0) * 250, 9 + k, (1100 + 5 * k) * MS), (1100 + 5 * k) * MS)
    assert joint.too_fast(), "no log turns it as fast as that"


@pytest.mark.parametrize(("gap_ms", "told"), [(89, True), (90, False)])
def test_where_a_joint_is_after_its_encoder_was_silent_is_its_place(gap_ms: int, told: bool) -> None:
    joint = MeasuredJoint(AXIS, ENCODER)
    joint.receive(encoder_frame(8192, 1, 1000 * MS), 1000 * MS)
    for k in range(3):
        at_ns = (1000 + gap_ms + k) * MS
        joint.receive(encoder_frame(8192 + 500, 2 + k, at_ns), at_ns)
    assert joint.too_fast() is told


def test_two_samples_that_jump_are_an_encoder_s_fault() -> None:
    joint = MeasuredJoint(AXIS, ENCODER)
    for k, jump in enumerate((0, 900, 900, 0, 900, 0, 0)):
        joint.receive(encoder_frame(8192 + jump, k + 1, (1000 + 5 * k) * MS), (1000 + 5 * k) * MS)
        assert not joint.too_fast()


# -- motion ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("percent", "told"), [(12.0, False), (12.1, True), (-12.0, False), (-12.1, True)])
def test_a_spool_may_open_as_far_as_its_dead_band_without_a_command(percent: float, told: bool) -> None:
    watch = MotionWatch(3, PERCENT, 12.0, 50 * MS)
    assert (watch.check(0.0, spool(percent), 1000 * MS, 0.005) == (Verdict.SPOOL, 3)) is told


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_spool_may_take_its_time_to_close_on_the_commanded_side_only(side: float) -> None:
    def told(seen: float, after_ns: int) -> bool:
        watch = MotionWatch(3, PERCENT, 12.0, 50 * MS)
        assert watch.check(side * 30.0, spool(0.0), 1000 * MS, 0.005) is FINE
        return watch.check(0.0, spool(seen), 1000 * MS + after_ns, 0.005) is not FINE

    assert not told(side * 40.0, 50 * MS) and told(side * 40.0, 50 * MS + 1)
    assert told(-side * 40.0, 5 * MS)


def test_a_spool_outside_its_range_or_unknown_tells_nothing() -> None:
    watch = MotionWatch(3, PERCENT, 12.0, 50 * MS)
    assert watch.check(0.0, spool(100.1), 1000 * MS, 0.005) is FINE
    assert watch.check(0.0, None, 1000 * MS, 0.005) is FINE


@pytest.mark.parametrize(
    ("number", "pressed", "limit"), [(1, False, 0.02), (1, True, 0.04), (4, False, 0.2), (4, True, 0.4)]
)
def test_a_joint_at_rest_may_be_away_from_its_place_for_two_steps(number: int, pressed: bool, limit: float) -> None:
    for moved, verdict in ((limit - 1e-6, None), (limit + 1e-3, Verdict.MOVING)):
        watch, joint = resting(number)
        joint.position = moved
        found = [watch.check(0.0, None, 1505 * MS + k, 0.0, pressed) for k in range(4)]
        assert found == ([FINE] * 4 if verdict is None else [FINE, FINE, (verdict, number), FINE])


def test_one_sample_that_jumps_is_no_motion() -> None:
    watch, joint = resting()
    for k in range(9):
        joint.position = 0.0 if k % 3 == 2 else 0.5
        assert watch.check(0.0, None, 1505 * MS + k, 0.0) is FINE


def test_a_joint_rests_half_a_second_after_its_command() -> None:
    watch, joint = resting()
    for after_ns in (0, 500 * MS):
        watch.check(5.0, None, 2000 * MS, 0.0)
        joint.position = 0.3
        assert watch.check(0.0, None, 2000 * MS + after_ns, 0.0) is FINE
    joint.position = 0.6
    found = [watch.check(0.0, None, 2501 * MS + k, 0.0) for k in range(3)]
    assert found[-1] == (Verdict.MOVING, 1)


def test_the_place_follows_a_creeping_joint() -> None:
    creep = 0.05 * AXIS.speed_limit  # 0.01 rad/s
    for rate, verdict in ((creep, None), (-creep, None), (3.0 * creep, Verdict.MOVING), (-3.0 * creep, Verdict.MOVING)):
        watch, joint = resting()
        found = []
        for k in range(1, 1001):
            joint.position = rate * 0.005 * k
            found.append(watch.check(0.0, None, 1505 * MS + k * 5 * MS, 0.005))
        assert ((Verdict.MOVING, 1) in found) is (verdict is not None)
        if verdict:
            assert found.index((Verdict.MOVING, 1)) == pytest.approx(0.02 / (2.0 * creep) / 0.005, abs=4)


def test_a_silent_encoder_forgets_the_place() -> None:
    watch, joint = resting()
    joint.quiet = True
    assert watch.check(0.0, None, 1505 * MS, 0.0) is FINE
    joint.quiet, joint.position = False, 5.0
    assert [watch.check(0.0, None, 1506 * MS + k, 0.0) for k in range(5)] == [FINE] * 5
    joint.position = 5.5
    assert (Verdict.MOVING, 1) in [watch.check(0.0, None, 1516 * MS + k, 0.0) for k in range(3)]


# -- reach -------------------------------------------------------------------------------------------------------------

ARM = Kinematics(1.0, 0.1, 0.3, 3.0, 0.2, 0.15, -0.1, 1.5)
BOX = ((2.0, -1.0, -0.5), (4.0, 1.0, 0.5))


def reach(ground_m: float = -1.0, boxes=()) -> Reach:
    return Reach(Envelope((), 5 * MS, ARM, ground_m, boxes, None))


def test_the_pin_is_the_sum_of_boom_telescope_axis_and_stick() -> None:
    slew, lift, tilt, ext = 0.4, 0.5, -0.6, 0.7
    boom, stick = 0.7, 0.0  # angles with their offsets
    r = 0.1 + 3.0 * math.cos(boom) + 0.15 * math.cos(stick) + 2.2 * math.sin(stick)
    z = 1.0 + 3.0 * math.sin(boom) + 0.15 * math.sin(stick) - 2.2 * math.cos(stick)
    assert reach().pin(slew, lift, tilt, ext) == pytest.approx((r * math.cos(0.7), r * math.sin(0.7), z))
    x, y, z = reach().pin(0.0, 0.1, 0.9, 0.2)
    r = 0.1 + 3.0 * math.cos(0.3) + 0.15 * math.cos(1.1) + 1.7 * math.sin(1.1)
    assert z == pytest.approx(1.0 + 3.0 * math.sin(0.3) + 0.15 * math.sin(1.1) - 1.7 * math.cos(1.1))
    assert (x, y) == pytest.approx((r * math.cos(0.3), r * math.sin(0.3)))


def test_the_depth_is_that_below_the_ground_or_in_the_deepest_box(monkeypatch) -> None:
    checked = reach(-1.0, (BOX, ((2.5, -1.0, -0.5), (2.6, 1.0, 0.5))))
    at = {"pin": (0.0, 0.0, 0.0)}
    monkeypatch.setattr(Reach, "pin", lambda self, *_q: at["pin"])
    for pin, depth_m in (
        ((0.0, 0.0, -1.25), 0.25),
        ((0.0, 0.0, -0.75), -0.25),
        ((3.0, 0.0, 0.1), 0.4),
        ((3.9, 0.0, 0.0), 0.1),
        ((2.1, 0.0, 0.0), 0.1),
        ((3.0, 0.95, 0.0), 0.05),
        ((3.0, -0.95, 0.0), 0.05),
        ((3.0, 0.0, -0.45), 0.05),
        ((3.0, 0.0, 0.45), 0.05),
        ((5.0, 0.0, 0.45), -1.0),
    ):
        at["pin"] = pin
        assert checked.depth_m([0.0] * 4) == pytest.approx(depth_m)


def test_only_a_command_that_leads_deeper_is_refused(monkeypatch) -> None:
    checked = reach()
    monkeypatch.setattr(Reach, "depth_m", lambda self, q: q[0])
    rest = [0.0, 0.0, 0.0]
    assert not checked.deeper([-0.1, *rest], [0.9, *rest]), "not there within 0.1 s"
    assert not checked.deeper([-0.1, *rest], [1.0, *rest]), "at the ground is not below it"
    assert checked.deeper([-0.1, *rest], [1.1, *rest])
    assert checked.deeper([0.2, *rest], [0.1, *rest])
    assert not checked.deeper([0.2, *rest], [0.0, *rest]) and not checked.deeper([0.2, *rest], [-0.1, *rest])


# -- files -------------------------------------------------------------------------------------------------------------


def test_the_axes_of_the_forwarder_are_those_of_its_files() -> None:
    """Worked out by hand from aoro_fc8.toml and its envelope."""
    path = profile_path("aoro_fc8")
    profile = tomllib.loads(path.read_text())
    limits = tomllib.loads(path.with_name("aoro_fc8.envelope.toml").read_text())
    envelope = read_envelope(path)
    assert envelope.period_ns == 1_000_000_000 // profile["rate_hz"]
    assert envelope.carrier == CarrierLimits(**limits["carrier"])
    for number, name in enumerate(("slew", "lift", "tilt", "ext", "rot")):
        joint, most, its = profile["joints"][name], limits["joints"][name], envelope.axes[number]
        valve, encoder = joint["valve"], joint.get("encoder")
        order = ("minus", "plus") if valve["sign"] > 0 else ("plus", "minus")
        fulls = tuple(valve[f"full_speed_{side}"] for side in order)
        assert (its.number, its.signal, its.sign) == (number, valve["signal"], valve["sign"])
        assert its.deadbands_pct == tuple(valve[f"deadband_{side}_pct"] for side in order)
        assert its.full_speeds == fulls
        assert its.rate_pct_s == pytest.approx(600.0 * most["acceleration_limit"] / min(fulls))
        assert its.closing_ns == pytest.approx((1.5 * valve["delay_s"] + 3.0 * valve["lag_s"]) * 1e9, abs=2)
        assert (its.lower, its.upper, its.speed_limit) == (most["lower"], most["upper"], most["speed_limit"])
        if encoder is None:
            assert (its.message, its.total_counts, its.zero_counts, its.unit) == ("", 0, 0, 0.0)
            continue
        turns = encoder["total_counts"] if encoder["kind"] != "linear" else 0
        assert (its.message, its.total_counts, its.zero_counts) == (encoder["message"], turns, encoder["zero_counts"])
        assert its.unit == encoder["unit_per_count"] * encoder["direction"]


@pytest.mark.parametrize("changed", [{"sign": -1, "lag_s": 0.0}, {"sign": 1, "delay_s": 0.0}])
def test_a_valve_of_the_other_sign_swaps_its_sides(changed: dict) -> None:
    valve = VALVE | {"delay_s": 0.1, "lag_s": 0.01} | changed
    encoder = {
        "kind": "rotary",
        "message": "EncTilt",
        "total_counts": 16384,
        "zero_counts": 5,
        "unit_per_count": 0.05,
        "direction": -1,
    }
    axis = _axis(2, {"valve": valve, "encoder": encoder}, AXIS_LIMITS)
    plus_first = changed["sign"] < 0
    assert axis.deadbands_pct == ((12.0, 7.0) if plus_first else (7.0, 12.0))
    assert axis.full_speeds == ((0.5, 0.25) if plus_first else (0.25, 0.5))
    assert axis.rate_pct_s == pytest.approx(100.0 * 6.0 * 0.5 / 0.25)
    assert axis.closing_ns == (150 * MS if "lag_s" in changed else 30 * MS)
    assert (axis.total_counts, axis.zero_counts, axis.unit) == (16384, 5, -0.05)
    telescope = {"valve": valve | {"signal": "Ext"}, "encoder": encoder | {"kind": "linear", "message": "EncExt"}}
    linear = _axis(3, telescope, AXIS_LIMITS)
    assert (linear.total_counts, linear.message) == (0, "EncExt")


# -- before anything has happened, at values between -1 and 1, and with numbers that no machine has

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


# -- what no machine has -----------------------------------------------------------------------------------------------


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
    flat = Reach(Envelope((), 5 * MS, ARM, -1.0, (((0.0, 0.0), (1.0, 1.0)),), None))  # type: ignore[arg-type]
    with pytest.raises(ValueError):
        flat.depth_m([0.0] * 4)
    with pytest.raises(ValueError):
        reach().deeper([0.0] * 4, [0.0] * 3)


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
