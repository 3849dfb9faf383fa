"""Both wheels install and answer: the pure one for every platform, and the one with the compiled tick."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import sysconfig
from pathlib import Path

import pytest

from host.compiled.build import check_tools
from host.exit_codes import CommandFailed
from runtime.compiled import SWITCH

pytestmark = pytest.mark.timeout(900)
ROOT = Path(__file__).parents[3]
LEFT_OUT = (".git", ".venv", "build", "dist", "runs", "tests", "docs", "*.egg-info", "__pycache__", ".*_cache")
ANSWER = """
import sys
sys.path.append(sys.argv[1])
from runtime import compiled
compiled.activate()
from controller.config import load
from controller.step import Controller, step
from controller.tick import Inputs
outputs = step(Controller(load("palms_471")), Inputs(), 10**9)
from can_dbc.dbc.codegen import AHEAD_OF_TIME
print(compiled.running().kind, bool(AHEAD_OF_TIME), len(outputs.frames), outputs.sync[1].hex())
"""


def install(tmp_path: Path, compiled: str) -> tuple[Path, Path]:
    """The wheel, and the folder that it is installed into."""
    wheel, target = build(tmp_path, compiled), tmp_path / "installed"
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "--quiet"]
    subprocess.run([*pip, "install", "--no-deps", "--target", target, wheel], check=True, capture_output=True)
    return wheel, target


def build(tmp_path: Path, compiled: str) -> Path:
    """A wheel of a copy of the sources."""
    source, wheels = tmp_path / "source", tmp_path / "wheels"
    # Every copy has times of its own.
    shutil.copytree(ROOT, source, ignore=shutil.ignore_patterns(*LEFT_OUT), copy_function=shutil.copy)
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "--quiet"]
    environment = os.environ | {"TIMBERHAND_COMPILE": compiled}
    made = subprocess.run(
        [*pip, "wheel", "--no-deps", "--no-build-isolation", "-w", wheels, source],
        env=environment,
        cwd=source,
        capture_output=True,
        text=True,
    )
    assert made.returncode == 0, made.stderr[-2000:]
    (wheel,) = wheels.iterdir()
    return wheel


def answer(target: Path, **environment: str) -> list[str]:
    """What a controller from the installed wheel answers; the other packages are those of this environment."""
    done = subprocess.run(
        [sys.executable, "-S", "-c", ANSWER, sysconfig.get_path("purelib")],
        env={**os.environ, "PYTHONPATH": str(target), **environment},
        cwd=target,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr[-2000:]
    return done.stdout.split()


def test_the_pure_wheel_runs_on_the_interpreter_and_a_second_one_is_the_same_to_the_byte(tmp_path: Path) -> None:
    wheel, target = install(tmp_path, "0")
    assert wheel.name.endswith("py3-none-any.whl")
    assert answer(target, HOME=str(tmp_path))[0] == "interpreter"
    assert build(tmp_path / "again", "0").read_bytes() == wheel.read_bytes()


def test_the_compiled_wheel_runs_compiled_and_the_switch_turns_it_off(tmp_path: Path) -> None:
    try:
        check_tools()
    except CommandFailed as missing:
        pytest.skip(str(missing))
    wheel, target = install(tmp_path, "1")
    assert "none-any" not in wheel.name
    kind, codecs, *outputs = answer(target)
    assert (kind, codecs) == ("compiled", "True")
    assert answer(target, **{SWITCH: "0"}) == ["interpreter", "False", *outputs]
