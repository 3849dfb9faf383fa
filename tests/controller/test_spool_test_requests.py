"""Spool tests through the whole controller: frames on the bus, stops, and what follows a test."""

from __future__ import annotations

import pytest

from can_dbc.messages.crane import SpoolKnot, SpoolTest
from can_dbc.messages.datagrams import encode
from controller.guard.__main__ import build as build_guard
from controller.guard.__main__ import profile_path
from machine.joints import JOINTS, Joint
from machine.status.faults import FAULTS
from machine.status.modes import Mode
from machine.status.reasons import Reason
from tests.controller.bench import AORO, HOME, MS, Bench, T, count_until

SIGNALS = ("Slew", "Lift", "Tilt", "Ext", "Rot")
RAMP = ((0, 0.0), (5, 12.0), (405, 30.0))


def asked(bench: Bench, *points: tuple[float, float], joint: int = Joint.SLEW, lease_ms: int = 200) -> bytes:
    """A spool test from points (ms, %) that begins now."""
    bench.setpoint_sequence += 1
    knots = tuple(SpoolKnot(int(ms * MS), percent) for ms, percent in points)
    test = SpoolTest(bench.setpoint_sequence, bench.settings.profile_hash, bench.now_ns, lease_ms * MS, joint, knots)
    return encode(test)


def spools(bench: Bench) -> list[float]:
    commands = {**bench.commands_a, **bench.commands_b}
    return [commands[name] for name in SIGNALS]


def running(bench: Bench, percent: float, seconds: float, joint: int = Joint.SLEW, step=lambda bench: False) -> None:
    """Ramp to ``percent`` and stay there, renewed every 50 ms; ``step`` may end it."""
    sign = 1 if percent > 0 else -1
    begin_ns = bench.now_ns
    edge = bench.specs[joint].valve.deadband_plus_pct

    opens_ns = begin_ns + 5 * MS
    full_ns = opens_ns + int((abs(percent) - edge) / 0.08 * MS)

    def at(ns: int) -> float:
        return sign * min(abs(percent), edge + 0.08 * max(0, ns - opens_ns) / MS) if ns > begin_ns else 0.0

    while bench.now_ns < begin_ns + seconds * 1e9:
        now = bench.now_ns
        corners = sorted({now, now + 400 * MS} | {ns for ns in (opens_ns, full_ns) if now < ns < now + 400 * MS})
        bench.tick([asked(bench, *(((ns - now) / MS, at(ns)) for ns in corners), joint=joint)])
        for _ in range(9):
            if step(bench):
                return
            bench.tick()


def test_one_spool_follows_its_knots_and_all_others_are_neutral() -> None:
    bench = Bench().armed()
    bench.tick([asked(bench, *RAMP)])
    assert bench.mode is Mode.ACTIVE
    for k in range(1, 30):
        bench.tick()
        now_ms = (k + 1) * T / MS
        slew, *others = spools(bench)
        assert slew == pytest.approx(12.0 + 18.0 * (now_ms - 5) / 400, abs=0.06)
        assert others == [0.0] * 4 and bench.commands_b["GrappleMode"] == 0
    assert bench.controller.reference_position[0] == pytest.approx(bench.q[0], abs=0.01), "it follows the joint"


def test_test_that_ends_neutral_ends_in_armed() -> None:
    bench = Bench().armed()
    bench.tick([asked(bench, (0, 0.0), (5, 12.0), (100, 14.0), (105, 0.0))])
    assert count_until(bench.tick, lambda: bench.mode is Mode.ARMED, 60) * T == pytest.approx(200 * MS, abs=2 * T)
    assert spools(bench) == [0.0] * 5


def test_lost_lease_closes_the_valve_on_a_ramp_and_stops() -> None:
    bench = Bench().armed()
    running(bench, 40.0, 0.6)
    opened = []
    count_until(bench.tick, lambda: bench.mode is Mode.STOP, 60)
    assert bench.controller.supervisor.reason is Reason.LEASE_LOST
    for _ in range(40):
        opened.append(spools(bench)[0])
        bench.tick()
    fading = [p for p in opened if p > 0.0]
    assert fading == sorted(fading, reverse=True) and len(fading) > 10, "not in one step"
    assert spools(bench) == [0.0] * 5 and not bench.controller.crane.spool_run.running


def test_knots_that_end_open_stop_before_the_lease_does() -> None:
    bench = Bench().armed()
    bench.tick([asked(bench, (0, 0.0), (5, 12.0), (100, 16.0))])
    ticks = count_until(bench.tick, lambda: bench.mode is Mode.STOP, 60)
    assert 95 * MS <= ticks * T <= 110 * MS and bench.controller.supervisor.reason is Reason.LEASE_LOST


