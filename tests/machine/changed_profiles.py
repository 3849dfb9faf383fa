"""Copies of the shipped profiles with some values changed, and the problems found in them."""

from __future__ import annotations

import copy
import json
import tomllib
from pathlib import Path

import pytest

import machine
from machine.loading.profile_file import ProfileError, load_profile
from machine.loading.structure import Problem

FOLDER = Path(machine.__file__).parent
SHIPPED = FOLDER / "palms_471.toml"
RAW = tomllib.loads(SHIPPED.read_text())
AORO = tomllib.loads((FOLDER / "aoro_fc8.toml").read_text())
DELETE = object()


def toml(value) -> str:
    """A TOML document of nested dicts; everything after the top-level scalars as inline tables."""
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{json.dumps(k)} = {toml(v)}" for k, v in value.items()) + " }"
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(map(toml, value)) + "]"
    return json.dumps(value) if isinstance(value, (str, bool)) else repr(value)


def write(folder: Path, changes: dict[str, object], of: dict[str, object] = RAW) -> Path:
    """A copy of a shipped profile with some key paths changed."""
    raw = copy.deepcopy(of)
    for path, value in changes.items():
        *parents, key = path.split(".")
        table = raw
        for parent in parents:
            table = table[parent]
        if value is DELETE:
            del table[key]
        else:
            table[key] = value
    file = folder / "mine.toml"
    file.write_text("".join(f"{k} = {toml(v)}\n" for k, v in raw.items()))
    return file


def problems(folder: Path, changes: dict[str, object], of: dict[str, object] = RAW) -> tuple[Problem, ...]:
    """The problems of a changed copy; its error has one line for each, with the file's name."""
    file = write(folder, changes, of)
    with pytest.raises(ProfileError) as caught:
        load_profile(file)
    assert caught.value.code in ("profile.wrong-structure", "profile.wrong-values")
    assert str(caught.value) == "\n".join(f"{file}: {problem}" for problem in caught.value.problems)
    return caught.value.problems


SAG = {"head_rad_m": 0.005, "pin_rad_m": 0.003, "rest_rad": 0.02}
IMU = {
    "node": 0x23,
    "message": "GrappleImu",
    "gain": 0.3,
    "pendulum_m": 0.8,
    "pin_speed_m_s": 0.12,
    "dead_zone_rad": 0.014,
}
