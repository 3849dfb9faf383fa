"""Files beside a profile: the envelope goes with a changed copy, and a shipped one stays."""

from __future__ import annotations

from pathlib import Path

import pytest

from controller.guard.__main__ import build, profile_path
from controller.guard.layout import GuardConfigError
from machine.loading.profile_file import carry_envelope
from tests.codes import coded
from tests.machine.own_machine import NAME, made


def test_a_changed_copy_elsewhere_takes_the_envelope_along(tmp_path: Path) -> None:
    profile, copy = made(tmp_path / "mine"), tmp_path / "changed" / "calibrated.toml"
    copy.parent.mkdir()
    copy.write_text(profile.read_text())
    with pytest.raises(GuardConfigError, check=coded("guard.envelope-missing")):
        build(copy)
    carry_envelope(profile, copy.parent)
    build(copy)
    assert [p.name for p in sorted(copy.parent.iterdir())] == ["calibrated.toml", f"{NAME}.envelope.toml"]


def test_a_shipped_envelope_is_not_copied(tmp_path: Path) -> None:
    carry_envelope(profile_path("palms_471"), tmp_path)
    assert list(tmp_path.iterdir()) == []
