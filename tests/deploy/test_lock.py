"""The lists of what an installation fetches: complete, of the versions that are tested, with a hash of every file."""

from __future__ import annotations

import re
import tomllib
from importlib import metadata
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet
from packaging.utils import canonicalize_name

from host.release.bundle import Lock

ROOT = Path(__file__).parents[2]
EXTRAS = {Lock.MACHINE: {"autonomy", "console", "plc", "update"}}
EXTRAS[Lock.PLANT] = EXTRAS[Lock.MACHINE] | {"sim"}
TARGETS = ({"platform_machine": "x86_64"}, {"platform_machine": "aarch64"})
"""Debian 12 on both processors, as far as it differs from this interpreter."""
STALE = "run: make lock"


def locked(lock: Lock) -> dict[str, tuple[str, int]]:
    """Name -> version and number of hashes, of what is installed on Linux."""
    text = (ROOT / f"deploy/lock/{lock}.txt").read_text().replace("\\\n", " ")
    found = {}
    for line in text.splitlines():
        if line.strip() and not line.startswith("#"):
            need = Requirement(line.split("--hash")[0].strip())
            hashes = re.findall(r"--hash=sha256:[0-9a-f]{64}(?= |$)", line)
            assert line.count("--hash") == len(hashes) > 0, need.name
            (version,) = need.specifier
            if need.marker is None or need.marker.evaluate():
                found[canonicalize_name(need.name)] = version.version, len(hashes)
    return found


def needed(extras: set[str]) -> set[str]:
    """Every package that the program needs with these extras, by what the installed ones say of themselves."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    groups = project["optional-dependencies"]
    open_ = [Requirement(text) for text in [*project["dependencies"], *(t for e in extras for t in groups[e])]]
    seen: set[tuple[str, str]] = set()
    while open_:
        need = open_.pop()
        if need.marker is not None and not any(need.marker.evaluate({"extra": "", **target}) for target in TARGETS):
            continue
        for extra in ("", *need.extras):
            if (key := (canonicalize_name(need.name), extra)) in seen:
                continue
            seen.add(key)
            for text in metadata.requires(need.name) or ():
                inner = Requirement(text)
                if inner.marker is None or any(inner.marker.evaluate({"extra": extra, **t}) for t in TARGETS):
                    inner.marker = None
                    open_.append(inner)
    return {name for name, _ in seen}


@pytest.mark.parametrize("lock", Lock)
def test_the_list_holds_what_the_program_needs_and_nothing_else(lock: Lock) -> None:
    assert set(locked(lock)) == needed(EXTRAS[lock]), STALE


@pytest.mark.parametrize("lock", Lock)
def test_the_list_has_the_versions_that_are_tested(lock: Lock) -> None:
    pinned = {
        canonicalize_name(need.name): next(iter(need.specifier)).version
        for line in (ROOT / "constraints.txt").read_text().splitlines()
        if line and not line.startswith("#") and (need := Requirement(line))
    }
    assert {name: version for name, (version, _) in locked(lock).items()} == {
        name: pinned[name] for name in locked(lock)
    }, STALE


def test_the_plant_s_list_adds_the_plant_alone() -> None:
    machine, plant = locked(Lock.MACHINE), locked(Lock.PLANT)
    assert machine.items() <= plant.items()
    assert "pybullet" in set(plant) - set(machine)


def test_every_pinned_package_installs_on_the_python_of_debian_12() -> None:
    """``requires-python`` of each installed distribution admits 3.11.2, also where a later 3.11 runs this test."""
    pinned = {canonicalize_name(Requirement(line).name) for line in constraints()}
    wants = {canonicalize_name(d.name): d.metadata["Requires-Python"] for d in metadata.distributions()}
    refused = {name: wants[name] for name in pinned & wants.keys() if wants[name] and not admits(wants[name])}
    assert refused == {}


def constraints() -> list[str]:
    return [line for line in (ROOT / "constraints.txt").read_text().splitlines() if "==" in line.split("#")[0]]


def admits(requires_python: str) -> bool:
    return SpecifierSet(requires_python).contains("3.11.2")
