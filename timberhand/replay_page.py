"""Opens a recorded run in the operator's page, for the commands that do so."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from console.__main__ import serve_replay
from console.exposure import StartError
from hil.replay.recording import files_of
from hil.replay.replay import profile_beside
from hil.replay.seek import SeekableRecording
from host.exit_codes import CommandFailed, ExitCode
from machine.loading.profile_file import ProfileError, load_profile, profile_hash

BEFORE_STOP_NS = 10_000_000_000


def show_recording(
    run: Path,
    profile: str | None,
    port: int,
    *,
    stop_ns: int | None = None,
    bind: str = "127.0.0.1",
    allow_hosts: Sequence[str] = (),
) -> None:
    """Serve the page of a recording until it is interrupted; with ``stop_ns`` it begins 10 s before a stop.

    Raises:
        CommandFailed: the recording cannot be shown, or the page cannot be served.
    """
    files = files_of(run)
    recording = SeekableRecording(files)
    manifest = recording.manifest
    try:
        machine = load_profile(profile or profile_beside(files) or manifest.profile)
    except ProfileError as error:
        hint = f"; name the profile of that run, {manifest.profile}, with --profile FILE"
        raise CommandFailed("replay.page-profile", f"{error}{hint}") from error
    same = f"{profile_hash(machine):08x}" == manifest.profile_hash
    note = "" if same else f"Drawn with the profile {machine.name} of today, which differs from the recorded one."
    name = f"{run} · {manifest.start_utc or 'lockstep'}"
    at_ns = None if stop_ns is None else stop_ns - BEFORE_STOP_NS
    try:
        serve_replay(
            recording, machine, port=port, name=name, note=note, at_ns=at_ns, bind=bind, allow_hosts=allow_hosts
        )
    except StartError as error:
        raise CommandFailed.from_error(error, ExitCode(error.exit_code)) from error
