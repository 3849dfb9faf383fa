"""The calibrated profile: a copy with its comments, every change marked, never over a file, never an unusable one."""

from __future__ import annotations

from pathlib import Path

import pytest

import machine
from autonomy.calibration.profile_file import profile_changes, write_profile
from autonomy.calibration.result import CalibrationResult, JointResult
from autonomy.calibration.survey import SurveyFit
from autonomy.calibration.turn_fit import SideFit, TurnFit
from autonomy.calibration.valve_fit import ValveFit
from machine.joints import Joint
from machine.loading.profile_file import load_profile, profile_hash, shipped_profiles
from machine.profile import Sag
from runtime.errors import InputRefused
from tests.codes import coded

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


SAG = {
    "head_rad_m": 0.0023,
    "pin_rad_m": 0.0017,
    "rest_rad": 0.011,
    "load_rad_nm": 1.1e-6,
    "head_nm_m": 2100.0,
    "pin_nm_m": 1500.0,
}


@pytest.mark.parametrize("name", shipped_profiles())
def test_a_sag_table_is_added_and_another_calibration_replaces_it(name: str, tmp_path: Path) -> None:
    first, second = tmp_path / "first.toml", tmp_path / "second.toml"
    write_profile(SHIPPED / f"{name}.toml", first, [(("sag", k), v, "by survey") for k, v in SAG.items()], "2026-11-21")
    assert load_profile(first).sag == Sag(**SAG)
    write_profile(first, second, [(("sag", "pin_rad_m"), 0.0019, "by survey")], "2026-12-01")
    assert load_profile(second).sag == Sag(**{**SAG, "pin_rad_m": 0.0019})
    assert second.read_text().count("[sag]") == 1
    assert profile_hash(load_profile(second)) != profile_hash(load_profile(first))


def test_zeros_and_sag_of_a_survey_are_written_together() -> None:
    profile = load_profile("palms_471")
    sag = Sag(0.0054321987, 0.0036, 0.028, 1.23456789e-6, 4500.0, 3000.0)
    survey = SurveyFit((0.0, 0.002, -0.001, 0.003), sag, (1e-4,) * 4, (0.05,) * 6, (0.001,) * 6, (30.0,) * 6)
    found = {path: value for path, value, _ in profile_changes(profile, CalibrationResult({}, {}, survey))}
    lift = profile.joints["lift"].encoder
    assert found["joints", "lift", "encoder", "zero_counts"] == lift.zero_counts + lift.direction * round(
        0.002 / lift.unit_per_count
    )
    assert found["joints", "slew", "encoder", "zero_counts"] == profile.joints["slew"].encoder.zero_counts
    assert {k[-1]: v for k, v in found.items() if k[0] == "sag"} == {
        "head_rad_m": 0.0054322,
        "pin_rad_m": 0.0036,
        "rest_rad": 0.028,
        "load_rad_nm": 1.2346e-6,
        "head_nm_m": 4500.0,
        "pin_nm_m": 3000.0,
    }


def test_a_full_speed_is_written_for_the_nominal_arm_of_the_lever() -> None:
    profile = load_profile("palms_471")
    lever = profile.joints["lift"].valve
    valve = ValveFit(
        (0.12, 0.13), 0.021, 1.04, (0.2, 0.22), 0.0, lever.lever_at[5], (10.0, 0.4), (0.0, 0.0), 0.0, (), {}
    )
    lift = JointResult(Joint.LIFT, valve, None, (0.3, 0.3), (0.0, 0.0), 0.18, ())
    found = {
        path[-1]: value for path, value, _ in profile_changes(profile, CalibrationResult({Joint.LIFT: lift}, {}, None))
    }
    assert lever.lever[5] < 0.95, "measured where the arm is short and the joint fast"
    assert found["full_speed_plus"] == pytest.approx(0.2 * lever.lever[5], abs=1e-4)
    assert found["full_speed_minus"] == pytest.approx(0.22 * lever.lever[5], abs=1e-4)
    assert (found["hysteresis_pct"], found["exponent"]) == (2.1, 1.04)


def test_surveyed_turns_are_written_and_a_rotator_that_is_slower_gets_a_lower_limit() -> None:
    profile = load_profile("aoro_fc8")
    turns = TurnFit(SideFit(0.1134, 2.21, (0.002, 0.02)), SideFit(0.0951, 1.4, (0.002, 0.02)))
    found = {path: value for path, value, _ in profile_changes(profile, CalibrationResult({}, {}, None, turns=turns))}
    assert found == {
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
