"""Compiling the tick: what a build depends on, missing tools, and the command."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import pytest

from host.compiled import build
from host.compiled.modules import MODULES
from host.compiled.tree import needed_sources
from host.exit_codes import CommandFailed, ExitCode
from tests.codes import coded

ROOT = Path(__file__).parents[2]


def test_every_compiled_module_exists_once_in_order_and_knows_no_file_of_its_own() -> None:
    assert sorted(set(MODULES)) == sorted(MODULES)
    for module in MODULES:
        assert "__file__" not in ROOT.joinpath(*module.split(".")).with_suffix(".py").read_text(), module


def test_a_build_depends_on_the_modules_and_on_what_they_import() -> None:
    needed = {str(path) for path in needed_sources(ROOT)}
    assert {"controller/step.py", "machine/profile.py", "can_dbc/frame.py"} <= needed
    assert not any(path.startswith(("controller/guard", "controller/plc")) for path in needed)


def test_without_a_c_compiler_the_command_names_the_package(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(build.shutil, "which", lambda name: None)
    with pytest.raises(CommandFailed, check=coded("compile.no-compiler")) as refused:
        build.check_tools()
    assert refused.value.exit_code is ExitCode.CONFIGURATION


def test_without_mypyc_the_command_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(build.shutil, "which", lambda name: "/usr/bin/cc")
    monkeypatch.setattr(build.Path, "is_file", lambda path: True)
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(CommandFailed, check=coded("compile.no-mypyc")):
        build.check_tools()
