"""The files of a machine of one's own, in one folder: drafted from answers, and checked against each other."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

from can_dbc.dbc.codec import load
from controller.config import Settings
from controller.crane.startup import TPDO1
from controller.guard.__main__ import build as build_guard
from controller.guard.__main__ import profile_path
from controller.guard.envelope import SHIPPED, read_envelope
from controller.guard.layout import GuardConfigError
from controller.step import Controller
from host.exit_codes import CommandFailed, ExitCode
from machine.draft.answers import Answers, answers_of
from machine.draft.questions import answers_text
from machine.draft.toml_text import envelope_kinematics, envelope_text, profile_text
from machine.geometry.grapple import lowest_pin_m, lowest_tip_below_pin_m
from machine.geometry.kinematics import Unreachable, solve
from machine.loading.profile_file import ProfileError, load_profile, profile_hash
from machine.profile import Profile
from runtime.errors import ConfigError, InputRefused
from sim.draft import truth_and_urdf, truth_problems
from sim.individual import beside, split

ENCODER_SENDER: Final = "ENC"
"""The sender of encoder frames in crane.dbc."""


def make(raw: dict[str, Any], where: str, folder: Path) -> Path:
    """Write the files of the machine of these parsed answers; returns the path of the profile.

    The envelope has no seal: a person checks it first.

    Raises:
        InputRefused: the answers cannot be used.
        CommandFailed: they make no machine, or a file exists or cannot be written.
    """
    answers = answers_of(raw, where)
    texts = _texts(answers)
    present = [folder / name for name in texts if (folder / name).exists()]
    if present:
        text = f"{present[0]} exists and is not overwritten; choose another folder, or remove the old files"
        raise CommandFailed("machine.file-exists", text, ExitCode.USAGE)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name, text in texts.items():
            (folder / name).write_text(text, encoding="utf-8")
    except OSError as error:
        for name in texts:  # none was there before
            with contextlib.suppress(OSError):
                (folder / name).unlink()
        text = f"{folder}: the files cannot be written: {error.strerror}; choose another folder"
        raise CommandFailed("machine.unwritable", text) from None
    return folder / f"{answers.name}.toml"


def _texts(answers: Answers) -> dict[str, str]:
    """Write the text of every file, by its name."""
    drafted = profile_text(answers, encoder_messages())
    with TemporaryDirectory() as scratch:
        path = Path(scratch) / f"{answers.name}.toml"
        path.write_text(drafted, encoding="utf-8")
        try:
            profile = load_profile(path)
        except ProfileError as error:
            text = "\n".join(["these answers make no machine", *map(str, error.problems)])
            raise CommandFailed(error.code, text) from None
    truth, urdf = truth_and_urdf(answers, profile)
    return {
        f"{answers.name}.answers.toml": answers_text(answers),
        f"{answers.name}.toml": drafted,
        f"{answers.name}.envelope.toml": envelope_text(profile),
        f"{answers.name}.truth.toml": truth,
        f"{answers.name}.urdf": urdf,
    }


def encoder_messages() -> dict[int, str]:
    """Return the encoder messages of ``crane.dbc`` by the node that sends them."""
    codecs = load("crane").messages.values()
    return {m.key - TPDO1: m.name for m in codecs if ENCODER_SENDER in m.senders and TPDO1 < m.key < TPDO1 + 0x80}


# -- Checks a machine's profile, envelope, truth and URDF, each by the part that uses it, and against each other.
#
# A problem keeps the machine from starting or contradicts another file; a note says what the machine lacks.

SAME_M: Final = 1e-3
"""Geometry of two files that differs by less is the same [m, rad]."""


@dataclass(frozen=True, slots=True)
class Finding:
    """One finding: a problem, or with ``note`` something that the machine lacks."""

    code: str
    file: str
    sentence: str
    note: bool = False


def check(name: str) -> list[Finding]:
    """Return all findings about the machine of a shipped profile or of a file, problems first."""
    source = profile_path(name)
    try:
        profile = load_profile(name)
    except ProfileError as error:
        if not error.problems:
            return [Finding(error.code, str(source), str(error))]
        return [Finding(p.code, str(source), str(p)) for p in error.problems]
    findings = [
        *_controller(source, profile),
        *_places(source, profile),
        *_envelope(source, profile),
        *_truth(source, profile, name),
        *_urdf(source, profile),
        *_lacking(source, profile),
    ]
    return sorted(findings, key=lambda finding: finding.note)


def _controller(source: Path, profile: Profile) -> Iterator[Finding]:
    """Report what the controller itself refuses at its start: nodes, frames and signals that do not exist."""
    try:
        Controller(Settings(profile, profile_hash(profile), profile.rate_hz))
    except ConfigError as error:
        yield Finding(error.code, str(source), str(error))


def _places(source: Path, profile: Profile) -> Iterator[Finding]:
    """Check whether the tongs reach the ground where logs lie, and the floor of the bunk."""
    hang = lowest_tip_below_pin_m(profile.grapple.jaws)
    places = {
        "workspace.pick_center_m": (*profile.workspace.pick_center_m, profile.workspace.ground_z_m),
        "bunk.center_m": (*profile.bunk.center_m, profile.bunk.floor_z_m),
    }
    for key, (x, y, z) in places.items():
        try:
            solve(profile, x, y, z + hang)
        except Unreachable as error:
            text = f"{key}: the tongs, {hang:.2f} m under the pin, do not get there: {error}"
            yield Finding("machine.out-of-reach", str(source), text)


def _envelope(source: Path, profile: Profile) -> Iterator[Finding]:
    own = source.with_name(f"{profile.name}.envelope.toml")
    file = str(own if own.is_file() else SHIPPED / own.name)
    try:
        build_guard(source)
        envelope = read_envelope(source)
    except GuardConfigError as error:
        yield Finding(error.code, file, str(error))
        return
    guarded, known = envelope.kinematics._asdict(), envelope_kinematics(profile)
    for key, value in known.items():
        if abs(guarded[key] - value) > SAME_M:
            text = (
                f"kinematics.{key} is {guarded[key]:g}, and the profile's geometry makes it {value:g}; the guard would "
                "judge another crane: measure, and correct one of the two"
            )
            yield Finding("machine.other-geometry", file, text)
    lowest_m = lowest_pin_m(profile)
    if envelope.ground_m > lowest_m + SAME_M:
        text = (
            f"ground_m is {envelope.ground_m:g}, and by the profile's ground and grapple the hanger pin works down to "
            f"{lowest_m:g}; the guard would stop the crane over it"
        )
        yield Finding("machine.other-ground", file, text)


def _truth(source: Path, profile: Profile, name: str) -> Iterator[Finding]:
    choice = beside(str(source), profile.name, "nominal")
    _, path = split(choice)
    problems = truth_problems(profile, choice)
    if path is None and any(p.code == "truth.unknown-machine" for p in problems):
        text = f"there is no {profile.name}.truth.toml beside it; the machine cannot be tried on a virtual one"
        yield Finding("machine.no-truth", str(source), text, note=True)
        return
    for problem in problems:
        yield Finding(problem.code, str(path or name), problem.sentence)


def _urdf(source: Path, profile: Profile) -> Iterator[Finding]:
    path = source.with_name(f"{profile.name}.urdf")
    if not path.is_file():
        return
    from machine.draft.from_urdf import answers_from_urdf  # an XML library, which a machine without URDF does not need

    try:
        described = answers_from_urdf(path, {})["kinematics"]
    except InputRefused as error:
        yield Finding(error.code, str(path), str(error))
        return
    for key, value in described.items():
        known = getattr(profile.kinematics, key)
        turned = abs(math.remainder(value - known, math.tau)) if key.endswith("_rad") else abs(value - known)
        if turned > SAME_M:
            text = f"{key} is {value:.4f} by its joints and {known:.4f} in the profile; correct one of the two"
            yield Finding("machine.other-urdf", str(path), text)


def _lacking(source: Path, profile: Profile) -> Iterator[Finding]:
    lacking = {
        "cameras": (not profile.cameras, "no camera: logs come from a list, or with the plant from their true poses"),
        "stability": (profile.stability is None, "no [stability]: load and reach are not judged"),
        "sag": (profile.sag is None, "no [sag]: calibrate with a survey, or the tip sags unseen"),
    }
    for key, (missing, text) in lacking.items():
        if missing:
            yield Finding(f"machine.no-{key}", str(source), text, note=True)
