"""The arm64 wheel, cross-compiled here, gives the bytes of the interpreter there, and its bundle runs, in emulation."""

from __future__ import annotations

import json
import os
import platform
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from can_dbc.messages.envelope import write_key
from host.exit_codes import CommandFailed, ExitCode
from host.release import bundle as bundles
from tests.codes import coded
from tests.host.small_releases import keys

pytestmark = pytest.mark.timeout(1800)
ROOT = Path(__file__).parents[3]
TOOL_MISSING = 3


def run(script: str, *arguments: object) -> str:
    """A script's answer; skips by its own sentence when a tool or the network is missing."""
    done = subprocess.run(
        ["sh", ROOT / "deploy" / "arm64" / script, *map(str, arguments)],
        env={**os.environ, "PYTHON": sys.executable},
        capture_output=True,
        text=True,
    )
    if done.returncode == TOOL_MISSING:
        pytest.skip(done.stderr.strip().splitlines()[-1])
    assert done.returncode == 0, done.stdout + done.stderr[-2000:]
    return done.stdout


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel, cross-compiled here."""
    folder = tmp_path_factory.mktemp("dist")
    run("build.sh", folder)
    (made,) = folder.glob("*-linux_aarch64.whl")
    return made


def test_the_arm64_wheel_gives_the_bytes_of_the_interpreter_there(wheel: Path) -> None:
    names = zipfile.ZipFile(wheel).namelist()
    assert "can_dbc/dbc/compiled_codecs.cpython-311-aarch64-linux-gnu.so" in names
    found = [json.loads(line) for line in run("replay.sh", wheel).splitlines()]
    assert [(row["tick"], row["machine"], row["ticks"]) for row in found] == [
        (tick, "aarch64", ticks) for ticks in (1600, 2200) for tick in ("interpreter", "compiled installed")
    ]
    for interpreter, compiled in zip(found[::2], found[1::2], strict=True):
        assert interpreter["digest"] == compiled["digest"]
    assert found[0]["differing"] == 0  # the fixed crane; the forwarder's differs from amd64 on both


def test_a_signed_bundle_for_arm64_brings_all_that_runs_there(
    wheel: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nothing but the bundle's own wheels: the program names its version, and refuses a bus that is not there."""
    private, public = keys(tmp_path)
    folder = tmp_path / "unpacked"
    bundles.unpack(bundles.make(wheel, private, tmp_path, None, bundles.Lock.MACHINE), folder)
    if platform.machine() != "aarch64":
        with pytest.raises(CommandFailed, match="aarch64", check=coded("bundle.other-machine")):
            bundles.check(folder, public)
    monkeypatch.setattr(platform, "machine", lambda: "aarch64")
    release = bundles.check(folder, public)
    tags = {name.stem.rpartition("-")[2] for name in (folder / "wheels").iterdir()}
    assert "any" in tags and all(tag == "any" or tag.endswith("aarch64") for tag in tags), tags
    site = tmp_path / "site"
    for part in (folder / "wheels").iterdir():
        with zipfile.ZipFile(part) as archive:
            archive.extractall(site)
    version = emulated(site, "-m", "timberhand", "--version")
    assert version.returncode == 0 and release.version in version.stdout, version.stderr
    bus = ("--bus", "crane0=wire:nowhere", "--setpoint-port", "0", "--key-file", str(write_key(tmp_path / "key")))
    lost = emulated(site, "-m", "controller", "--profile", "palms_471", *bus)
    assert lost.returncode == ExitCode.BUS and "nowhere" in lost.stderr, lost.stderr


def emulated(site: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Debian's Python for arm64 with these packages alone."""
    root = ROOT / "build" / "arm64" / "root"
    python = ("qemu-aarch64-static", "-L", root, "-E", f"PYTHONPATH={site}", root / "usr/bin/python3.11", "-P")
    return subprocess.run([*python, *arguments], capture_output=True, text=True, timeout=300)
