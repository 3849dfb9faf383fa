"""Commissioning: the acceptance protocol, the step of a joint on the plant, and the calibrated profile."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

import machine
from autonomy.calibration.profile_file import profile_changes, write_profile
from autonomy.calibration.result import CalibrationResult, JointResult
from autonomy.calibration.survey import SurveyFit
from autonomy.calibration.turn_fit import SideFit, TurnFit
from autonomy.calibration.valve_fit import ValveFit
from autonomy.commissioning.acceptance import IDS, Verdict, document, judge, read_protocol
from autonomy.commissioning.step_test import StepTest, largest_step, profile_margins
from can_dbc.dbc.codec import load
from can_dbc.frame import Frame
from can_dbc.messages.crane import StateReport
from controller.config import Settings
from controller.guard.__main__ import build as build_guard
from controller.guard.__main__ import profile_path
from hil.harness.lockstep import Lockstep, Observer
from hil.harness.operator import Operator
from hil.wire.inprocess import InProcessBus
from machine.joints import JOINTS, Joint
from machine.loading.profile_file import load_profile, profile_hash, shipped_profiles
from machine.profile import Profile, Sag
from machine.status.modes import Mode
from machine.status.reasons import Reason
from runtime.errors import InputRefused
from sim.plant import Plant
from tests.codes import coded

PROFILE = load_profile("palms_471")
HASH = profile_hash(PROFILE)


class _Planner:
    """The test as the planner of a lockstep run."""

    def __init__(self, test: StepTest) -> None:
        self.test, self.bus, self.modes = test, None, set()

    def step(self, now_ns: int, report: StateReport | None, logs: object) -> bytes | None:
        frames: list[Frame] = []
        if self.bus is not None:
            self.bus.drain(frames)
        if report is not None:
            self.modes.add(report.mode)
        return self.test.step(now_ns, report, frames)


def run(test: StepTest, seconds: float = 30.0, each: Callable[[Lockstep], None] = lambda system: None) -> _Planner:
    """On the nominal plant, with an operator who arms once."""
    plant = Plant(PROFILE, seed=1, truth="nominal", logs=0)
    try:
        planner = _Planner(test)
        operator = Operator(HASH, lambda action, report: None, max_stops=0)
        settings, guard = Settings(PROFILE, HASH, PROFILE.rate_hz), build_guard(profile_path("palms_471"))
        system = Lockstep(settings, guard, plant, planner, operator, Observer(None, []))
        planner.bus = InProcessBus(system.core, "step")
        end_ns = system.now_ns + int(seconds * 1e9)
        while system.now_ns < end_ns and not test.idle:
            system.advance()
            each(system)
        return planner
    finally:
        plant.close()


@pytest.mark.long
@pytest.mark.parametrize(("which", "amount"), [(Joint.SLEW, 0.3), (Joint.LIFT, 0.12), (Joint.EXT, 0.2)])
def test_a_joint_steps_out_and_back_and_all_of_it_is_seen(which: Joint, amount: float) -> None:
    test = StepTest(PROFILE, HASH, which, amount, load("crane"))
    assert test.waiting
    run(test)
    assert test.done and test.failure is None and test.progress == 1.0
    found = test.result()
    position, reference = found.series["position"], found.series["reference"]
    assert np.ptp(reference) == pytest.approx(amount, rel=0.02)
    assert np.ptp(position) == pytest.approx(amount, rel=0.1)
    assert 0.0 < found.rest_error < 0.05 * amount < found.largest_error + 0.05 * amount
    assert 0.0 <= found.overshoot < 0.1 * amount and 0.0 <= found.delay_s < 0.6
    assert 12.0 < found.largest_command_pct <= 100.0, "beyond the dead-band"
    assert np.nanmax(np.abs(found.series["spool"] - found.series["command"])) < 60.0
    assert np.ptp(found.series["pressure_a"]) > 1.0, "its pressures move with it"


@pytest.mark.long
def test_an_abort_brakes_on_the_path_and_a_stop_ends_it() -> None:
    test = StepTest(PROFILE, HASH, Joint.SLEW, 0.5, load("crane"))

    def end(system: Lockstep) -> None:
        if test.progress > 0.2:
            test.abort("the page is gone")

    planner = run(test, each=end)
    assert test.failure == "the page is gone" and test.idle and not test.done
    assert not planner.modes & {Mode.STOP, Mode.FAULT}, "braked, not stopped"


def test_a_test_waits_for_armed_and_ends_with_the_controller() -> None:
    test = StepTest(PROFILE, HASH, Joint.SLEW, 0.2, load("crane"))
    q = (0.0, 0.5, -1.5, 0.5, 0.0)

    def report(mode: Mode, refused: int = 0, refusal: Reason = Reason.WRONG_PROFILE) -> StateReport:
        return StateReport(1, HASH, 1, mode, 0, 0, 1, refusal, refused, 0, q, (0.0,) * 5, q, 0.0, 0.0, 0.0, 0, 0, 0, 0)

    assert test.step(10**9, report(Mode.STANDBY)) is None and "STANDBY" in str(test.waiting)
    assert test.step(2 * 10**9, report(Mode.ACTIVE)) is None and "ACTIVE" in str(test.waiting), "a planner drives"
    assert test.step(3 * 10**9, report(Mode.ARMED)) is not None and test.waiting is None
    assert test.step(3 * 10**9 + 400_000_000, None) is None
    assert test.idle and test._failure is not None and test._failure.code == "step.controller-silent"
    again = StepTest(PROFILE, HASH, Joint.SLEW, 0.2, load("crane"))
    again.step(10**9, report(Mode.ARMED))
    again.step(10**9 + 5 * 10**7, report(Mode.ACTIVE, 1, Reason.DATAGRAM_AUTHENTICATION))
    assert not again.idle, "a stranger's datagram"
    assert again.step(10**9 + 10**8, report(Mode.ACTIVE, refused=1)) is None and again.idle and again.failure
    last = StepTest(PROFILE, HASH, Joint.SLEW, -0.2, load("crane"))
    q = (-1.65, *q[1:])
    assert last.step(10**9, report(Mode.ARMED)) is None and last.idle
    assert last._failure is not None and last._failure.code == "step.range"


@pytest.mark.parametrize("amount", [0.0, math.nan, math.inf, 10.0, -10.0])
def test_an_amount_that_is_none_or_too_large_is_refused(amount: float) -> None:
    with pytest.raises(InputRefused, check=coded("step.amount")):
        StepTest(PROFILE, HASH, Joint.LIFT, amount, load("crane"))


def test_a_joint_without_an_encoder_is_refused() -> None:
    forwarder = load_profile("aoro_fc8")
    with pytest.raises(InputRefused, check=coded("step.no-encoder")):
        StepTest(forwarder, 1, Joint.ROT, 0.1, load("crane"))


def test_the_profile_s_margins_are_those_of_the_loop_design() -> None:
    for j in JOINTS:
        phase_deg, gain_db = profile_margins(PROFILE, j)
        assert phase_deg > 40.0 and gain_db > 6.0 and largest_step(PROFILE, j) > 0.1


# -- the acceptance protocol
def form(result: str = "pass", **more: Any) -> dict[str, Any]:
    return {"entries": [{"id": i, "result": result} for i in IDS], "machine": "7", "inspector": "Anna"} | more


def judged(told: dict[str, Any]) -> tuple[Verdict, list[str]]:
    return judge(read_protocol(json.dumps(told).encode()))


def test_only_a_whole_passed_and_signed_protocol_is_accepted() -> None:
    assert judged(form()) == (Verdict.ACCEPTED, [])
    for missing in ("machine", "inspector"):
        verdict, reasons = judged(form(**{missing: "  "}))
        assert verdict is Verdict.INCOMPLETE and len(reasons) == 1
    for k in range(len(IDS)):
        told = form()
        told["entries"][k]["result"] = "open"
        assert judged(told)[0] is Verdict.INCOMPLETE
        told["entries"][k]["result"] = "fail"
        verdict, reasons = judged(told)
        assert verdict is Verdict.REFUSED and len(reasons) == 1


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"[]",
        b"\xff",
        b"{}",
        json.dumps(form(verdict="accepted")).encode(),
        json.dumps(form("passed")).encode(),
        json.dumps(form(machine="x" * 81)).encode(),
        json.dumps(form(entries=form()["entries"][1:])).encode(),
        json.dumps(form(entries=form()["entries"] * 2)).encode(),
    ],
)
def test_what_is_no_protocol_is_refused(data: bytes) -> None:
    with pytest.raises(InputRefused):
        read_protocol(data)


def test_missing_checks_have_a_code_and_facts_are_kept() -> None:
    with pytest.raises(InputRefused, check=coded("acceptance.checks")):
        judged(form(entries=[]))
    kept = document(read_protocol(json.dumps(form()).encode()), {"profile": "palms_471"})
    assert kept["profile"] == "palms_471" and kept["verdict"] == "accepted" and kept["inspector"] == "Anna"


# -- the calibrated profile
SHIPPED = Path(machine.__file__).parent
CHANGES = [
    (("joints", "slew", "valve", "deadband_plus_pct"), 13.42, "middle of the hysteresis"),
    (("joints", "lift", "encoder", "zero_counts"), 8199, "by survey, +0.0027 rad"),
    (("grapple", "close_time_s"), 3.62, "empty"),
]


@pytest.mark.parametrize("name", shipped_profiles())
def test_only_the_changed_lines_change_and_carry_the_mark(name: str, tmp_path: Path) -> None:
    out = tmp_path / "new" / "mine.toml"
    source = SHIPPED / f"{name}.toml"
    write_profile(source, out, CHANGES, "2026-11-21")
    before, after = source.read_text().splitlines(), out.read_text().splitlines()
    assert after[0] == "# Calibrated on 2026-11-21; [cal] marks what was measured on this machine."
    changed = [(a, b) for a, b in zip(before, after[1:], strict=True) if a != b]
    assert len(changed) == len(CHANGES)
    for (_, line), (path, value, remark) in zip(changed, CHANGES, strict=True):
        assert line.startswith(f"{path[-1]} = {value}") and line.endswith(f"# [cal] 2026-11-21 {remark}")
    assert list(tmp_path.joinpath("new").iterdir()) == [out]
    assert load_profile(out).joints["slew"].valve.deadband_plus_pct == 13.42


SAG = Sag(0.0023, 0.0017, 0.011, 1.1e-6, 2100.0, 1500.0)


@pytest.mark.parametrize("name", shipped_profiles())
def test_a_sag_table_is_added_and_another_calibration_replaces_it(name: str, tmp_path: Path) -> None:
    first, second = tmp_path / "first.toml", tmp_path / "second.toml"
    changes = [(("sag", key), value, "by survey") for key, value in msgspec.structs.asdict(SAG).items()]
    write_profile(SHIPPED / f"{name}.toml", first, changes, "2026-11-21")
    assert load_profile(first).sag == SAG
    write_profile(first, second, [(("sag", "pin_rad_m"), 0.0019, "by survey")], "2026-12-01")
    assert load_profile(second).sag == msgspec.structs.replace(SAG, pin_rad_m=0.0019)
    assert second.read_text().count("[sag]") == 1
    assert profile_hash(load_profile(second)) != profile_hash(load_profile(first))


def changed(profile: Profile, result: CalibrationResult) -> dict[tuple[str, ...], float]:
    return {path: value for path, value, _ in profile_changes(profile, result)}


def test_zeros_and_sag_of_a_survey_are_written_together() -> None:
    profile = load_profile("palms_471")
    sag = Sag(0.0054321987, 0.0036, 0.028, 1.23456789e-6, 4500.0, 3000.0)
    survey = SurveyFit((0.0, 0.002, -0.001, 0.003), sag, (1e-4,) * 4, (0.05,) * 6, (0.001,) * 6, (30.0,) * 6)
    found = changed(profile, CalibrationResult({}, {}, survey))
    lift = profile.joints["lift"].encoder
    counts = lift.direction * round(0.002 / lift.unit_per_count)
    assert found["joints", "lift", "encoder", "zero_counts"] == lift.zero_counts + counts
    assert found["joints", "slew", "encoder", "zero_counts"] == profile.joints["slew"].encoder.zero_counts
    written = {path[-1]: value for path, value in found.items() if path[0] == "sag"}
    assert written == msgspec.structs.asdict(Sag(0.0054322, 0.0036, 0.028, 1.2346e-6, 4500.0, 3000.0))


def test_a_full_speed_is_written_for_the_nominal_arm_of_the_lever() -> None:
    profile = load_profile("palms_471")
    lever = profile.joints["lift"].valve
    speeds, at = (0.2, 0.22), lever.lever_at[5]
    valve = ValveFit((0.12, 0.13), 0.021, 1.04, speeds, 0.0, at, (10.0, 0.4), (0.0, 0.0), 0.0, (), {})
    lift = JointResult(Joint.LIFT, valve, None, (0.3, 0.3), (0.0, 0.0), 0.18, ())
    written = changed(profile, CalibrationResult({Joint.LIFT: lift}, {}, None))
    found = {path[-1]: value for path, value in written.items()}
    assert lever.lever[5] < 0.95, "measured where the arm is short and the joint fast"
    assert found["full_speed_plus"] == pytest.approx(0.2 * lever.lever[5], abs=1e-4)
    assert found["full_speed_minus"] == pytest.approx(0.22 * lever.lever[5], abs=1e-4)
    assert (found["hysteresis_pct"], found["exponent"]) == (2.1, 1.04)


def test_surveyed_turns_are_written_and_a_rotator_that_is_slower_gets_a_lower_limit() -> None:
    profile = load_profile("aoro_fc8")
    turns = TurnFit(SideFit(0.1134, 2.21, (0.002, 0.02)), SideFit(0.0951, 1.4, (0.002, 0.02)))
    assert changed(profile, CalibrationResult({}, {}, None, turns=turns)) == {
        ("joints", "rot", "speed_limit"): 1.26,
        ("joints", "rot", "valve", "deadband_plus_pct"): 11.34,
        ("joints", "rot", "valve", "deadband_minus_pct"): 9.51,
        ("joints", "rot", "valve", "full_speed_plus"): 2.21,
        ("joints", "rot", "valve", "full_speed_minus"): 1.4,
    }


def test_an_existing_file_is_never_overwritten(tmp_path: Path) -> None:
    out = tmp_path / "mine.toml"
    out.write_text("mine")
    with pytest.raises(InputRefused, check=coded("calibration.profile-exists")):
        write_profile(SHIPPED / "palms_471.toml", out, CHANGES, "2026-11-21")
    assert out.read_text() == "mine"


def test_a_profile_that_would_be_refused_is_not_left_behind(tmp_path: Path) -> None:
    bad = [(("joints", "slew", "valve", "full_speed_plus"), 0.01, "too slow for its limit")]
    with pytest.raises(InputRefused, check=coded("calibration.profile-invalid")):
        write_profile(SHIPPED / "palms_471.toml", tmp_path / "mine.toml", bad, "2026-11-21")
    assert list(tmp_path.iterdir()) == []
