"""Answers about the example's machine, as parsed TOML that a test changes; and its files in a folder, sealed."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from controller.guard.seal import main as seal
from machine.draft.answers import read_answers as read
from machine.draft.questions import EXAMPLE
from timberhand.machine_files import make

NAME = "truck_loader"


def answers(*changes: tuple[str, Any]) -> dict[str, Any]:
    """The example's answers with values changed by their key path; None removes a key."""
    raw = read(EXAMPLE)
    for path, value in changes:
        *tables, key = path.split(".")
        table = raw
        for name in tables:
            table = table[name]
        if value is None:
            del table[key]
        else:
            table[key] = value
    return raw


def made(folder: Path, *changes: tuple[str, Any]) -> Path:
    """The profile of the machine of these answers, with all its files; its envelope is sealed."""
    profile = make(answers(*changes), "answers", folder)
    assert seal([str(profile.with_name(f"{profile.stem}.envelope.toml"))]) == 0
    return profile
