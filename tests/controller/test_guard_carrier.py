"""The guard on mach0: what passes, its frame GuardAlive, and a controller that lies on both buses."""

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from can_dbc.frame import EXTENDED
from controller.guard.__main__ import split
from controller.guard.verdicts import Verdict
from tests.controller.bench import MS, T, count_until
from tests.controller.guard_traffic import DRIVING, STANDING, Traffic, press_reset


def forwarder():
    return Traffic("aoro_fc8").good()


def test_alive_goes_out_every_20_ms_and_only_where_there_is_a_carrier():
    traffic = forwarder()
    n = len(traffic.alive)
    traffic.tick(100)
    assert len(traffic.alive) - n == 25
    assert traffic.alive[-1]["Enable"] == 0xA
    crane, machine = split(traffic.sent)
    assert not any(key & EXTENDED for key, _ in crane) and all(key & EXTENDED for key, _ in machine)
    fixed = Traffic().good()
    assert fixed.alive == [] and fixed.guard.keys_of_buses[1] == ()


def test_a_normal_drive_passes():
    traffic = forwarder()
    traffic.drive = dict(DRIVING)
    for k in range(500):
        traffic.drive["Speed"] = min(1.0, 0.002 * k) if k < 400 else 0.0
        traffic.drive["ArticRate"] = 0.21 if k % 100 < 50 else -0.21
        traffic.arms_a = {"ArmKey": 0xA, "Arm1": 40.0}
        traffic.arms_b = {"ArmKey": 0xA, "FloatFront": 1}
        traffic.vehicle = {"Speed": traffic.drive["Speed"], "Articulation": 0.5}
        assert traffic.tick() is Verdict.GOOD
    traffic.drive, traffic.arms_a, traffic.arms_b = dict(STANDING), {}, {}
    traffic.vehicle = {"Brake": 1, "Speed": 0.5}
    assert traffic.tick(200) is Verdict.GOOD, "it has time to stop"


def test_a_carrier_that_nobody_armed_does_not_raise_its_frame():
    traffic = Traffic("aoro_fc8")
    assert traffic.tick(700) is Verdict.GOOD
    traffic.arms_a = {"ArmKey": 0xA, "Arm1": 40.0}
    count_until(traffic.tick, lambda: not traffic.guard.enabled)
    assert traffic.guard.verdict is Verdict.NOT_ARMED
    traffic = Traffic("aoro_fc8")
    traffic.tick(700)
    traffic.press().arms_a = {"ArmKey": 0xA, "Arm1": 40.0}
    assert traffic.tick(6) is Verdict.GOOD


def test_steering_back_from_beyond_the_range_passes():
    traffic = forwarder()
    traffic.vehicle["Articulation"] = 0.72
    traffic.drive = DRIVING | {"ArticRate": -0.2}
    assert traffic.tick(20) is Verdict.GOOD


def test_the_crane_may_be_held_while_the_carrier_drives():
    traffic = forwarder()
    traffic.drive = dict(DRIVING)
    traffic.a = {"Mode": 2, "Slew": 0.0}
    for k in range(300):
        traffic.drive["Speed"] = min(0.6, 0.002 * k)
        traffic.a["Slew"] = min(20.0, 0.5 * k)
        assert traffic.tick() is Verdict.GOOD


