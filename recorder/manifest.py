"""``manifest.json``: identifies the software, the machine and the time of a recording.

In lockstep a recording contains nothing of the host or its clock, so that a seed gives the same bytes on every run.
Live, the manifest has one pair of monotonic and UTC time; adding their difference to a monotonic stamp gives UTC.  It
is written to a temporary file, flushed to the disk and renamed.
"""

from __future__ import annotations

import datetime
import hashlib
import os
import time
from importlib.metadata import version
from pathlib import Path

import msgspec

from can_dbc.dbc.codec import resolve
from machine.loading.profile_file import profile_hash
from machine.profile import Profile

NAME = "manifest.json"


class Manifest(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """Identity of a recording; ``complete`` and ``dropped`` are set when it closes.

    ``dropped`` counts records lost to a full disk, and frames that arrived faster than the recorder could receive them.
    """

    timberhand: str
    profile: str
    profile_hash: str
    dbc_hash: dict[str, str]
    buses: tuple[str, ...]
    seed: int | None = None
    start_monotonic_ns: int | None = None
    start_utc_ns: int | None = None
    start_utc: str | None = None
    complete: bool = False
    dropped: int = 0

    @property
    def live(self) -> bool:
        """True for a recording in real time, which must survive a power cut."""
        return self.start_utc_ns is not None

    @property
    def utc_offset_ns(self) -> int:
        """UTC minus monotonic time [ns]; 0 in lockstep."""
        return (self.start_utc_ns or 0) - (self.start_monotonic_ns or 0)


def describe(profile: Profile, buses: tuple[str, ...], seed: int | None = None, live: bool = False) -> Manifest:
    """Describe a recording that starts now; reads the clock only with ``live``."""
    shipped = {name for bus, names in databases(profile).items() if bus in buses for name in names}
    manifest = Manifest(
        timberhand=version("timberhand"),
        profile=profile.name,
        profile_hash=f"{profile_hash(profile):08x}",
        dbc_hash={name: hashlib.sha256(resolve(name).read_bytes()).hexdigest() for name in sorted(shipped)},
        buses=buses,
        seed=seed,
    )
    if not live:
        return manifest
    utc_ns = time.time_ns()
    utc = datetime.datetime.fromtimestamp(utc_ns // 10**9, datetime.UTC)
    return msgspec.structs.replace(
        manifest,
        start_monotonic_ns=time.monotonic_ns(),
        start_utc_ns=utc_ns,
        start_utc=utc.strftime("%Y-%m-%dT%H:%M:%SZ"),
    )


def databases(profile: Profile) -> dict[str, tuple[str, ...]]:
    """Map each bus name to the databases of its messages."""
    buses = {profile.crane_bus: ("crane",)}
    return buses | ({profile.machine_bus: ("machine", "gnss")} if profile.machine_bus else {})


def write(directory: Path, manifest: Manifest) -> None:
    """Write the manifest into the run's directory atomically; raises OSError."""
    new = directory / (NAME + ".new")
    with new.open("wb") as file:
        file.write(msgspec.json.format(msgspec.json.encode(manifest)) + b"\n")
        file.flush()
        os.fsync(file.fileno())
    os.replace(new, directory / NAME)


def read(directory: Path) -> Manifest:
    """Read the manifest of a run; raises OSError or msgspec.MsgspecError."""
    return msgspec.json.decode((directory / NAME).read_bytes(), type=Manifest)