def test_trajectory_is_accepted_once_the_valve_is_shut() -> None:
    bench = Bench().armed()
    running(bench, 30.0, 0.4)
    bench.tick([bench.hold()])
    gate = bench.controller.gate
    assert (gate.refusal, gate.detail) == (Reason.TEST_BUSY, Joint.SLEW)
    bench.tick([asked(bench, (0, spools(bench)[0]), (60, 0.0))])
    bench.run(14)
    bench.tick([bench.hold()])
    assert bench.mode is Mode.ACTIVE and not bench.controller.crane.spool_run.running
    bench.run(2)
    assert abs(bench.controller.reference_position[0] - bench.q[0]) < 0.02


def test_test_does_not_interrupt_a_moving_trajectory() -> None:
    bench = Bench().active()
    refused = bench.controller.gate.refused
    bench.tick([asked(bench, *RAMP, joint=Joint.LIFT)])
    gate = bench.controller.gate
    assert (gate.refusal, gate.detail, gate.refused) == (Reason.TEST_BUSY, Joint.LIFT, refused + 1)
    assert not bench.controller.crane.spool_run.running


def test_test_needs_an_armed_machine() -> None:
    bench = Bench().boot()
    bench.tick([asked(bench, *RAMP)])
    assert bench.mode is Mode.STANDBY and bench.controller.gate.refusal is Reason.NOT_ARMED


def test_rotator_without_encoder_is_limited_by_its_integrated_angle() -> None:
    blind = Bench(AORO).armed()
    running(blind, 40.0, 0.6, Joint.ROT)
    assert blind.mode is Mode.ACTIVE and spools(blind) == [0.0, 0.0, 0.0, 0.0, pytest.approx(40.0, abs=0.1)]
    assert blind.controller.crane.spool_run.integrated_rad == pytest.approx(0.667 * 0.42, abs=0.05)


def test_rotator_without_encoder_is_stopped_at_its_time_limit() -> None:
    blind = Bench(AORO).armed()
    running(blind, 60.0, 8.0, Joint.ROT, step=lambda bench: bench.mode is Mode.STOP)
    supervisor = blind.controller.supervisor
    assert (supervisor.reason, supervisor.detail) == (Reason.TEST_TOO_LONG, Joint.ROT)
    blind.run(60)
    assert spools(blind) == [0.0] * 5


def test_wild_command_is_refused() -> None:
    bench = Bench().armed()
    bench.tick([asked(bench, (0, 0.0), (5, 40.0))])
    assert (bench.controller.gate.refusal, bench.controller.gate.detail) == (Reason.TEST_SPOOL, Joint.SLEW)
    assert bench.mode is Mode.ARMED


def test_replayed_and_late_tests_are_refused() -> None:
    bench = Bench().armed()
    first = asked(bench, *RAMP)
    bench.tick([first])
    bench.tick([first])
    assert bench.controller.gate.refusal is Reason.OUT_OF_ORDER
    late = asked(bench, *RAMP, lease_ms=20)
    bench.run(10)
    bench.tick([late])
    assert bench.controller.gate.refusal is Reason.STAMP_OLD


def stopped_by(bench: Bench, reason: Reason, joint: Joint) -> bool:
    supervisor = bench.controller.supervisor
    return bench.mode is Mode.STOP and (supervisor.reason, supervisor.detail) == (reason, joint)


def test_joint_is_stopped_inside_its_range() -> None:
    bench = Bench(home=(1.5, *HOME[1:])).armed()
    running(bench, 50.0, 3.0, step=lambda b: b.mode is Mode.STOP)
    assert stopped_by(bench, Reason.TEST_RANGE, Joint.SLEW)
    bench.run(60)
    assert bench.q[0] < 1.74533


def test_joint_faster_than_the_profile_is_stopped() -> None:
    bench = Bench().armed()
    running(bench, 40.0, 0.7)
    bench.moves_alone[Joint.SLEW] = 0.35
    ticks = count_until(bench.tick, lambda: bench.mode is Mode.STOP, 60)
    assert stopped_by(bench, Reason.TEST_SPEED, Joint.SLEW)
    assert ticks * T < 100 * MS, "the estimator's filter and a tick"


def test_test_without_end_is_stopped() -> None:
    bench = Bench().armed()
    running(bench, 5.0, 25.0, step=lambda b: b.mode is Mode.STOP)
    assert stopped_by(bench, Reason.TEST_TOO_LONG, Joint.SLEW)
    assert FAULTS[Reason.TEST_TOO_LONG].sentence.format("joint slew")


@pytest.mark.parametrize("joint", JOINTS)
def test_guard_and_monitors_accept_a_test_below_the_dead_band(joint: Joint) -> None:
    bench = Bench(guard=build_guard(profile_path("palms_471"))).armed()
    running(bench, 11.0 if joint != Joint.ROT else 9.0, 2.0, joint)
    assert bench.mode is Mode.ACTIVE and bench.guard.enabled
    running(bench, -30.0, 1.0, joint)
    assert bench.mode is Mode.ACTIVE and bench.guard.enabled and bench.v[joint] < 0.0
