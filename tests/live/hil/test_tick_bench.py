"""The judge of `timberhand bench tick`: intervals and verdicts, and the other release."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

from hil.tick import release
from host.exit_codes import CommandFailed
from tests.codes import coded


def test_an_unknown_release_is_refused_by_name() -> None:
    for wanted in ("no-such-tag", "missing.whl"):
        with pytest.raises(CommandFailed, check=coded("tick.against")) as refused:
            release.release(wanted, print)
        assert wanted in str(refused.value)


def test_the_newest_tag_is_the_last_release(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(release, "source_root", lambda: tmp_path)
    assert release.newest_tag() == ""
    git = ["git", "-c", "user.name=n", "-c", "user.email=e"]
    subprocess.run([*git, "init", "-q"], cwd=tmp_path, check=True)
    for tag in ("v2", "v1"):
        stamp = {"v2": "2026-01-01T00:00:00Z", "v1": "2026-01-02T00:00:00Z"}[tag]
        environment = {"GIT_COMMITTER_DATE": stamp, "GIT_AUTHOR_DATE": stamp, "PATH": "/usr/bin:/bin"}
        subprocess.run([*git, "commit", "-q", "--allow-empty", "-m", tag], cwd=tmp_path, env=environment, check=True)
        subprocess.run(["git", "tag", tag], cwd=tmp_path, check=True)
    assert release.newest_tag() == "v1"
