"""``timberhand machine``: what `new` drafts passes `check`, and what is broken or contradictory is named."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from host.exit_codes import ExitCode
from tests.machine.own_machine import NAME, made


@pytest.fixture(scope="module")
def drafted(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The example's files, which a test copies before it changes them."""
    return made(tmp_path_factory.mktemp("drafted")).parent


@pytest.fixture
def profile(drafted: Path, tmp_path: Path) -> Path:
    """A copy of the example's files; returns its profile."""
    return shutil.copytree(drafted, tmp_path / "mine") / f"{NAME}.toml"


def test_an_envelope_without_a_seal_stops_a_run_with_one_sentence(profile: Path, tmp_path: Path) -> None:
    envelope = profile.with_name(f"{NAME}.envelope.toml")
    envelope.write_text(re.sub(r"# sha256: .*", "", envelope.read_text()))
    done = subprocess.run(
        [sys.executable, "-m", "timberhand", "demo", "--lockstep", "--profile", profile, "--out", tmp_path / "run"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == ExitCode.CONFIGURATION, done.stderr
    assert "Traceback" not in done.stderr and "controller.guard.seal" in done.stderr and "[guard." in done.stderr
