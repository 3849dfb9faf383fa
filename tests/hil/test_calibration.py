"""Calibration of virtual machines in lockstep: real controller, guard, bus and physics."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

import machine
from autonomy.calibration.plan import SpoolTask
from autonomy.calibration.procedure import Calibration
from experiments.calibration.trial import calibrated
from experiments.common.pool import Job
from hil.calibration import run_lockstep
from hil.replay.recording import files_of
from hil.replay.replay import replay
from machine.loading.profile_file import load_profile
from recorder.manifest import describe
from recorder.recorder import Recorder
from timberhand.cli import app

SHIPPED = Path(machine.__file__).parent


@pytest.mark.long
@pytest.mark.timeout(300)
@pytest.mark.parametrize("profile", ["palms_471", "aoro_fc8"])
def test_the_hidden_truth_is_recovered_in_four_minutes(profile: str) -> None:
    found = calibrated(Job("one", "calibration", 1042, {"profile": profile, "truth": "sampled"}))
    assert found["failure"] is None and found["implausible"] == []
    assert found["seconds"] < 240.0
    for name, joint in found["joints"].items():
        assert max(map(abs, joint["deadband_pct"])) < 1.0, name
        assert max(map(abs, joint["gain"])) < 0.05, name
        assert abs(joint["delay_ms"]) < 10.0, name
    assert max(found["after_mm"]) < 6.0 < max(found["before_mm"])
    tip = found["tip"]
    assert len(tip["empty"]) >= 6 and max(tip["empty"]) < 6.0 < max(tip["before"])
    assert max(tip["loaded"]) < 20.0 < 40.0 < max(tip["loaded_before"])
    assert abs(found["give"]) < 0.15 and max(map(abs, tip["load_kg"])) < 30.0
    assert ("rotator" in found) == (profile == "aoro_fc8"), "the other has an encoder there"
    if "rotator" in found:
        its_rotator_is_found(found["rotator"])


@pytest.mark.long
@pytest.mark.timeout(300)
def test_the_nominal_forwarder_turns_exactly_after_a_survey_of_its_rotator() -> None:
    found = calibrated(Job("one", "calibration", 1, {"profile": "aoro_fc8", "truth": "nominal"}))
    assert found["failure"] is None and found["implausible"] == [] and found["seconds"] < 240.0
    its_rotator_is_found(found["rotator"])
    assert max(map(abs, found["rotator"]["profile"]["quarter"])) > 0.06, "with the shipped profile it was off"


def its_rotator_is_found(rotator: dict[str, Any]) -> None:
    """Dead-band, full speed and what comes of them: a commanded quarter turn."""
    assert max(map(abs, rotator["deadband_pct"])) < 2.0
    assert max(map(abs, rotator["gain"])) < 0.05
    assert max(map(abs, rotator["quarter"])) < 0.03


def test_a_valve_with_reversed_polarity_ends_the_run(tmp_path: Path) -> None:
    before, section, after = (SHIPPED / "palms_471.toml").read_text().partition("[joints.slew.valve]")
    path = tmp_path / "crossed.toml"
    path.write_text(before + section + after.replace("sign = 1 ", "sign = -1", 1))
    assert load_profile(path).joints["slew"].valve.sign == -1
    outcome = run_lockstep(str(path), "nominal", 3, surveyed=False)
    assert outcome.calibration is not None and outcome.calibration.failure_code == "calibration.wrong-direction"
    assert "slew" in (outcome.failure or "")
    assert outcome.seconds < 5.0


@pytest.mark.long
def test_an_abort_leaves_the_valves_neutral_and_the_run_replays(tmp_path: Path) -> None:
    profile = load_profile("palms_471")
    recorder = Recorder(tmp_path / "log", profile, describe(profile, (profile.crane_bus,), 3))
    seen: list[Calibration] = []
    outcome = run_lockstep(
        "palms_471",
        "sampled",
        3,
        surveyed=False,
        recorder=recorder,
        watch=seen.append,
        aborted=lambda: bool(seen) and _opened(seen[-1]),
    )
    recorder.close()
    assert outcome.calibration is not None and outcome.calibration.failure_code == "calibration.aborted"
    trace = outcome.calibration.trace
    assert any(trace.spools[0].values), "it had moved"
    assert all(column.values[-1] == 0.0 for column in trace.commands)
    assert replay(files_of(tmp_path / "log")).agrees


@pytest.mark.long
def test_the_command_records_every_bus_of_the_machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("hil.calibration.MAX_DURATION_S", 3.0)
    asked = ["calibrate", "--profile", "aoro_fc8", "--lockstep", "--out", str(tmp_path / "mine.toml")]
    done = CliRunner().invoke(app, asked)
    assert getattr(done.exception, "code", "") == "calibrate.ended-early"
    manifest = json.loads((tmp_path / "mine" / "log" / "manifest.json").read_text())
    assert manifest["buses"] == ["crane0", "mach0"] and not (tmp_path / "mine.toml").exists()


def _opened(calibration: Calibration) -> bool:
    return isinstance(calibration.task, SpoolTask) and bool(calibration.trace.commands[0].values[-1:].tolist() != [0.0])
