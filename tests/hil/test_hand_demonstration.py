"""From an operator's hands on the plant's levers to primitives, through the recording of the bus."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from autonomy.motion.arm_kinematics import Arm
from autonomy.motion.demonstration import joint_track, segment_motions
from autonomy.motion.movement_primitives import SHIPPED_FOLDER, is_near_bunk, learn_primitives
from can_dbc.dbc.codec import load as load_database
from hil.demonstrations import AXES, demonstrate, script
from host.exit_codes import CommandFailed, ExitCode
from machine.loading.profile_file import load_profile
from recorder.manifest import describe
from recorder.recorder import Recorder
from runtime.errors import TimberhandError
from sim.world import home_pose
from tests.codes import coded, exit_code_of
from timberhand.cli import app
from training.motion.demonstration_recordings import motions_in

PROFILE = load_profile("aoro_fc8")
HOME = tuple(home_pose(PROFILE)[name] for name in ("slew", "lift", "tilt", "ext", "rot"))
SHOWN = SHIPPED_FOLDER / "aoro_fc8.csv"


def test_the_script_goes_out_and_back_on_both_sides_over_the_stakes() -> None:
    arm = Arm(PROFILE)
    shown = script(PROFILE, 3, 4, HOME)
    assert len(shown) == 8
    sides = set()
    for out, back in zip(shown[::2], shown[1::2], strict=True):
        log = arm.pose((*out.joints[-1], 0.0))
        assert back.joints[0] == pytest.approx(out.joints[-1])
        assert is_near_bunk(PROFILE.bunk, arm.xy(arm.pose((*back.joints[-1], 0.0)))) and not is_near_bunk(
            PROFILE.bunk, arm.xy(log)
        )
        sides.add(np.sign(log.slew_rad))
        assert max(arm.pose((*q, 0.0)).z_m for q in back.joints) > 2.9
    assert sides == {-1.0, 1.0}
    again = script(PROFILE, 3, 4, HOME)
    assert all(np.array_equal(a.joints, b.joints) for a, b in zip(shown, again, strict=True))


def test_learn_reads_the_shipped_demonstrations(tmp_path: Path) -> None:
    out, picture = tmp_path / "learned.json", str(tmp_path / "learned.png")
    result = CliRunner().invoke(app, ["plan", "learn", str(SHOWN), "--out", str(out), "--plot", picture, "--json"])
    assert result.exit_code == 0
    told = json.loads(result.stdout)
    assert (told["profile"], told["motions"], told["out"], told["back"]) == ("aoro_fc8", 12, 6, 6)
    learned, shipped = (json.loads(path.read_bytes()) for path in (out, SHIPPED_FOLDER / "aoro_fc8.json"))
    assert np.array(learned["out"]["weights"]) == pytest.approx(np.array(shipped["out"]["weights"]), rel=1e-3, abs=1e-3)


def test_learn_says_when_the_plot_cannot_be_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(*_: object) -> None:
        raise ValueError("Format 'xyz' is not supported")

    monkeypatch.setattr("training.motion.primitives_plot.plot_primitives", refused)
    words = ["plan", "learn", str(SHOWN), "--out", str(tmp_path / "learned.json"), "--plot", "learned.xyz"]
    failed = CliRunner().invoke(app, words).exception
    assert isinstance(failed, CommandFailed) and failed.code == "plan.plot-not-written"


@pytest.mark.parametrize(
    ("name", "text", "code"),
    [
        ("log.csv", "x", None),
        ("log.txt", "(0.1) crane0 182#0011223344556677\n", None),
        ("bare.log", "  crane0  702   [1]  00\n" * 3, "demonstration.no-stamps"),
        ("photo.log", "\x01\x1b[2J\n", "recording.no-frames"),
        ("packed.log", "PK\x03\x04", "recording.no-frames"),
        ("missing", None, "recording.none"),
        ("run.mcap", "x", "recording.not-mcap"),
    ],
)
def test_a_file_without_motions_is_refused(tmp_path: Path, name: str, text: str | None, code: str | None) -> None:
    if text is not None:
        (tmp_path / name).write_text(text)
    with pytest.raises(TimberhandError) as stopped:
        motions_in(tmp_path / name)
    assert exit_code_of(stopped.value) == ExitCode.CONFIGURATION and code in (None, stopped.value.code)
    with pytest.raises(CommandFailed, check=coded("demonstration.other-machine")):
        motions_in(SHOWN, "palms_471")


def test_records_that_cannot_be_read_are_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "cut.log").write_text("(0.1) can0 7FF#00\n(0.2) can0 7FF#0")
    with pytest.raises(TimberhandError, check=coded("demonstration.encoder-missing")):
        motions_in(tmp_path / "cut.log")
    assert "line 2" in capsys.readouterr().err


def test_encoder_frames_of_two_interfaces_are_refused(tmp_path: Path) -> None:
    log = tmp_path / "both.log"
    encoder = load_database("crane").message("EncSlew").key
    lines = [f"({i / 100:.6f}) can{i % 2} {encoder:03X}#0011223344556677\n" for i in range(4)]
    log.write_text("".join(lines))
    with pytest.raises(CommandFailed, check=coded("demonstration.several-buses")):
        motions_in(log)
    log.write_text("".join(lines[::2]) + "(9.0) can1 18FECA00#04FF6E000401FFFF\n")
    with pytest.raises(TimberhandError, check=coded("demonstration.encoder-missing")):
        motions_in(log)


@pytest.mark.long
def test_a_recording_of_hands_on_the_levers_is_learned_from(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path / "run", PROFILE, describe(PROFILE, ("crane0", "mach0"), 2))
    frames = demonstrate("aoro_fc8", seed=2, targets=1, recorder=recorder)
    recorder.close()
    heard = segment_motions(PROFILE, joint_track(PROFILE, load_database("crane"), frames))
    for log in (tmp_path / "run", tmp_path / "run" / "crane0.log"):
        _, motions = motions_in(log)
        assert len(motions) == len(heard) == 2
        for a, b in zip(motions, heard, strict=True):
            n = min(len(a.position), len(b.position))
            assert np.max(np.abs(a.position[:n] - b.position[:n])) < 0.01
    learned = learn_primitives(PROFILE, heard)
    assert (learned.out.demonstrations, learned.back.demonstrations) == (1, 1)
    # The crane really went there: the hands are no exact machine, but they arrive.
    for motion, planned in zip(heard, script(PROFILE, 2, 1, HOME), strict=True):
        assert np.max(np.abs(motion.position[-1] - planned.joints[-1])) < 0.05
        assert motion.position.shape[1] == len(AXES)
