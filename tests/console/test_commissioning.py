"""Commissioning without a browser: one procedure at a time, and protocols that are written once."""

from __future__ import annotations

import json
import os
import threading
from pathlib import Path

import pytest

from console.commission_api import _write_once
from console.commissioning import Commissioning
from machine.joints import Joint
from machine.loading.profile_file import load_profile, profile_file, profile_hash
from runtime.errors import InputRefused
from tests.codes import coded

PROFILE = load_profile("palms_471")


def test_a_procedure_that_begins_while_another_is_planned_is_the_only_one(tmp_path: Path) -> None:
    """Planning a calibration takes a second beside the server, in which a step can begin."""
    code, source = profile_hash(PROFILE), profile_file("palms_471")
    work = Commissioning(PROFILE, code, source, tmp_path, ("127.0.0.1", 1), "wire:none", None, lambda: None)
    work._thread = threading.current_thread()  # a procedure that runs
    with pytest.raises(InputRefused, check=coded("commission.busy")):
        work.step_joint(Joint.SLEW, 0.1, lambda: True)


def test_of_two_pages_that_save_one_name_at_once_the_first_keeps_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, link = tmp_path / "a.protocol.json", os.link

    def overtaken(draft: Path, final: Path) -> None:
        monkeypatch.setattr(os, "link", link)
        other = threading.Thread(target=_write_once, args=(path, {"by": "the other"}))
        other.start()
        other.join()
        os.link(draft, final)

    monkeypatch.setattr(os, "link", overtaken)
    with pytest.raises(FileExistsError):
        _write_once(path, {"by": "this one"})
    assert json.loads(path.read_bytes()) == {"by": "the other"}
    assert list(tmp_path.iterdir()) == [path]
