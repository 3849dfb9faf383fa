"""The closed loop of the whole controller on a small plant with dead time, lag and dead-band."""

from math import isnan

import msgspec
import pytest

from can_dbc.messages.crane import GrappleCommand
from controller.guard.__main__ import build, profile_path
from controller.laws.grapple import GrappleState
from controller.laws.valve_map import ValveMap
from machine.joints import Joint
from machine.profile import SPEED_HEADROOM_SHARE
from machine.status.modes import Mode
from tests.controller.bench import AORO, SETTINGS, SPECS, Bench, settings_of
from tests.controller.smooth_motion import GOALS, drive

SLEW = SPECS[0]
TOTAL_S = 16.0


@pytest.mark.parametrize("kind", ["pd", "sliding_mode", pytest.param("super_twisting", marks=pytest.mark.long)])
def test_smooth_motion_of_all_joints_is_tracked(kind):
    """Profile of the 2026 test-bed (docs/reference/machines.md section 1.6), planner at 20 Hz, slow enough for the
    pump.
    """
    joints = {
        name: msgspec.structs.replace(s, law=msgspec.structs.replace(s.law, kind=kind))
        for name, s in SETTINGS.profile.joints.items()
    }
    profile = msgspec.structs.replace(SETTINGS.profile, joints=joints)
    bench = Bench(settings_of(profile)).armed()
    worst = [0.0] * 5
    start = list(bench.q)
    for _ in drive(bench, TOTAL_S, TOTAL_S + 3.0):
        reference = bench.controller.reference_position
        worst = [max(w, abs(q - r)) for w, q, r in zip(worst, bench.q, reference, strict=True)]
        assert bench.controller.crane.governor.behind_ns == 0
    assert max(worst[:4]) < 0.004 and worst[4] < 0.01, worst
    for q, p, d, spec in zip(bench.q, start, GOALS, SPECS, strict=True):
        assert abs(q - p - d) <= 2.0 * spec.law.stop_band
    assert bench.run(60) is Mode.ARMED


def test_valves_are_shut_at_rest():
    bench = Bench().armed()
    for _ in drive(bench, 8.0, 10.0):
        pass
    opened = 0
    for k in range(800):
        bench.tick([bench.hold()] if k % 10 == 0 else ())
        opened += not bench.neutral and any(bench.commands_a[s] for s in ("Slew", "Lift", "Tilt", "Ext"))
    assert opened <= 0.05 * 800


def test_half_speed_slows_the_trajectory():
    bench = Bench().active(speed=0.13)
    bench.dropped.add("PressA")
    bench.run(25)
    bench.drive(0, 0.13, 30)
    for _ in range(12):
        planned = bench.controller.crane.governor.planned(bench.now_ns)[1][0]
        bench.drive(0, min(planned + 0.03, 0.33), 10)
    assert bench.controller.supervisor.half_speed
    limit = ValveMap(SLEW.valve).spool_pct(0.5 * SPEED_HEADROOM_SHARE * SLEW.speed_limit)
    assert bench.commands_a["Slew"] <= limit + 0.05
    assert bench.controller.crane.governor.rate < 0.8


# -- a machine without sensors for rotator and opening: it starts, moves and never reads them


@pytest.fixture
def forwarder() -> Bench:
    return Bench(settings=AORO, home=(0.0, 0.9, -2.0, 0.5, 0.0))


@pytest.mark.parametrize("which", [Joint.SLEW, Joint.EXT, Joint.ROT])
def test_controller_arms_and_moves_without_a_rotator_encoder(forwarder, which):
    forwarder.active(which, 0.1, 200)
    report = forwarder.reports[-1]
    assert forwarder.mode is Mode.ACTIVE and report.refused == 0
    assert forwarder.q[which] > 0.07
    assert isnan(report.position[Joint.ROT]) and not any(map(isnan, report.position[: Joint.ROT]))
    if which is Joint.ROT:
        assert report.reference[Joint.ROT] == pytest.approx(forwarder.q[Joint.ROT], abs=0.05)


def test_opening_on_the_bus_is_ignored_without_a_sensor(forwarder):
    forwarder.changed["GrappleStat"] = {"Opening": 100.0}
    forwarder.armed()
    forwarder.keep(300, grapple=GrappleCommand.OPEN)
    assert forwarder.controller.crane.grapple.state is GrappleState.OPENING, "100 % open means nothing here"
    forwarder.keep(400, grapple=GrappleCommand.OPEN)
    assert isnan(forwarder.reports[-1].opening_pct)
    assert forwarder.controller.crane.grapple.state is GrappleState.OPEN


def test_guard_enables_the_forwarder():
    watched = Bench(settings=AORO, home=(0.0, 0.9, -2.0, 0.5, 0.0), guard=build(profile_path("aoro_fc8")))
    watched.active(Joint.ROT, 0.1, 200)
    assert watched.mode is Mode.ACTIVE and watched.q[Joint.ROT] > 0.07
