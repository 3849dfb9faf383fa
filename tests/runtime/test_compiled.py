"""Which tick runs: a build is used only as a whole, for exactly the sources and the Python it was made for."""

from __future__ import annotations

import importlib
import json
import os
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from runtime import compiled


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """A tree with one module in a package of ours."""
    folder = tmp_path / "tree" / "runtime"
    folder.mkdir(parents=True)
    (folder / "__init__.py").write_text("")
    (folder / "served_module.py").write_text("ORIGIN = 'interpreter'\n")
    return tmp_path / "tree"


@pytest.fixture(autouse=True)
def clean(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """This process goes on without the finders of a test."""
    monkeypatch.delenv(compiled.SWITCH, raising=False)
    finders, before = list(sys.meta_path), compiled.running()
    yield
    sys.meta_path[:] = finders
    compiled._running = before
    sys.modules.pop("runtime.served_module", None)


def make_build(root: Path, folder: Path, key: str = "0123456789abcdef", **changes: object) -> Path:
    """A build whose compiled module is a Python file that says so."""
    build = folder / key
    build.mkdir(parents=True)
    (build / "served.py").write_text("ORIGIN = 'compiled'\n")
    source = "runtime/served_module.py"
    manifest = {
        "platform": compiled.platform_tag(),
        "mypy": "1",
        "modules": ["runtime.served_module"],
        "sources": {source: compiled.hash_of(root / source)},
        "files": {"runtime.served_module": "served.py"},
    }
    (build / compiled.MANIFEST).write_text(json.dumps(manifest | changes))
    return build


def test_a_build_that_fits_serves_its_modules_by_full_name(root: Path, tmp_path: Path) -> None:
    make_build(root, tmp_path / "builds")
    running = compiled.activate(root, tmp_path / "builds")
    assert running == compiled.running() == compiled.Running("compiled", "0123456789abcdef")
    assert importlib.import_module("runtime.served_module").ORIGIN == "compiled"


def test_without_a_build_the_interpreter_runs(root: Path, tmp_path: Path) -> None:
    assert compiled.activate(root, tmp_path / "builds").kind == "interpreter"
    assert compiled.find_build(root, tmp_path / "builds")[0] is None


def test_one_changed_or_removed_source_file_refuses_the_whole_build_and_is_named(root: Path, tmp_path: Path) -> None:
    make_build(root, tmp_path / "builds")
    finders, source = list(sys.meta_path), root / "runtime" / "served_module.py"
    source.write_text("ORIGIN = 'changed'\n")
    running = compiled.activate(root, tmp_path / "builds")
    assert running.kind == "interpreter" and "runtime/served_module.py" in running.reason
    source.unlink()
    assert compiled.activate(root, tmp_path / "builds").kind == "interpreter", "nor without it"
    assert sys.meta_path == finders


def test_of_several_builds_that_do_not_fit_the_newest_is_named(root: Path, tmp_path: Path) -> None:
    for age, key in enumerate(("b", "c", "a")):
        made = make_build(root, tmp_path / "builds", key, platform=f"platform {key}")
        os.utime(made / compiled.MANIFEST, ns=(0, 10**18 - age * 10**9))
    assert "platform b" in compiled.find_build(root, tmp_path / "builds")[1]


def test_a_served_name_without_a_file_is_no_module(root: Path, tmp_path: Path) -> None:
    finder = compiled._Finder({"runtime.served_module": tmp_path / "missing.py"})
    with pytest.raises(ModuleNotFoundError):
        finder.find_spec("runtime.served_module", None)


@pytest.mark.parametrize(
    "changes", [{"platform": "3.9.1.cpython-39-riscv64-linux-gnu.so"}, {"files": {"a": "gone.so"}}, {"sources": None}]
)
def test_another_platform_a_missing_file_or_a_broken_manifest_refuses_the_build(
    root: Path, tmp_path: Path, changes: dict[str, object]
) -> None:
    make_build(root, tmp_path / "builds", **changes)
    assert compiled.activate(root, tmp_path / "builds").kind == "interpreter"


def test_the_switch_keeps_the_interpreter(root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    make_build(root, tmp_path / "builds")
    monkeypatch.setenv(compiled.SWITCH, "0")
    assert compiled.activate(root, tmp_path / "builds").kind == "interpreter"


def test_the_guard_reads_sources_where_extension_modules_lie_beside_them(root: Path) -> None:
    suffix = compiled.EXTENSION_SUFFIXES[0]
    (root / "controller").mkdir()
    for name in ("controller/step", "runtime/served_module"):
        (root / f"{name}{suffix}").write_bytes(b"not an extension module")
    compiled.stay_interpreted(root)
    assert importlib.import_module("runtime.served_module").ORIGIN == "interpreter"
    text = (compiled.source_root() / "controller" / "guard" / "__main__.py").read_text()
    assert text.index("    stay_interpreted()") < text.index("from can_dbc"), "before the buses are imported"


def test_a_module_that_was_imported_before_refuses_the_build(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    make_build(root, tmp_path / "builds", files={"runtime.errors": "served.py"})
    running = compiled.activate(root, tmp_path / "builds")
    assert running.kind == "interpreter" and "runtime.errors" in running.reason


def test_this_process_runs_on_the_interpreter() -> None:
    """Tests replace parts of modules, which calls inside compiled modules do not see."""
    assert compiled.running().kind == "interpreter" or compiled.running().key == "installed"


def test_the_key_changes_with_sources_platform_and_compiler() -> None:
    manifest = {"platform": "p", "mypy": "1", "modules": ["m"], "sources": {"a.py": "1"}}
    keys = {
        compiled.key_of(manifest | change)
        for change in ({}, {"platform": "q"}, {"mypy": "2"}, {"modules": []}, {"sources": {"a.py": "2"}})
    }
    assert len(keys) == 5
