"""Former spellings of commands and options keep working, with one note each on stderr."""

from __future__ import annotations

import subprocess
import sys


def test_the_command_notes_the_new_spelling_on_stderr() -> None:
    command = [sys.executable, "-m", "timberhand", "log", "decode", "--help"]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert "recording decode" in done.stdout
    (note,) = done.stderr.splitlines()
    assert "`log`" in note and "`recording`" in note