lies = st.fixed_dictionaries(
    {
        "drive": st.fixed_dictionaries(
            {
                "ArmKey": st.sampled_from([0, 0xA, 0xA, 0xB]),
                "Speed": st.sampled_from([0.0, 0.0, 0.01, -0.05, 0.3, 1.2, -15.0, None]),
                "ArticRate": st.sampled_from([0.0, 0.0, 0.1, -0.1, 0.5, None]),
                "Brake": st.sampled_from([100.0, 100.0, 0.0, 50.0, None]),
            }
        ),
        "arms_a": st.fixed_dictionaries(
            {"ArmKey": st.sampled_from([0, 0xA])} | {f"Arm{i}": st.sampled_from([0.0, 50.0, None]) for i in (1, 4)}
        ),
        "arms_b": st.fixed_dictionaries(
            {"ArmKey": st.sampled_from([0, 0xA]), "FloatFront": st.integers(0, 3), "FloatRear": st.integers(0, 3)}
        ),
        "controller": st.fixed_dictionaries({"Mode": st.sampled_from([3, 3, 4, 5])}),
        "vehicle": st.fixed_dictionaries({"Articulation": st.sampled_from([0.0, 0.7, -0.7])}),
        "slew": st.sampled_from([0.0, 0.0, 13.0, 60.0]),
        "gone": st.sampled_from([set()] * 4 + [{"VehCmd"}, {"ArmCmdA"}, {"VehStat"}]),
        "reset": st.booleans(),
        "ticks": st.integers(1, 80),
    }
)
TRUTH = {
    "drive": STANDING | {"ArmKey": 0, "Speed": 0.0, "ArticRate": 0.0},
    "arms_a": {"ArmKey": 0, "Arm1": 0.0, "Arm4": 0.0},
    "arms_b": {"ArmKey": 0, "FloatFront": 0, "FloatRear": 0},
    "controller": {"Mode": 3},
    "vehicle": {"Articulation": 0.0},
    "slew": 0.0,
    "gone": set(),
    "reset": False,
    "ticks": 60,
}
DRIVES = TRUTH | {"drive": DRIVING | {"ArticRate": 0.1}}


@given(st.lists(st.one_of(lies, st.just(TRUTH), st.just(DRIVES)), max_size=10))
@example([TRUTH, DRIVES, DRIVES | {"vehicle": {"Articulation": 0.7}}, TRUTH | {"reset": True}, DRIVES])
@example([TRUTH, DRIVES | {"gone": {"VehStat"}}, TRUTH, DRIVES | {"slew": 60.0}])
@settings(max_examples=150, deadline=None)
@pytest.mark.long
def test_a_controller_that_lies_on_both_buses_moves_nothing_outside_the_promise(episodes):
    """While the guard enables, what the nodes would do is judged from the sent values alone, by rules written here."""
    traffic, since_state = Traffic("aoro_fc8"), 0
    for lie in episodes:
        for name in ("drive", "arms_a", "arms_b", "controller", "vehicle"):
            setattr(traffic, name, dict(lie[name]))
        traffic.a = {"Mode": 2, "Slew": lie["slew"]} if lie["slew"] else {"Mode": 0}
        traffic.dropped = set(lie["gone"])
        if lie["reset"]:
            press_reset(traffic)
        for k in range(lie["ticks"]):
            traffic.tick()
            since_state = since_state + 1 if "VehStat" in traffic.dropped else 0
            if not traffic.guard.enabled or k < 6:  # a command on mach0 arrives within 20 ms
                continue
            drive, a, b = lie["drive"], lie["arms_a"], lie["arms_b"]
            if lie["gone"] & {"VehCmd", "ArmCmdA"}:
                assert k * T <= 110 * MS
                continue
            assert None not in drive.values() and None not in a.values()
            assert abs(drive["Speed"]) <= 1.0 and abs(drive["ArticRate"]) <= 0.21
            drives = drive["Speed"] or drive["ArticRate"] or not drive["Brake"]
            assert not drives or drive["ArmKey"] == 0xA
            assert (b["FloatFront"], b["FloatRear"]) in ((0, 0), (0, 1), (1, 0))
            raises = a["Arm1"] or a["Arm4"] or b["FloatFront"] or b["FloatRear"]
            assert not raises or a["ArmKey"] == b["ArmKey"] == 0xA
            if drives or raises:
                assert since_state * T <= 110 * MS
                assert abs(lie["vehicle"]["Articulation"]) < 0.632 or (
                    lie["vehicle"]["Articulation"] * drive["ArticRate"] <= 0.0
                )
            if lie["slew"]:
                assert lie["controller"]["Mode"] == 3 or k * T <= 210 * MS
                assert lie["slew"] < 38.0 or abs(drive["Speed"]) <= 0.1 or k * T <= 320 * MS
