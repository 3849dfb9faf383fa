"""The guard latches: only a person allows motion again, whatever a controller sends."""

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from can_dbc.frame import Frame
from controller.guard.__main__ import build
from controller.guard.guard import CALM_NS
from controller.guard.verdicts import LATCHING, Verdict
from tests.controller.bench import MS, T, count_until
from tests.controller.guard_traffic import (
    BROKEN,
    CENTRE,
    DRIVE_BROKEN,
    GOOD_A,
    GOOD_B,
    MOVING,
    PROFILE,
    Traffic,
    press_reset,
    spoil,
)


def other_guard(traffic):
    traffic.extra.append(Frame(traffic.now_ns, 0x1FD, bytes(8)))


def corrupt(traffic):
    for _ in range(2):
        spoil(traffic, "ValveCmdA")


LATCHED = {name: case for name, case in (BROKEN | DRIVE_BROKEN).items() if case[0] in LATCHING}
LATCHED |= {
    "other guard": (Verdict.OTHER_GUARD, 15, 1, other_guard),
    "corrupt": (Verdict.CORRUPT, 15, 1, corrupt),
}


def test_every_rule_that_latches_is_tried():
    assert {case[0] for case in LATCHED.values()} == LATCHING


@pytest.mark.parametrize("name", LATCHED)
def test_it_never_enables_again_by_itself(name):
    """The cause is gone and all commands are neutral; only the button of the safety module lets it enable again."""
    traffic = Traffic("aoro_fc8" if name in DRIVE_BROKEN else "palms_471").good()
    before = {field: dict(value) for field, value in vars(traffic).items() if isinstance(value, dict)}
    LATCHED[name][3](traffic)
    count_until(traffic.tick, lambda: not traffic.guard.enabled, limit=500)
    traffic.tick(3)
    press_reset(traffic)
    pressed_too_early = traffic.guard.verdict
    for field in before.keys() - {"senders"}:
        setattr(traffic, field, before[field])
    traffic.dropped.clear()
    if name not in ("other guard", "other guard on mach0", "corrupt", "joint moves without a command"):
        # These are over at once: the joint has moved, and stands.
        assert pressed_too_early is not Verdict.CALMING
        assert traffic.tick(600) is Verdict.LATCHED
    traffic.tick(10)
    press_reset(traffic)
    assert count_until(traffic.tick, lambda: traffic.guard.enabled) * T <= CALM_NS + 2 * T


def test_a_button_that_is_held_a_moving_command_and_a_lost_module_give_no_reset():
    traffic = Traffic().good()
    traffic.estop["ResetReq"] = 1
    traffic.tick(5)
    traffic.estop["ChannelA"] = 0
    traffic.tick(5)
    traffic.estop["ChannelA"] = 1
    assert traffic.tick(100) is Verdict.LATCHED, "held since before"
    traffic.dropped.add("EstopStat")
    traffic.tick(20)
    traffic.dropped.clear()
    assert traffic.tick(100) is Verdict.LATCHED, "the module was away, and its button is still down"
    traffic.estop["ResetReq"] = 0
    traffic.a.update(MOVING)
    assert press_reset(traffic) is Verdict.LATCHED, "a motion is commanded"
    traffic.a = dict(GOOD_A)
    assert traffic.tick(9) is Verdict.LATCHED and traffic.pilot[-1]["Supply"] == 0, "that press does not count later"
    assert press_reset(traffic) is Verdict.CALMING
    assert traffic.tick(60) is Verdict.GOOD and traffic.pilot[-1]["Supply"] == 0xA


values = st.sampled_from([-100.0, -13.0, 0.0, 13.0, 100.0, None])
lies = st.fixed_dictionaries(
    {
        "a": st.fixed_dictionaries(
            {"Mode": st.integers(0, 3)} | dict.fromkeys(("Slew", "Lift", "Tilt", "Ext"), values)
        ),
        "b": st.fixed_dictionaries(
            {
                "ArmKey": st.sampled_from([0, 0xA, 0xB]),
                "Rot": values,
                "Grapple": values,
                "Aux": values,
                "GrappleMode": st.integers(0, 3),
                "MaxFlow": st.sampled_from([0.0, 100.0]),
            }
        ),
        "ticks": st.integers(1, 70),
        "channels": st.sampled_from([(1, 1)] * 6 + [(0, 0), (1, 0), (2, 1)]),
        "reset": st.booleans(),
        "slew_counts": st.sampled_from([CENTRE] * 3 + [CENTRE - 5200, CENTRE + 5200]),
        "gone": st.sampled_from([set()] * 5 + [{"EncLift"}, {"EstopStat"}, {"ValveCmdA"}]),
        "skip": st.sampled_from([0, 0, 0, 1, 2, 7]),
        "mode": st.sampled_from([3, 3, 3, 2, 4]),
        "person": st.sampled_from([0, 0, 0, 0, 1]),
        "lift_spool": st.sampled_from([0.0, 0.0, 0.0, 30.0]),
    }
)
NEUTRAL_LIE = {
    "a": dict(GOOD_A),
    "b": dict(GOOD_B),
    "ticks": 60,
    "channels": (1, 1),
    "reset": False,
    "slew_counts": CENTRE,
    "gone": set(),
    "skip": 0,
    "mode": 3,
    "person": 0,
    "lift_spool": 0.0,
}


