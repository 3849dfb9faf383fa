"""The calibration run: a good machine finishes; any other ends with a reason and closed valves."""

from __future__ import annotations

from contextlib import suppress
from math import nan

import msgspec
import pytest

from autonomy.calibration.live import SurveyInstrument
from autonomy.calibration.plan import MoveTask, SpoolTask, make_plan, plan_summary
from autonomy.calibration.procedure import READING_PERIOD_NS, SURVEY_SETTLE_S
from autonomy.calibration.profile_file import profile_changes
from autonomy.calibration.report import result_document
from autonomy.calibration.result import CalibrationResult, identify
from autonomy.calibration.spool_program import (
    STAIRCASE_SPEED_SHARES,
    command_for,
    reversed_sweep,
    staircase,
    sweep,
    wiggle,
)
from autonomy.calibration.survey import fit_survey
from autonomy.calibration.turn_fit import fit_turns
from can_dbc.messages.crane import CraneSetpoint, SpoolTest
from machine.geometry.kinematics import pin_position
from machine.joints import JOINTS, Joint
from machine.loading.profile_file import load_profile
from machine.status.modes import Mode
from machine.status.reasons import Reason
from runtime.errors import InputRefused
from tests.autonomy.commissioned_crane import HOME, SAG, Crane
from tests.codes import coded, numbers_in
from tests.operator_end import udp_end

PALMS = load_profile("palms_471")
ROTATOR = {"name": "aoro_fc8", "only_turns": True}


@pytest.mark.long
@pytest.mark.parametrize("name", ["palms_471", "aoro_fc8"])
def test_a_good_machine_takes_under_four_minutes(name: str) -> None:
    crane = Crane(name)
    run = crane.run()
    assert run.failure is None and run.done
    assert run.elapsed_s < 240.0
    sensed = [j for j in JOINTS if crane.profile.joints[j.name.lower()].encoder]
    assert len(run.found.tests) == 4 * len(sensed) and len(run.found.wiggles) == 2 * len(sensed)
    assert len(run.found.readings) == len(crane.plan.survey) and len(run.found.grapple_s) == 2
    assert all(crane.fastest[j] < 1.0 for j in sensed)
    survey = fit_survey(crane.profile.kinematics, run.found.readings)
    assert survey.sag.load_rad_nm == pytest.approx(SAG.load_rad_nm, rel=0.05), "it weighs the crane at every pose"
    assert max(map(abs, survey.moments_nm)) < 50.0 and max(survey.after_m) < 1e-3
    assert len(run.found.turns) == (6 if name == "aoro_fc8" else 0)


def test_a_rotator_without_encoder_turns_there_and_back_and_its_valve_is_found() -> None:
    crane = Crane(**ROTATOR)
    run = crane.run()
    assert run.failure is None and run.done and run.elapsed_s < 35.0
    spec = crane.profile.joints["rot"]
    fit = fit_turns(run.found.turns, spec)
    for side, deadband, full in (
        (fit.plus, spec.valve.deadband_plus_pct, spec.valve.full_speed_plus),
        (fit.minus, spec.valve.deadband_minus_pct, spec.valve.full_speed_minus),
    ):
        # This crane's spool has no play; the profile's has: 1 % of the stroke.
        assert 100.0 * side.deadband == pytest.approx(deadband, abs=1.5)
        assert side.full_speed == pytest.approx(full, rel=0.03)
    assert abs(crane.q[Joint.ROT]) < 0.1 and abs(fit.angle_rad - crane.q[Joint.ROT]) < 0.01


@pytest.mark.parametrize(
    ("fault", "joint", "code", "moved"),
    [
        ({"backward": {Joint.SLEW}}, Joint.SLEW, "calibration.wrong-direction", 0.03),
        ({"backward": {Joint.EXT}}, Joint.EXT, "calibration.wrong-direction", 0.03),
        ({"stuck": {Joint.LIFT}}, Joint.LIFT, "calibration.no-motion", 0.03),
        (ROTATOR | {"backward": {Joint.ROT}}, Joint.ROT, "calibration.wrong-direction", 0.6),
        (ROTATOR | {"stuck": {Joint.ROT}}, Joint.ROT, "calibration.no-motion", 0.6),
    ],
)
def test_a_joint_that_does_not_follow_its_command_ends_the_run(fault, joint, code, moved) -> None:
    crane = Crane(**fault)
    before, run = crane.q[joint], crane.run()
    assert run.failure_code == code and joint.name.lower() in run.failure
    assert abs(crane.q[joint] - before) < moved and ends_shut(crane)


def test_an_abort_while_the_rotator_turns_shuts_its_valve() -> None:
    crane = Crane(**ROTATOR)
    crane.run(done=lambda c: c._spools()[Joint.ROT] > 12.0)
    crane.calibration.abort("interrupted")
    run = crane.run()
    assert run.failure_code == "calibration.aborted" and ends_shut(crane)


