"""Every limit of the guard's rules on the carrier: what is still allowed at it, and what is not just beyond it."""

from __future__ import annotations

import pytest

from can_dbc.frame import Frame
from can_dbc.protocols.e2e import Sender
from controller.guard.__main__ import DATABASES
from controller.guard.carrier import BOTH_NS, MESSAGES, STOPPING_NS, Carrier
from controller.guard.envelope import CarrierLimits
from controller.guard.layout import read_layouts
from controller.guard.verdicts import ARMS_AXIS, DRIVE_AXIS, FINE, STEER_AXIS, Finding, Verdict
from tests.controller.bench import CODECS, MS

LIMITS = CarrierLimits(
    speed_limit_m_s=2.0, drive_acceleration_m_s2=0.4, articulation_limit_rad=0.5, articulation_rate_limit_rad_s=0.2
)
LAYOUTS = read_layouts(DATABASES / "machine.dbc", list(MESSAGES))
STANDING = {"ArmKey": 0xA, "Brake": 100.0}
ROLLING = {"ArmKey": 0xA, "Brake": 0.0}


class Mach0:
    """The carrier's messages, fresh in every check unless they are ``gone``."""

    def __init__(self, limits: CarrierLimits = LIMITS, now_ns: int = 10**9) -> None:
        self.carrier = Carrier(limits, LAYOUTS)
        drive, arms_a, arms_b, state = *self.carrier.commands, self.carrier.state
        self.watches = {"VehCmd": drive, "ArmCmdA": arms_a, "ArmCmdB": arms_b, "VehStat": state}
        self.values: dict[str, dict] = {"VehCmd": dict(STANDING), "ArmCmdA": {}, "ArmCmdB": {}, "VehStat": {"Brake": 1}}
        self.senders = {name: Sender(CODECS[name].data_ids) for name in self.watches}
        self.gone: set[str] = set()
        self.now_ns = now_ns
        self.send()

    def send(self, **values: dict) -> None:
        for name, its in values.items():
            self.values[name] = its
        for name in self.watches.keys() - self.gone:
            codec = CODECS[name]
            data = codec.encode(*(self.values[name].get(s.name, 0) for s in codec.signals))
            frame = Frame(self.now_ns, codec.key, self.senders[name].protect(data))
            self.watches[name].receive(frame, self.now_ns)

    def judged(self, name: str, elapsed_s: float = 1.0, **its: float | None) -> Finding:
        """What the guard says to the fields of a new command."""
        self.send(**{name: its})
        return self.carrier.receive(self.watches[name], elapsed_s)

    def check(self, crane_moves: bool = False, after_ns: int = 20 * MS, **values: dict) -> Finding:
        self.now_ns += after_ns
        self.send(**values)
        return self.carrier.check(crane_moves, self.now_ns)

    def last(self, until_ns: int, crane_moves: bool = False) -> Finding:
        """The finding at a time, with checks every 20 ms on the way."""
        while self.now_ns + 20 * MS < until_ns:
            self.check(crane_moves)
        return self.check(crane_moves, until_ns - self.now_ns)


# -- fields of a command -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("arm", ["Arm1", "Arm2", "Arm3", "Arm4"])
def test_every_arm_is_judged(arm: str) -> None:
    assert Mach0().judged("ArmCmdA", **{arm: None}) == (Verdict.RANGE, ARMS_AXIS)
    assert Mach0().judged("ArmCmdA", **{arm: 100.0}) == FINE
    mach0 = Mach0()
    assert mach0.check(ArmCmdA={arm: 5.0}) == (Verdict.NOT_ARMED, ARMS_AXIS)


@pytest.mark.parametrize(
    ("front", "rear", "fine"), [(0, 1, True), (1, 0, True), (1, 1, False), (0, 2, False), (3, 0, False)]
)
def test_one_float_valve_may_be_open(front: int, rear: int, fine: bool) -> None:
    found = Mach0().judged("ArmCmdB", FloatFront=front, FloatRear=rear)
    assert found == (FINE if fine else (Verdict.RANGE, ARMS_AXIS))
    if fine:
        assert Mach0().check(ArmCmdB={"FloatFront": front, "FloatRear": rear}) == (Verdict.NOT_ARMED, ARMS_AXIS)


def test_the_speed_may_reach_its_limit_and_the_rounding_of_its_signal() -> None:
    raw = next(r for r in range(1000, 15000) if r * 0.001 / 1.001 * 1.001 == r * 0.001)
    limits = LIMITS._replace(speed_limit_m_s=raw * 0.001 / 1.001, drive_acceleration_m_s2=1000.0)
    assert Mach0(limits).judged("VehCmd", Speed=raw * 0.001) == FINE
    assert Mach0(limits).judged("VehCmd", Speed=-(raw + 1) * 0.001) == (Verdict.RANGE, DRIVE_AXIS)