@given(st.lists(st.one_of(lies, st.just(NEUTRAL_LIE)), max_size=12))
@example([NEUTRAL_LIE, NEUTRAL_LIE | {"channels": (0, 0)}, NEUTRAL_LIE, NEUTRAL_LIE])
@settings(max_examples=150, deadline=None)
@pytest.mark.long
def test_a_controller_that_lies_in_every_field_moves_nothing_outside_the_promise(episodes):
    """What the valve node would do is judged from the sent values alone, by rules written here."""
    traffic, stopped, before, since_encoder = Traffic(), False, True, 0
    for lie in episodes:
        traffic.a, traffic.b = dict(lie["a"]), dict(lie["b"])
        a, b = lie["channels"]
        traffic.estop = {"ChannelA": a, "ChannelB": b, "ResetReq": int(lie["reset"]), "Person": lie["person"]}
        traffic.controller, traffic.valve_a = {"Mode": lie["mode"]}, {"SpoolLift": lie["lift_spool"]}
        traffic.encoder["EncSlew"] = lie["slew_counts"]
        traffic.dropped = set(lie["gone"])
        traffic.senders["ValveCmdA"].counter += lie["skip"]
        for k in range(lie["ticks"]):
            traffic.tick()
            seen = "EstopStat" not in traffic.dropped
            stopped |= seen and (a, b) != (1, 1) and k >= 3
            if seen and lie["reset"] and not before and (a, b) == (1, 1):
                stopped = False
            before = lie["reset"] if seen else True
            since_encoder = since_encoder + 1 if "EncLift" in traffic.dropped else 0
            if not traffic.guard.enabled or k < 3:
                continue
            assert not stopped, "the emergency stop was pressed, and nobody has reset it since"
            assert (a, b) == (1, 1) or not seen
            functions = {
                **{n: lie["a"].get(n) or 0.0 for n in ("Slew", "Lift", "Tilt", "Ext")},
                "Rot": lie["b"].get("Rot"),
            }
            spools = {n: v for n, v in functions.items() if v} if lie["a"]["Mode"] == 2 else {}
            if "ValveCmdA" in traffic.dropped or lie["skip"] > 1:
                continue  # the node has no such command
            assert not lie["b"].get("Aux") and None not in {**lie["a"], **lie["b"]}.values()
            moves = spools or lie["b"].get("GrappleMode") in (1, 2)
            assert not moves or lie["b"]["ArmKey"] == 0xA
            assert not moves or lie["mode"] in (2, 3) or k * T <= 220 * MS, "the controller says that it has stopped"
            assert not moves or not lie["person"] or not seen or k * T <= 320 * MS
            lifts = spools.get("Lift", 0.0) > 0.0 or k * T <= 260 * MS
            assert not lie["lift_spool"] or lifts, "a spool is open, and nobody commands it"
            assert not spools or since_encoder * T <= 100 * MS
            side = (lie["slew_counts"] > CENTRE) - (lie["slew_counts"] < CENTRE)
            assert side * spools.get("Slew", 0.0) <= 0.0, "driven further out"


def test_a_joint_that_was_moved_far_by_hand_lever_can_be_reset_where_it_stands():
    traffic = Traffic().good()
    for _ in range(100):
        traffic.encoder["EncSlew"] += 20
        traffic.tick()
    assert traffic.guard.verdict in (Verdict.MOVING, Verdict.LATCHED)
    assert traffic.tick(100) is Verdict.LATCHED
    press_reset(traffic)
    assert count_until(traffic.tick, lambda: traffic.guard.enabled) * T <= CALM_NS + 2 * T


def test_a_rotator_that_the_logs_turn_is_no_motion_without_a_command_and_one_that_spins_is():
    traffic = Traffic().good()
    place = traffic.encoder["EncRot"]
    unit_rad = next(j.axis.unit for j in traffic.guard.joints.values() if j.axis.number == 4)
    for k in range(75):
        traffic.encoder["EncRot"] = place + round(0.002 * k / abs(unit_rad))
        assert traffic.tick() is Verdict.GOOD
    for k in range(75, 150):
        traffic.encoder["EncRot"] = place + round(0.004 * k / abs(unit_rad))
        traffic.tick()
    assert traffic.guard.verdict in (Verdict.MOVING, Verdict.LATCHED)


def test_a_guard_that_was_latched_before_it_was_restarted_waits_for_the_button():
    traffic = Traffic()
    traffic.guard = build(PROFILE, latched=True)
    assert traffic.tick(100) is Verdict.LATCHED and traffic.pilot[-1]["Supply"] == 0
    assert press_reset(traffic) is Verdict.GOOD and not traffic.guard.latched
