"""A machine from answers: what is derived is right, and answers that make no machine are refused in sentences."""

from __future__ import annotations

import math
import tomllib
from pathlib import Path

import pytest

from machine.draft.answers import answers_of
from machine.draft.from_urdf import answers_from_urdf
from machine.draft.questions import Question, answers_text, example, merged, put, questions
from machine.draft.toml_text import profile_text
from machine.loading.profile_file import load_profile
from machine.profile import Profile
from runtime.errors import InputRefused
from sim.draft import crane_urdf, least_inertia
from sim.truth.load import load_truth
from tests.codes import coded
from tests.machine.own_machine import answers

MESSAGES = {2: "EncSlew", 3: "EncLift", 4: "EncTilt", 5: "EncExt", 6: "EncRot"}


def drafted(folder: Path, text: str) -> Profile:
    path = folder / "drafted.toml"
    path.write_text(text)
    return load_profile(path)


def urdf(folder: Path, old: str = "", new: str = "", name: str = "palms_471") -> Path:
    """The crane of a shipped machine as a URDF, with something replaced in it."""
    text = crane_urdf(load_profile(name), load_truth("nominal", 0, name))
    assert old in text
    path = folder / "crane.urdf"
    path.write_text(text.replace(old, new))
    return path


def test_the_profile_has_what_follows_from_the_answers(tmp_path: Path) -> None:
    profile = drafted(tmp_path, profile_text(example(), MESSAGES))
    lift, slew = profile.joints["lift"], profile.joints["slew"]
    assert lift.valve.flow_plus == pytest.approx(math.pi / 4 * 0.11**2 * 0.40)
    assert lift.valve.flow_minus == pytest.approx(math.pi / 4 * (0.11**2 - 0.07**2) * 0.40)
    assert lift.valve.lever[2] == pytest.approx(0.43 / 0.40, abs=1e-4)
    assert slew.encoder is not None
    assert (slew.encoder.message, slew.encoder.direction, slew.encoder.zero_counts) == ("EncRot", -1, 65536)
    assert slew.encoder.unit_per_count * 131072 == pytest.approx(2 * math.pi)
    jaws = profile.grapple.jaws
    assert (jaws.half_gap_m[0], jaws.half_gap_m[-1] < 0.0) == (0.70, True)
    assert profile.stability is not None and profile.stability.pin_kg == pytest.approx(200.0 + 60.0 + 39.1, abs=0.1)


def test_a_slow_valve_gets_a_lower_gain(tmp_path: Path) -> None:
    slow = answers_of(answers(("joints.ext.delay_s", 0.16)), "answers")
    profile = drafted(tmp_path, profile_text(slow, MESSAGES))
    assert profile.joints["ext"].law.kp_1_s == pytest.approx(0.2 / 0.16)


def test_all_answers_are_written_with_their_questions_and_read_again() -> None:
    text = answers_text(example())
    assert answers_of(tomllib.loads(text), "again") == example()
    assert all(question.text in text for question in questions(example()) if question.proposal is not None)


def test_the_questionnaire_asks_for_everything_and_checks_what_is_typed() -> None:
    raw: dict[str, object] = {"keep_out": answers()["keep_out"]}
    asked = questions(example())
    for question in asked:
        put(raw, question.path, question.proposal)
    assert answers_of(raw, "asked") == example()
    length = next(q for q in asked if q.path == ("kinematics", "a2_m"))
    assert length.parse("3.1") == 3.1
    for typed in ("long", "-3.1", "-"):
        with pytest.raises(ValueError, match=r"."):
            length.parse(typed)
    assert Question((), "", float | None, 1.0).parse("-") is None


@pytest.mark.parametrize("name", ["palms_471", "aoro_fc8"])
def test_a_urdf_gives_the_geometry_back(tmp_path: Path, name: str) -> None:
    profile, found = load_profile(name), answers_from_urdf(urdf(tmp_path, name=name), {})
    for key, value in found["kinematics"].items():
        assert value == pytest.approx(getattr(profile.kinematics, key), abs=1e-9), key
    assert {n: (j["lower"], j["upper"]) for n, j in found["joints"].items()} == {
        n: (j.lower, j.upper) for n, j in profile.joints.items()
    }


def test_a_urdf_with_other_names_fills_what_the_answers_leave_out(tmp_path: Path) -> None:
    path = urdf(tmp_path, 'joint name="lift"', 'joint name="q2"')
    with pytest.raises(InputRefused, match="--urdf-joints lift", check=coded("answers.urdf-joint")):
        answers_from_urdf(path, {})
    given = answers(("kinematics", None), ("joints.lift.lower", None))
    both = answers_of(merged(given, answers_from_urdf(path, {"lift": "q2"})), "answers")
    assert both.kinematics.a2_m == pytest.approx(3.049046907101)
    assert (both.joints.lift.lower, both.joints.lift.upper) == (-0.383972, 1.35), "an answer counts before the URDF"


@pytest.mark.parametrize(
    ("old", "new", "code"),
    [
        ('<axis xyz="0 0 1"/>', '<axis xyz="0 0 -1"/>', "answers.urdf-chain"),
        ("</robot>", "", "answers.urdf-broken"),
        ('<axis xyz="0 0 1"/>', '<axis xyz="0 0 nan"/>', "answers.urdf-broken"),
        ('<axis xyz="0 0 1"/>', '<axis xyz="0 0 1"/><limit lower="1e400"/>', "answers.urdf-broken"),
    ],
)
def test_a_urdf_of_something_else_is_refused(tmp_path: Path, old: str, new: str, code: str) -> None:
    with pytest.raises(InputRefused, check=coded(code)):
        answers_from_urdf(urdf(tmp_path, old, new), {})


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (("kinematics.a2_m", None), "kinematics.a2_m"),
        (("kinematics.a2_m", "long"), "kinematics.a2_m"),
        (("kinematics.a2_mm", 3300), '"a2_m"'),
        (("name", "../loader"), "name"),
        (("joints.lift.drive.rod_m", 0.2), "joints.lift.drive"),
        (("joints.slew.drive.bore_m", 0.1), "joints.slew.drive"),
        (("joints.lift.drive.levers_m", [0.3]), "lever_at"),
        (("joints.lift.drive.lever_m", 0.0), "joints.lift.drive"),
        (("joints.ext.encoder.unit_m", None), "unit_m"),
        (("grapple.opening_m", 2.0), "1.78"),
    ],
)
def test_answers_that_make_no_machine_are_refused_in_a_sentence(change: tuple[str, object], named: str) -> None:
    with pytest.raises(InputRefused, match=r"^here: ", check=coded("answers.wrong")) as refused:
        answers_of(answers(change), "here")
    assert named in str(refused.value)


def test_the_least_inertia_is_that_of_the_shipped_truth() -> None:
    truth = load_truth("nominal", 0, "palms_471")
    for name, found in least_inertia(load_profile("palms_471"), truth).items():
        assert found == pytest.approx(truth.functions[name].cylinder.least_inertia, rel=0.25), name