def test_the_articulation_may_reach_its_rate_and_the_rounding_of_its_signal() -> None:
    raw = next(r for r in range(1000, 10000) if r * 0.0001 / 1.001 * 1.001 == r * 0.0001)
    limits = LIMITS._replace(articulation_rate_limit_rad_s=raw * 0.0001 / 1.001)
    assert Mach0(limits).judged("VehCmd", ArticRate=raw * 0.0001) == FINE
    assert Mach0(limits).judged("VehCmd", ArticRate=-(raw + 1) * 0.0001) == (Verdict.RANGE, STEER_AXIS)


def test_the_brake_has_a_range() -> None:
    assert Mach0().judged("VehCmd", Brake=None) == (Verdict.RANGE, DRIVE_AXIS)
    assert Mach0().judged("VehCmd", Brake=50.0) == FINE


def test_the_speed_grows_three_times_as_fast_as_the_carrier_accelerates() -> None:
    # 100 % x 3 x 0.4 m/s^2 of 2 m/s are 60 %/s; its credit is that of 0.04 s and 3 %: 5.4 %, or 0.108 m/s
    assert Mach0().judged("VehCmd", 0.0, Speed=0.107) == FINE
    assert Mach0().judged("VehCmd", 0.0, Speed=0.109) == (Verdict.RATE, DRIVE_AXIS)
    mach0 = Mach0()
    assert mach0.judged("VehCmd", 0.0, Speed=0.107) == FINE
    assert mach0.judged("VehCmd", 0.02, Speed=0.131) == FINE, "1.2 % are 0.024 m/s"
    assert mach0.judged("VehCmd", 0.02, Speed=0.157) == (Verdict.RATE, DRIVE_AXIS)


def test_the_carrier_s_speed_grows_at_its_rate_to_the_percent() -> None:
    # 100 % x 3 x 4 m/s^2 of 10 m/s are 120 %/s; after 0.77 m/s 0.1 % of the first 7.8 % is left, and 6 % come in 50 ms
    limits = LIMITS._replace(speed_limit_m_s=10.0, drive_acceleration_m_s2=4.0)
    for speed_m_s, found in ((1.375, FINE), (1.385, (Verdict.RATE, DRIVE_AXIS))):
        mach0 = Mach0(limits)
        assert mach0.judged("VehCmd", 0.0, Speed=0.77) == FINE
        assert mach0.judged("VehCmd", 0.05, Speed=speed_m_s) == found


# -- what the machine does ---------------------------------------------------------------------------------------------


def test_a_carrier_that_is_to_stand_has_a_second_and_a_half() -> None:
    mach0 = Mach0()
    assert mach0.check(VehStat={"Speed": 0.5}) == FINE
    stands_ns = mach0.now_ns - 20 * MS
    assert stands_ns == 10**9
    mach0.check(VehStat={"Speed": 0.15})
    rolls_ns = mach0.now_ns
    mach0.send(VehStat={"Speed": -0.151})
    assert mach0.last(rolls_ns + STOPPING_NS) == FINE
    assert mach0.check(after_ns=1) == (Verdict.MOVING, DRIVE_AXIS)


@pytest.mark.parametrize(("drive", "moving"), [(ROLLING, False), (STANDING, True), (ROLLING | {"ArmKey": 0}, True)])
def test_only_a_released_brake_of_an_armed_command_lets_it_roll(drive: dict, moving: bool) -> None:
    mach0 = Mach0()
    mach0.send(VehCmd=drive, VehStat={"Speed": 0.5})
    found = mach0.last(mach0.now_ns + STOPPING_NS + 30 * MS)
    assert (found == (Verdict.MOVING, DRIVE_AXIS)) is moving


@pytest.mark.parametrize("gone", ["VehCmd", "ArmCmdA", "ArmCmdB"])
def test_without_every_command_a_rolling_carrier_counts_as_one_that_is_to_stand(gone: str) -> None:
    mach0 = Mach0()
    assert mach0.check(VehCmd=dict(ROLLING), VehStat={"Speed": 0.5}) == FINE
    mach0.gone = {gone}
    assert mach0.last(mach0.now_ns + 200 * MS)[0] is Verdict.NO_COMMAND
    assert mach0.last(mach0.now_ns + STOPPING_NS) == (Verdict.MOVING, DRIVE_AXIS)


@pytest.mark.parametrize(("now_ns", "moving"), [(STOPPING_NS, False), (STOPPING_NS + 1, True)])
def test_a_carrier_that_moves_from_the_first_step_has_the_same_time(now_ns: int, moving: bool) -> None:
    mach0 = Mach0(now_ns=now_ns)
    mach0.send(VehStat={"Speed": 0.5})
    assert (mach0.carrier.check(False, now_ns) == (Verdict.MOVING, DRIVE_AXIS)) is moving


def test_a_speed_that_is_not_received_is_none() -> None:
    mach0 = Mach0()
    mach0.check(VehStat={"Speed": 0.5})
    mach0.gone = {"VehStat"}
    assert mach0.last(mach0.now_ns + 2 * STOPPING_NS) == FINE
    assert mach0.last(mach0.now_ns + 2 * BOTH_NS, crane_moves=True) == FINE


