"""Checks a machine's profile, envelope, truth and URDF, each by the part that uses it, and against each other.

A problem keeps the machine from starting or contradicts another file; a note says what the machine lacks.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from controller.config import Settings
from controller.guard.__main__ import build as build_guard
from controller.guard.__main__ import profile_path
from controller.guard.envelope import SHIPPED, read_envelope
from controller.guard.layout import GuardConfigError
from controller.step import Controller
from machine.draft.toml_text import envelope_kinematics
from machine.geometry.grapple import lowest_pin_m, lowest_tip_below_pin_m
from machine.geometry.kinematics import Unreachable, solve
from machine.loading.profile_file import ProfileError, load_profile, profile_hash
from machine.profile import Profile
from runtime.errors import ConfigError, InputRefused
from sim.draft import truth_problems
from sim.individual import beside, split

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
