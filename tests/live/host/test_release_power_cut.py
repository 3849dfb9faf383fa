"""An update that is killed at any moment leaves the old release or the new one, whole and in use."""

from __future__ import annotations

import os
import shutil
import signal
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from host.exit_codes import CommandFailed, ExitCode
from host.release.trees import Trees
from tests.codes import coded
from tests.host.small_releases import NotedProgram, NotedServices, install, keys, small_bundle, updater

CHANGES = ("os.rename", "os.remove", "os.mkdir", "os.rmdir", "os.symlink", "os.truncate")
MOST = 400
"""More moments than an update has."""


@pytest.fixture(autouse=True)
def without_flushing(monkeypatch: pytest.MonkeyPatch) -> None:
    """A killed process loses nothing that it wrote, so flushing the whole computer's disks only takes time here."""
    monkeypatch.setattr(os, "sync", lambda: None)
    monkeypatch.setattr(os, "fsync", lambda _: None)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[list[Path], Path]:
    """Three bundles, and the key that they are signed with."""
    folder = tmp_path_factory.mktemp("bundles")
    private, public = keys(folder)
    return [small_bundle(folder / version, version, private) for version in ("1.0", "2.0", "3.0")], public


@pytest.fixture(scope="module")
def installed(made: tuple[list[Path], Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An installation that was updated once: 2.0 is in use, 1.0 is the previous release."""
    (first, second, _), signer = made
    trees = Trees(tmp_path_factory.mktemp("installed"))
    install(trees, first, signer)
    updater(trees, signer, NotedServices(trees)).update(second)
    return trees.place


@pytest.fixture
def trees(tmp_path: Path) -> Trees:
    return Trees(tmp_path / "opt")


def version(name: str | None) -> str:
    return (name or "none").partition("-")[0]


def killed_at(moment: int, place: Path, change: Callable[[Callable[[str], None]], None]) -> bool:
    """Make a change in a process that dies just before its change number ``moment``; False when it ended before.

    Counted is every change that it makes to the disk below ``place``, and whatever ``change`` notes itself.
    """
    pid = os.fork()
    if pid:
        _, status = os.waitpid(pid, 0)
        assert os.WIFSIGNALED(status) or os.WEXITSTATUS(status) == 0, f"the update failed at {moment}"
        return os.WIFSIGNALED(status)
    count = 0

    def note(_: str) -> None:
        nonlocal count
        count += 1
        if count == moment:
            os.kill(os.getpid(), signal.SIGKILL)

    def audit(event: str, arguments: tuple[Any, ...]) -> None:
        writes = event == "open" and isinstance(arguments[2], int) and arguments[2] & (os.O_WRONLY | os.O_RDWR)
        if (writes or event in CHANGES) and str(place) in str(arguments[0]):
            note(event)

    status = 1
    try:
        sys.addaudithook(audit)
        change(note)
        status = 0
    finally:
        os._exit(status)


def moments(installed: Path, place: Path, change: Callable[[Callable[[str], None]], None]) -> Iterator[int]:
    """Every moment at which ``change`` can be cut off; at each of them ``place`` is as the power cut left it."""
    for moment in range(1, MOST):
        shutil.rmtree(place, ignore_errors=True)
        shutil.copytree(installed, place, symlinks=True)
        if not killed_at(moment, place, change):
            return
        yield moment
    pytest.fail("the update has more moments than this test tries")


def is_whole(trees: Trees) -> str:
    """The version in use; every file of it must be there."""
    name = trees.state().current
    assert name in trees.whole(), f"{name} is in use and not whole"
    tree = trees.tree(name) / "site"
    for file in ("machine/palms.toml", "can_dbc/crane.dbc", "autonomy/weights/logs.onnx"):
        assert version(name) in (tree / file).read_text()
    return version(name)


def boot(trees: Trees, signer: Path, broken: str = "no release") -> None:
    """The computer's start: the services come up, and where there is a trial, its unit finishes it."""
    services = NotedServices(trees, broken)
    services.start()
    if (trees.place / "trial").is_symlink():
        try:
            updater(trees, signer, services).resume()
        except CommandFailed as refused:
            assert refused.exit_code == ExitCode.FIGURE_MISSED


def test_an_update_cut_off_at_any_moment_leaves_the_old_release_or_the_new_one(
    made: tuple[list[Path], Path], installed: Path, trees: Trees
) -> None:
    (_, _, bundle), signer = made

    def change(note: Callable[[str], None]) -> None:
        services, program = NotedServices(trees, note=note), NotedProgram(note)
        updater(trees, signer, services, program, note).update(bundle)

    left: list[str] = []
    for moment in moments(installed, trees.place, change):
        found = is_whole(trees)
        left.append(found)
        boot(trees, signer)
        assert is_whole(trees) == found, f"moment {moment}: a good release stays"
        assert trees.state().trial is None
        assert version(trees.state().previous) == ("1.0" if found == "2.0" else "2.0")
        updater(trees, signer, NotedServices(trees)).update(bundle)
        assert is_whole(trees) == "3.0", f"moment {moment}: the next update works"
        assert sorted(map(version, trees.whole())) == ["2.0", "3.0"] and not trees.incoming.exists()
    assert left == sorted(left) and set(left) == {"2.0", "3.0"}, "there is one moment of change"
    assert len(left) > 40


def test_a_bad_release_cut_off_at_any_moment_ends_in_the_old_one(
    made: tuple[list[Path], Path], installed: Path, trees: Trees
) -> None:
    """Also when the power fails on the way back."""
    (_, _, bundle), signer = made

    def change(note: Callable[[str], None]) -> None:
        services = NotedServices(trees, "3.0", note)
        with pytest.raises(CommandFailed, check=coded("update.gate")):
            updater(trees, signer, services, NotedProgram(note), note).update(bundle)

    for moment in moments(installed, trees.place, change):
        is_whole(trees)
        boot(trees, signer, broken="3.0")
        assert is_whole(trees) == "2.0", f"moment {moment}"
        assert trees.state().trial is None and version(trees.state().previous) == "1.0"


def test_a_rollback_cut_off_at_any_moment_leaves_the_one_or_the_other(
    made: tuple[list[Path], Path], installed: Path, trees: Trees
) -> None:
    _, signer = made

    def change(note: Callable[[str], None]) -> None:
        updater(trees, signer, NotedServices(trees, note=note), NotedProgram(note), note).rollback()

    left = []
    for _ in moments(installed, trees.place, change):
        left.append(is_whole(trees))
        boot(trees, signer)
        assert is_whole(trees) == left[-1] and trees.state().trial is None
        assert {version(trees.state().current), version(trees.state().previous)} == {"1.0", "2.0"}
    assert set(left) == {"1.0", "2.0"} and left == sorted(left, reverse=True)