# -- crane and carrier -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("speed_m_s", [0.101, -0.101])
@pytest.mark.parametrize("measured", [False, True])
def test_both_move_for_the_ramp_of_a_stop(speed_m_s: float, measured: bool) -> None:
    command, state = ({}, {"Speed": speed_m_s}) if measured else ({"Speed": speed_m_s}, {})
    mach0 = Mach0()
    mach0.check(crane_moves=True, VehCmd=ROLLING | {"Speed": 0.1}, VehStat={"Speed": -0.1})
    apart_ns = mach0.now_ns
    mach0.send(VehCmd=ROLLING | command, VehStat=state)
    assert mach0.last(apart_ns + BOTH_NS, crane_moves=True) == FINE
    assert mach0.check(crane_moves=True, after_ns=1) == (Verdict.BOTH, DRIVE_AXIS)
    assert mach0.check(crane_moves=False) == FINE


@pytest.mark.parametrize(("now_ns", "both"), [(BOTH_NS, False), (BOTH_NS + 1, True)])
def test_both_from_the_first_step_have_the_same_time(now_ns: int, both: bool) -> None:
    mach0 = Mach0(now_ns=now_ns)
    mach0.send(VehCmd=ROLLING | {"Speed": 0.2})
    assert (mach0.carrier.check(True, now_ns) == (Verdict.BOTH, DRIVE_AXIS)) is both


# -- a carrier that is commanded to move -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("values", "axis"),
    [
        ({"VehCmd": {"Brake": 100.0, "Speed": 0.01}}, DRIVE_AXIS),
        ({"VehCmd": {"Brake": 0.0}}, DRIVE_AXIS),
        ({"VehCmd": {"Brake": 100.0, "ArticRate": 0.01}}, DRIVE_AXIS),
        ({"ArmCmdA": {"ArmKey": 0xA}, "ArmCmdB": {"FloatRear": 1}}, ARMS_AXIS),
        ({"ArmCmdB": {"FloatFront": 1, "ArmKey": 0xB}}, ARMS_AXIS),
        ({"ArmCmdA": {"Arm2": 5.0}, "ArmCmdB": {"ArmKey": 0xA}}, ARMS_AXIS),
        ({"ArmCmdA": {"Arm2": 5.0, "ArmKey": 0xB}, "ArmCmdB": {"ArmKey": 0xB}}, ARMS_AXIS),
    ],
)
def test_every_motion_needs_its_key(values: dict, axis: int) -> None:
    assert Mach0().check(**values) == (Verdict.NOT_ARMED, axis)
    armed = {name: its | {"ArmKey": 0xA} for name, its in ({"ArmCmdA": {}, "ArmCmdB": {}} | values).items()}
    assert Mach0().check(**armed) == FINE


def test_a_step_between_the_two_messages_of_the_arms_finds_nothing() -> None:
    """Both are armed in the tick that first moves an arm, and the guard may have received only the first of them."""
    mach0 = Mach0()
    assert mach0.check(ArmCmdA={"Arm2": 5.0, "ArmKey": 0xA}) == FINE
    assert mach0.check(ArmCmdB={"FloatFront": 1, "ArmKey": 0xA}, ArmCmdA={}) == FINE


@pytest.mark.parametrize("state", [{"Speed": None}, {"Articulation": None}])
@pytest.mark.parametrize(
    "command", [{"VehCmd": ROLLING}, {"ArmCmdA": {"Arm1": 5.0, "ArmKey": 0xA}, "ArmCmdB": {"ArmKey": 0xA}}]
)
def test_a_motion_needs_a_known_state(state: dict, command: dict) -> None:
    assert Mach0().check(VehStat=state, **command) == (Verdict.CARRIER_LOST, DRIVE_AXIS)
    assert Mach0().check(VehStat=state) == FINE, "standing needs none"


@pytest.mark.parametrize(
    ("beyond", "rate_rad_s", "outward"),
    [(0, 0.1, False), (1, 0.1, True), (0, 0.2, False), (99, 0.0, False), (99, -0.1, False), (99, 0.1, True)],
)
@pytest.mark.parametrize("side", [1, -1])
def test_it_may_bend_as_far_as_its_limit_and_a_margin(beyond: int, rate_rad_s: float, outward: bool, side: int) -> None:
    raw = next(r for r in range(5800, 9000) if r * 0.0001 - 0.02 + 0.02 == r * 0.0001)
    mach0 = Mach0(LIMITS._replace(articulation_limit_rad=raw * 0.0001 - 0.02))
    bend_rad = side * (raw + beyond) * 0.0001
    found = mach0.check(VehCmd=ROLLING | {"ArticRate": side * rate_rad_s}, VehStat={"Articulation": bend_rad})
    assert found == ((Verdict.OUTSIDE, STEER_AXIS) if outward else FINE)
