"""Demonstrated motions of the crane in a recording, from which movement primitives are learned."""

from __future__ import annotations

import struct
import sys
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Final

from autonomy.motion.demonstration import JointTrack, joint_track, read_demonstrations, segment_motions
from can_dbc.dbc.codec import load as load_database
from can_dbc.frame import Frame
from can_dbc.trace.candump import read_trace
from can_dbc.trace.records import Trace, TraceFrame
from hil.replay.recording import files_of, manifest_of, no_frames, tell_end
from host.exit_codes import CommandFailed
from machine.loading.profile_file import load_profile
from machine.profile import Profile, encoders
from recorder.recover import Stored, scan

_RAW: Final = struct.Struct("<IB3x8s")
DEFAULT_PROFILE: Final = "aoro_fc8"
"""The machine of a CAN log without a profile."""


def motions_in(log: Path, profile: str | None = None) -> tuple[Profile, tuple[JointTrack, ...]]:
    """Read the machine and the demonstrations of a run's directory, an MCAP file, a CAN log or a file of
    demonstrations.

    Raises:
        TimberhandError: the recording cannot be read, is of another machine, or holds no motion.
    """
    if log.is_file() and log.suffix.lower() == ".csv":
        name, motions = read_demonstrations(log)
        machine = load_profile(profile or name)
        if machine.name != name:
            raise CommandFailed("demonstration.other-machine", f"{log} is of machine {name}, not of {machine.name}")
    else:
        machine, frames = _frames(log, profile)
        motions = segment_motions(machine, joint_track(machine, load_database("crane"), frames))
    if not motions:
        raise CommandFailed(
            "demonstration.no-motion",
            f"{log}: the crane does not move in this recording; record some motions from rest to rest",
        )
    return machine, motions


def _frames(log: Path, profile: str | None) -> tuple[Profile, Iterator[Frame]]:
    if log.is_file() and log.suffix.lower() != ".mcap":
        machine = load_profile(profile or DEFAULT_PROFILE)
        try:
            return machine, _of_one_interface(log, read_trace(log), machine)
        except OSError as error:
            raise CommandFailed("demonstration.unreadable", f"{log} cannot be read ({error.strerror})") from None
    files = files_of(log)
    machine = load_profile(profile or manifest_of(files).profile)
    return machine, _raw(files, f"/{machine.crane_bus}/raw")


def _of_one_interface(log: Path, trace: Trace, machine: Profile) -> Iterator[Frame]:
    """Yield the frames of a log; refuse it when those of encoders come on several interfaces, which may be two
    machines."""
    database = load_database("crane")
    keys = {database.message(e.message).key for e in encoders(machine).values() if e.message in database.messages}
    interfaces: set[str] = set()
    frames = lost = 0
    first = ""
    for record in trace:
        if not isinstance(record, TraceFrame):
            lost, first = lost + 1, first or record.shown
            continue
        frames += 1
        if record.key in keys:
            interfaces.add(record.interface)
        if len(interfaces) > 1:
            raise CommandFailed(
                "demonstration.several-buses",
                f"{log} holds encoder frames of several interfaces ({', '.join(sorted(interfaces))}); keep the lines "
                "of one of them",
            )
        yield record
    if not frames:
        raise no_frames(log, [first, *trace.notes])
    if lost:
        print(f"{log}: {lost} record{'' if lost == 1 else 's'} cannot be read ({first})", file=sys.stderr)


def _raw(files: Sequence[Path], topic: str) -> Iterator[Frame]:
    """Yield the frames of a bus with their monotonic stamps."""
    for path in files:
        for record in scan(path, {topic}, partial(tell_end, path)):
            if isinstance(record, Stored) and len(record.data) >= _RAW.size:
                key, length, data = _RAW.unpack_from(record.data)
                yield Frame(record.publish_ns, key, data[:length])
