"""A machine's own profile and envelope, signed, in two places of which a link names the one in use.

::

    /etc/timberhand/machine           -> machine-a or machine-b; PROFILE=/etc/timberhand/machine/profile.toml
    /etc/timberhand/machine-a/        profile.toml, NAME.envelope.toml, machine.sha256, machine.sha256.sig

New files are written and flushed beside the place that is not in use, are checked there, and take that place; then one
rename puts them in use, and the former ones stay for the way back.
"""

from __future__ import annotations

import os
import shutil
from pathlib import Path
from typing import Final

from controller.guard.envelope import read_envelope
from controller.guard.layout import GuardConfigError
from host.exit_codes import CommandFailed
from host.release import sums
from host.release.signature import signature_path, verify
from host.release.trees import flush_folder, point
from machine.loading.profile_file import ProfileError, load_profile

PLACE: Final = Path("/etc/timberhand")
LINK: Final = "machine"
PROFILE: Final = "profile.toml"
SUMS: Final = "machine.sha256"
SLOTS: Final = ("machine-a", "machine-b")


def check(folder: Path, public: Path) -> list[str]:
    """Check a folder of machine files: signature, hashes, and that controller and guard take them; returns their names.

    Raises:
        CommandFailed: they are not what somebody with that key signed, or do not fit together.
    """
    if not (folder / SUMS).is_file():
        raise CommandFailed(
            "machine-files.no-sums",
            f"{folder} holds no {SUMS}; make it with `sha256sum *.toml > {SUMS}` and sign it: timberhand release sign",
        )
    verify(folder / SUMS, public)
    listed = sums.decode((folder / SUMS).read_text(), str(folder / SUMS))
    toml_names = {path.name for path in folder.glob("*.toml")}
    if wrong := sums.differing(folder, listed) or sorted(toml_names - listed.keys()):
        raise CommandFailed(
            "machine-files.changed", f"{folder / wrong[0]} is not what was signed; sign it again, or restore it"
        )
    if PROFILE not in listed:
        raise CommandFailed("machine-files.no-profile", f"{folder} holds no {PROFILE}; name the machine's profile so")
    try:
        load_profile(str(folder / PROFILE))
        read_envelope(folder / PROFILE)
    except (ProfileError, GuardConfigError) as error:
        raise CommandFailed(error.code, str(error).splitlines()[0]) from error
    return sorted(listed)


def apply(folder: Path, public: Path, place: Path = PLACE) -> Path:
    """Put a folder's machine files in use; returns the profile's path, for the setting PROFILE.

    Raises:
        CommandFailed: they are refused, or cannot be written; the former ones are in use.
    """
    names = check(folder, public)
    slot = place / SLOTS[_in_use(place) == SLOTS[0]]
    fresh = slot.with_name(f"{slot.name}.new")
    try:
        if (given := folder.resolve()) in [(place / name).resolve() for name in SLOTS]:
            point(place / LINK, given.name)
            return place / LINK / PROFILE
        contents = {name: (folder / name).read_bytes() for name in (*names, SUMS, signature_path(Path(SUMS)).name)}
        shutil.rmtree(fresh, ignore_errors=True)
        fresh.mkdir()
        fresh.chmod(0o755)  # whatever the umask: the services read them as users of their own
        for name, content in contents.items():
            (fresh / name).write_bytes(content)
            (fresh / name).chmod(0o644)
        os.sync()
        check(fresh, public)  # what lies there, not what it was copied from
        shutil.rmtree(slot, ignore_errors=True)
        os.rename(fresh, slot)
        flush_folder(place)
        point(place / LINK, slot.name)
    except OSError as error:
        sentence = f"{folder} cannot be put in use at {place}: {error.strerror}; the files in use are as they were"
        raise CommandFailed("machine-files.not-written", sentence) from None
    finally:
        shutil.rmtree(fresh, ignore_errors=True)
    return place / LINK / PROFILE


def revert(public: Path, place: Path = PLACE) -> Path:
    """Put the former machine files in use again; returns the profile's path.

    Raises:
        CommandFailed: there are none, or they are not what was signed.
    """
    slot = place / SLOTS[_in_use(place) == SLOTS[0]]
    if not slot.is_dir():
        raise CommandFailed(
            "machine-files.no-former", "there are no former machine files to go back to; apply the ones that you want"
        )
    check(slot, public)
    point(place / LINK, slot.name)
    return place / LINK / PROFILE


def _in_use(place: Path) -> str | None:
    try:
        return os.readlink(place / LINK)
    except OSError:
        return None
