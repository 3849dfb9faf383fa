"""Files that belong to a machine and lie beside its profile, by name: ``NAME.envelope.toml``, the guard's limits."""

from __future__ import annotations

import shutil
from pathlib import Path

from machine.loading.profile_file import SHIPPED_FOLDER, load_profile


def carry_envelope(profile: Path, folder: Path) -> None:
    """Copy the envelope beside a profile into ``folder``, where a changed copy of that profile is written.

    The guard looks beside the profile first, then among the shipped envelopes, so a shipped one is not copied.
    """
    if profile.parent.resolve() in (SHIPPED_FOLDER, folder.resolve()):
        return
    envelope = profile.with_name(f"{load_profile(profile).name}.envelope.toml")
    if envelope.is_file():
        shutil.copy(envelope, folder)