def test_without_a_readable_direction_the_rotator_stays_as_it_was() -> None:
    crane = Crane("aoro_fc8", only_turns=True, no_compass=True)
    run = crane.run()
    assert run.failure is None and run.done and not run.found.turns
    assert not any(isinstance(m, SpoolTest) for m in crane.heard)
    result = identify(crane.profile, run.found)
    assert result.turns is None and len(result.kept) == 1 and "rot" in result.kept[0]
    assert result_document(result, {}, [])["kept"] == list(result.kept)
    assert not profile_changes(crane.profile, CalibrationResult({}, {}, None, kept=result.kept))


@pytest.mark.parametrize(("readings", "code"), [(5, "calibration.survey-timeout"), (1, None)])
def test_a_silent_instrument_ends_the_run_and_a_person_who_types_does_not(
    readings: int, code: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("autonomy.calibration.procedure.SURVEY_TIMEOUT_NS", 1_000_000_000)
    crane = Crane(**ROTATOR, silent=True, readings=readings)
    run = crane.run(8.0)
    assert run.failure_code == code and run.idle is bool(code) and not run.done


@pytest.mark.parametrize("late_s", [0.12, 0.25, 0.4])
def test_no_reading_of_a_pose_is_an_answer_from_the_one_before(late_s: float) -> None:
    """An instrument answers every request where the crane stood when it came, ``late_s`` afterwards."""
    with udp_end() as far:
        instrument, now_ns, on_the_way = SurveyInstrument(far.getsockname()), 10**10, []
        for pose in range(3):
            begun_ns, readings, next_ns = now_ns, [], 0
            while len(readings) < 3:
                now_ns += 5_000_000
                while on_the_way and on_the_way[0][0] <= now_ns:
                    _, there, asker = on_the_way.pop(0)
                    far.sendto(b'{"pin_m":[%d,0,0]}' % there, asker)
                wanted = now_ns >= max(begun_ns + SURVEY_SETTLE_S * 1e9, next_ns)
                if wanted and (pin := instrument.read(now_ns)) is not None:
                    readings.append(pin[0])
                    next_ns = now_ns + READING_PERIOD_NS
                with suppress(BlockingIOError):
                    on_the_way.append((now_ns + late_s * 1e9, pose, far.recvfrom(100)[1]))
            assert readings == [pose] * 3
        instrument.close()


def test_every_joint_is_wiggled_before_anything_travels() -> None:
    crane = Crane()
    run = crane.run(done=lambda c: isinstance(c.calibration.task, MoveTask))
    assert run.failure is None
    assert [(w.joint, w.side) for w in run.found.wiggles] == [(j, s) for j in JOINTS for s in (1, -1)]
    assert all(isinstance(m, SpoolTest) for m in crane.heard)
    assert all(abs(a - b) < 0.03 for a, b in zip(crane.q, HOME["palms_471"], strict=True)), "a wiggle is small"


@pytest.mark.parametrize(
    ("change", "sweeps"),
    [
        ({}, {1: 1, -1: 1}),
        ({"full_speed_minus": 0.5}, {1: 1, -1: 2}),
        ({"deadband_plus_pct": 0.25}, {1: 2, -1: 1}),
    ],
)
@pytest.mark.long
def test_a_side_that_is_slow_or_narrow_is_swept_twice(change: dict[str, float], sweeps: dict[int, int]) -> None:
    """One sweep left the dead-band of a lift uncertain by 1 % of the stroke."""
    shipped = load_profile("aoro_fc8").joints["lift"].valve
    valve = msgspec.structs.replace(shipped, **{key: share * getattr(shipped, key) for key, share in change.items()})
    run = Crane("aoro_fc8", valves={Joint.LIFT: valve}, chosen=(Joint.LIFT,)).run()
    assert run.done
    found = [test.side for test in run.found.tests if test.kind == "sweep"]
    assert {side: found.count(side) for side in (1, -1)} == sweeps


@pytest.mark.parametrize("after_s", [1.0, 40.0])
def test_an_abort_shuts_the_valve_within_a_tenth_of_a_second(after_s: float) -> None:
    crane = Crane()
    crane.run(after_s)
    crane.run(20.0, lambda c: any(c._spools()))
    crane.calibration.abort("interrupted")
    aborted_ns = crane.now_ns
    run = crane.run()
    assert run.failure_code == "calibration.aborted" and not run.done
    assert crane.now_ns - aborted_ns < 200_000_000
    assert ends_shut(crane)


def test_an_abort_while_travelling_ends_at_rest() -> None:
    crane = Crane()
    crane.run(done=lambda c: isinstance(c.calibration.task, MoveTask))
    crane.run(1.5)
    crane.calibration.abort("interrupted")
    run = crane.run(5.0)
    assert run.idle
    last = crane.heard[-1]
    assert isinstance(last, CraneSetpoint) and last.final and not any(last.knots[-1].velocity)


def test_a_stop_ends_the_run_and_nothing_is_sent_after_it() -> None:
    crane = Crane()
    crane.run(3.0)
    crane.mode = Mode.STOP
    run = crane.run(1.0)
    sent = len(crane.heard)
    crane.mode = Mode.ARMED
    crane.run(5.0)
    assert run.idle and run.failure_code == "calibration.controller-mode" and "STOP" in run.failure
    assert len(crane.heard) == sent


def interrupted(crane: Crane, reason: Reason, for_s: float = 20.0) -> None:
    """The crane stops for a reason; a person resets, looks round, and arms again."""
    crane.mode, crane.reason = Mode.STOP, reason
    crane.run(5.0)
    crane.mode, crane.reason = Mode.STANDBY, Reason.NONE
    crane.run(for_s - 5.0)
    crane.mode = Mode.ARMED


@pytest.mark.long
def test_a_run_of_one_joint_repeats_the_tests_that_a_lost_message_and_a_person_interrupted() -> None:
    crane = Crane(surveyed=False, chosen=(Joint.TILT,), patience_s=60.0)
    crane.run(done=lambda c: isinstance(t := c.calibration.task, SpoolTask) and t.kind == "sweep")
    began_at = crane.q[Joint.TILT]
    crane.run(3.0)
    interrupted(crane, Reason.ENCODER_LOST)
    assert crane.calibration.failure is None and 60 in numbers_in(crane.calibration.waiting or "")
    crane.q[Joint.TILT] += 0.1  # it has sunk
    crane.run(0.1)
    assert isinstance(crane.calibration.task, MoveTask)
    crane.run(done=lambda c: isinstance(t := c.calibration.task, SpoolTask) and t.kind == "sweep")
    assert crane.q[Joint.TILT] == pytest.approx(began_at, abs=0.05), "it begins the test where it began it before"
    crane.run(done=lambda c: isinstance(t := c.calibration.task, SpoolTask) and t.kind == "staircase")
    crane.run(1.0)
    interrupted(crane, Reason.PERSON_IN_ZONE)
    run = crane.run()
    assert run.failure is None and run.done and run.resumptions == 2 and run.waiting is None
    kinds = [(test.joint, test.side, test.kind) for test in run.found.tests]
    assert kinds == [(Joint.TILT, side, kind) for side in (1, -1) for kind in ("sweep", "staircase")]
    changed = profile_changes(crane.profile, identify(crane.profile, run.found))
    assert changed and all(path[:2] == ("joints", "tilt") for path, _, _ in changed)


@pytest.mark.parametrize(
    ("machine", "reason"),
    [
        ({}, Reason.OPERATOR_STOP),
        ({}, Reason.JOINT_STUCK),
        ({}, Reason.ESTOP_PRESSED),
        ({}, Reason.NONE),
        (ROTATOR, Reason.ENCODER_LOST),
    ],
)
def test_what_a_person_or_the_joint_has_stopped_and_a_rotator_without_encoder_do_not_go_on(machine, reason) -> None:
    crane = Crane(**machine, patience_s=60.0)
    crane.run(6.0 if machine else 8.0)
    interrupted(crane, reason)
    assert crane.calibration.idle and crane.calibration.failure_code == "calibration.controller-mode"


@pytest.mark.parametrize("second", [Reason.OPERATOR_STOP, None])
def test_an_interruption_ends_the_run_after_its_time_or_at_the_operators_stop(second: Reason | None) -> None:
    crane = Crane(patience_s=60.0)
    crane.run(8.0)
    interrupted(crane, Reason.LOOP_LATE, for_s=50.0)
    crane.mode, crane.reason = (Mode.STANDBY, Reason.NONE) if second is None else (Mode.STOP, second)
    crane.run(9.0)
    assert crane.calibration.idle == (second is not None)
    crane.run(2.0)
    assert crane.calibration.idle and crane.calibration.failure


def test_a_joint_without_encoder_cannot_be_chosen_alone() -> None:
    profile = load_profile("aoro_fc8")
    with pytest.raises(InputRefused, check=coded("calibration.no-encoder")):
        make_plan(profile, HOME["aoro_fc8"], surveyed=False, chosen=(Joint.ROT,))
    plan = make_plan(profile, HOME["aoro_fc8"], surveyed=False, chosen=(Joint.ROT, Joint.LIFT))
    assert [p.joint for p in plan.joints] == [Joint.LIFT] and not plan.grapple


@pytest.mark.parametrize(
    ("refusal", "code"),
    [(Reason.FINAL_MOVING, "calibration.setpoint-refused"), (Reason.DATAGRAM_AUTHENTICATION, None)],
    ids=["its own", "a stranger's"],
)
def test_a_refused_setpoint_ends_the_run_if_it_is_its_own(refusal: Reason, code: str | None) -> None:
    crane = Crane()
    crane.run(3.0)
    crane.refuses, crane.refusal = 1, refusal
    run = crane.run(1.0)
    assert run.failure_code == code and run.idle is bool(code)


def test_it_waits_until_a_person_arms() -> None:
    crane = Crane(mode=Mode.STANDBY)
    run = crane.run(5.0)
    assert not crane.heard and run.begun_ns is None and run.failure is None
    assert run.waiting_code == "calibration.controller-mode" and "STANDBY" in (run.waiting or "")


def ends_shut(crane: Crane) -> bool:
    """Whether the last spool test that was sent ends neutral, and nothing is open a moment later."""
    last = next(m for m in reversed(crane.heard) if isinstance(m, SpoolTest))
    crane.run(0.3)
    return last.knots[-1].percent == 0.0 and not any(crane._spools())


@pytest.mark.parametrize("name", ["palms_471", "aoro_fc8"])
def test_a_plan_stays_clear_of_ground_bunk_and_stops(name: str) -> None:
    profile = load_profile(name)
    plan = make_plan(profile, HOME[name], surveyed=True)
    for p in plan.joints:
        spec = profile.joints[p.joint.name.lower()]
        assert spec.lower < p.low < p.high < spec.upper
        for at in (p.low, p.pose[p.joint], p.high):
            q = list(p.pose)
            q[p.joint] = at
            assert pin_position(profile.kinematics, q)[2] >= plan.clear_z_m - 1e-9
    for q in plan.survey:
        assert pin_position(profile.kinematics, q)[2] >= plan.clear_z_m - 1e-9
    lines = plan_summary(profile, plan)
    assert len(lines) == len(JOINTS) + 2
    assert list(plan.skipped) == ([Joint.ROT] if name == "aoro_fc8" else [])


def test_a_machine_without_room_is_refused_before_anything_moves() -> None:
    bunk = msgspec.structs.replace(PALMS.bunk, stake_height_m=9.0)
    with pytest.raises(InputRefused, check=coded("calibration.no-clear-pose")):
        make_plan(msgspec.structs.replace(PALMS, bunk=bunk), (0.0, 0.7, -1.5, 0.3, nan), surveyed=False)


def test_programs_begin_and_end_neutral_and_reach_their_speeds() -> None:
    for name, spec in PALMS.joints.items():
        for side in (1, -1):
            stairs = staircase(spec, side)
            for program in (wiggle(spec, side), sweep(spec, side), stairs, reversed_sweep(sweep(spec, side), 1.7)):
                assert program.at(0.0) == program.at(program.duration_s) == 0.0, name
                assert program.window(program.duration_s - 0.1, 0.4)[-1].percent == 0.0
                assert all(side * p >= 0.0 for _, p in program.points)
            top = max(side * p for _, p in stairs.points)
            assert top == pytest.approx(command_for(spec, side, STAIRCASE_SPEED_SHARES[-1] * spec.speed_limit))


def test_a_program_starts_from_its_beginning_however_late_the_tick_is() -> None:
    crane = Crane()
    crane.run(0.1)
    assert not crane.heard
    crane.now_ns += 90_000_000  # this host had something else to do
    crane.run(0.2)
    first = crane.heard[0]
    assert isinstance(first, SpoolTest) and first.knots[0].percent == 0.0
    assert (first.knots[1].after_ns, first.knots[1].percent) == (500_000_000, 5.0), "10 % per second from its beginning"


def test_a_task_describes_itself() -> None:
    crane = Crane()
    crane.run(1.0)
    assert crane.calibration.task == SpoolTask(Joint.SLEW, 1, "wiggle")
    at, count = crane.calibration.progress
    assert at == 0 and count > 40 and 150.0 < crane.calibration.remaining_s() < 260.0


def test_a_changed_program_is_sent_at_once_and_its_end_however_late() -> None:
    crane = Crane()
    crane.run(done=lambda c: any(c._spools()))
    crane.run(3.0, lambda c: c.calibration._spool.closed)
    last = crane.heard[-1]
    assert isinstance(last, SpoolTest) and last.stamp_ns == crane.now_ns and last.knots[-1].percent == 0.0
    other = Crane()
    other.run(done=lambda c: isinstance(c.calibration.task, MoveTask))
    other.run(done=lambda c: isinstance(c.calibration.task, SpoolTask) and any(c._spools()))
    heard = len(other.heard)
    spool = other.calibration._spool
    other.now_ns += int(spool.program.duration_s * 1e9)
    other.run(0.05)
    assert len(other.heard) > heard and other.heard[-1].knots[-1].percent == 0.0
