"""Reads a recording: its files, its manifest, the messages of a topic."""

from __future__ import annotations

import contextlib
import sys
from collections import Counter
from collections.abc import Iterator, Sequence
from functools import cache, partial
from pathlib import Path
from typing import Final

import msgspec

from host.exit_codes import CommandFailed, ExitCode
from recorder.manifest import Manifest
from recorder.recover import Channel, Stored, is_complete, recover, run_files, scan
from runtime.errors import InputRefused

PROFILE_FILE: Final = "profile.toml"
"""The profile of the run, where it lies with the recording."""


def files_of(log: Path) -> list[Path]:
    """List the MCAP files of a run's directory, or the one file; recover the end of a directory's recording first.

    Raises:
        CommandFailed: there is no recording.
    """
    if log.is_dir():
        with contextlib.suppress(OSError):  # a directory that is not writable is read as it is
            recover(log)
        files = run_files(log)
    else:
        files = [log] if log.is_file() else []
    if not files:
        raise CommandFailed(
            "recording.none",
            f"{log} holds no recording; give a run's directory or its run.mcap",
            ExitCode.CONFIGURATION,
        )
    return files


def no_frames(log: Path, reasons: Sequence[str]) -> CommandFailed:
    """Make the error of a CAN log in which no frame can be read; ``reasons`` may be empty or hold empty ones."""
    why = "; ".join(filter(None, reasons))
    return CommandFailed(
        "recording.no-frames",
        f"{log}: holds no CAN frame that can be read{f' ({why})' if why else ''}; give a log of a CAN bus",
        ExitCode.CONFIGURATION,
    )


@cache
def tell_end(path: Path, at_byte: int) -> None:
    """Say once, on stderr, that a recording is not read to its end."""
    sentence = f"{path} is read up to byte {at_byte}: there it was cut off, is damaged, or is still being recorded"
    print(sentence, file=sys.stderr)


def messages(files: list[Path], topic: str) -> Iterator[bytes]:
    """Yield the payloads of a topic, in recorded order.

    Raises:
        CommandFailed: not an MCAP file.
    """
    try:
        for path in files:
            for record in scan(path, {topic}, partial(tell_end, path)):
                if isinstance(record, Stored):
                    yield record.data
    except InputRefused as error:
        raise CommandFailed.from_error(error, ExitCode.CONFIGURATION) from error


def contents(files: list[Path]) -> dict[str, int]:
    """Count the messages of every topic that has any.

    Raises:
        CommandFailed: not an MCAP file.
    """
    counts: Counter[str] = Counter()
    try:
        for path in files:
            topics: dict[int, str] = {}
            for record in scan(path, None, partial(tell_end, path)):
                if isinstance(record, Channel):
                    topics[record.id] = record.topic
                elif isinstance(record, Stored):
                    counts[topics[record.channel_id]] += 1
    except InputRefused as error:
        raise CommandFailed.from_error(error, ExitCode.CONFIGURATION) from error
    return dict(sorted(counts.items()))


def manifest_of(files: list[Path]) -> Manifest:
    """Return the manifest inside the recording.

    Raises:
        CommandFailed: there is none, or it is damaged.
    """
    first = next(messages(files[:1], "/manifest"), None)
    if first is None and not is_complete(files[0]):
        raise CommandFailed(
            "recording.cut-off",
            f"{files[0]} is cut off at byte {files[0].stat().st_size}, before its manifest; give another recording",
            ExitCode.CONFIGURATION,
        )
    if first is None:
        raise CommandFailed(
            "recording.no-manifest",
            f"{files[0]} has no manifest, so timberhand did not make this recording",
            ExitCode.CONFIGURATION,
        )
    try:
        return msgspec.json.decode(first, type=Manifest)
    except (msgspec.MsgspecError, UnicodeDecodeError) as error:
        raise CommandFailed(
            "recording.damaged-manifest",
            f"{files[0]}: its manifest is damaged or of another release ({error}); give another recording",
            ExitCode.CONFIGURATION,
        ) from error
