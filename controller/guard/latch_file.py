"""What a restarted guard remembers: a file that is there from the cut until a person's reset.

Only its existence counts, so a loss of power leaves the old state or the new one.  It is written after the frames of
the same step, because they are what stops the machine.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

from controller.guard.layout import GuardConfigError
from runtime.shared_file import make_own_folder, shared_path


def default_path() -> Path:
    """Choose the path: in the folder that systemd keeps for the service, else in this user's one in shared memory."""
    kept = os.environ.get("STATE_DIRECTORY", "").split(":")[0]
    return Path(kept, "latched") if kept else shared_path("guard.latched")


class LatchFile:
    """The file at ``path``; ``latched`` is what it says.  Raises GuardConfigError if it cannot be kept there."""

    __slots__ = ("_complained", "_path", "latched")

    def __init__(self, path: Path) -> None:
        self._path, self._complained = path, False
        try:
            make_own_folder(path.parent)
            self.latched = path.exists()
            beside = path.with_name(f".{path.name}.tried")  # another user's folder, or one that is read-only
            beside.touch()
            beside.unlink()
        except OSError as error:
            raise GuardConfigError(
                "guard.state", f"{path}: the latch cannot be kept there: {error.strerror}; choose another --state FILE."
            ) from error

    def keep(self, latched: bool) -> None:
        """Remember it; what fails is tried again in the next step, and told once."""
        if latched == self.latched:
            return
        try:
            if latched:
                self._path.touch()
            else:
                self._path.unlink(missing_ok=True)
            folder = os.open(self._path.parent, os.O_RDONLY | os.O_DIRECTORY)
            try:
                os.fsync(folder)
            finally:
                os.close(folder)
            self.latched = latched
        except OSError as error:
            if not self._complained:
                sys.stderr.write(f"guard: {self._path}: the latch cannot be kept: {error.strerror}\n")
            self._complained = True
