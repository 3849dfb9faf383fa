"""The controller's timing page in shared memory: written once per second, read by console, recorder and tools.

A file in a memory file system, mapped by the writer: ``magic u32 | version u32 | sequence u64 | bytes of facts u64``,
then the facts as JSON (`Facts`), then one block of bins per name in `STAGES`.  The sequence is odd while the writer
writes; a reader copies the page and accepts the copy only if the sequence was even and is unchanged.  Nothing here
blocks the writer.
"""

from __future__ import annotations

import os
import struct
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import msgspec

from can_dbc.timing.durations import BINS, Durations
from runtime.errors import InputRefused
from runtime.shared_file import SharedFile, shared_path

STAGES: Final = (
    "wake",
    "sync",
    "tick",
    "cpu",
    "receive",
    "decode",
    "estimate",
    "supervise",
    "control",
    "encode",
    "send",
    "record",
    "sample_to_command",
)
"""Measured are: lateness of the tick and of SYNC; the tick by the clock and by CPU time; its stages in order; the time
from the encoders' sample to the valve command that uses it.

"estimate" includes the reference, "supervise" includes the acceptance of requests, and "record" is everything after the
frames are sent: reports, tick record and this page.
"""
METRIC_KEYS: Final = {name: name for name in STAGES} | {"receive": "read", "control": "law", "record": "tell"}
"""Names in JSON (recordings, command output), which older recordings share."""
_MAGIC: Final = 0x504D4854  # "THMP"
_VERSION: Final = 1
_HEAD: Final = struct.Struct("<IIQQ")
_SEQUENCE: Final = struct.Struct("<Q")
_SEQUENCE_AT: Final = 8
_FACTS_BYTES: Final = 16 << 10
_BLOCK: Final = 8 * BINS
_SIZE: Final = _HEAD.size + _FACTS_BYTES + _BLOCK * len(STAGES)
_TRIES: Final = 50


class BusCounters(msgspec.Struct, frozen=True):
    """One bus of the controller: name of the `can_dbc.bus.base.BusState`, counts since it was opened."""

    name: str
    state: str
    received: int
    sent: int
    refused: int
    dropped: int
    error_frames: int
    recoveries: int


class ProcessCounters(msgspec.Struct, frozen=True):
    """The system's counters of the process (getrusage(2)), and its memory."""

    cpu_ns: int
    minor_faults: int
    major_faults: int
    voluntary_switches: int
    involuntary_switches: int
    gc_runs: int
    allocated_blocks: int
    resident_kb: int


class InputAge(msgspec.Struct):
    """Age of an input when a tick used it: newest and longest; ``count`` is the number of uses, ``refused`` that of
    frames with a wrong length, checksum, counter or value."""

    newest_ns: int = 0
    longest_ns: int = 0
    count: int = 0
    refused: int = 0


class Facts(msgspec.Struct, frozen=True):
    """Everything but the histograms; times on CLOCK_MONOTONIC.

    ``missed`` counts skipped periods, ``late`` ticks that began more than two periods late.  ``tick``: the
    interpreter, or compiled modules and their build.
    """

    pid: int
    started_ns: int
    written_ns: int
    period_ns: int
    ticks: int
    missed: int
    late: int
    mode: str
    words: str
    buses: tuple[BusCounters, ...]
    process: ProcessCounters
    inputs: Mapping[str, InputAge]
    longest_ns: tuple[int, ...]
    total_ns: tuple[int, ...]
    tick: str = "interpreter"


@dataclass(frozen=True, slots=True)
class Timing:
    """A copy of the page: ``facts``, and the histograms by the names in `STAGES`."""

    facts: Facts
    durations: Mapping[str, Durations]

    @property
    def age_ns(self) -> int:
        """Time since it was written."""
        return time.monotonic_ns() - self.facts.written_ns

    def named(self) -> dict[str, Any]:
        """Return the whole page as plain values for JSON: the facts, and of each histogram the summary."""
        facts: dict[str, Any] = msgspec.to_builtins(self.facts)
        for name in ("longest_ns", "total_ns"):  # part of the histograms
            del facts[name]
        return facts | {
            "durations": {METRIC_KEYS[name]: histogram.summary() for name, histogram in self.durations.items()}
        }


def default_path() -> Path:
    """Return the path of the controller's page."""
    return shared_path("controller.timing")


class TimingWriter:
    """Owns the page at ``path``; raises OSError if it cannot be created.  Everyone may read it; it holds no secret."""

    __slots__ = ("_file", "_map", "_sequence")

    def __init__(self, path: Path) -> None:
        self._file = SharedFile(path, _SIZE)
        self._map = self._file.map
        self._sequence = 0
        _HEAD.pack_into(self._map, 0, _MAGIC, _VERSION, 0, 0)

    def publish(self, facts: Facts, durations: Mapping[str, Durations]) -> None:
        """Write facts and histograms."""
        text = msgspec.json.encode(facts)
        page, size = self._map, len(text)
        if size > _FACTS_BYTES:
            return  # an incomplete page is worse than an old one
        _SEQUENCE.pack_into(page, _SEQUENCE_AT, self._sequence + 1)
        _HEAD.pack_into(page, 0, _MAGIC, _VERSION, self._sequence + 1, size)
        page[_HEAD.size : _HEAD.size + size] = text
        at = _HEAD.size + _FACTS_BYTES
        for name in STAGES:
            page[at : at + _BLOCK] = memoryview(durations[name].bins).cast("B")
            at += _BLOCK
        self._sequence += 2
        _SEQUENCE.pack_into(page, _SEQUENCE_AT, self._sequence)

    def close(self) -> None:
        """Remove the page, unless another process owns it by now; may be called twice."""
        self._file.close()


def read_timing(path: Path | None = None) -> Timing:
    """Copy the page at ``path`` (default: `default_path`); raises InputRefused."""
    path = path or default_path()
    try:
        with path.open("rb", buffering=0) as file:
            for _ in range(_TRIES):
                data = os.pread(file.fileno(), _SIZE, 0)
                again = os.pread(file.fileno(), _SEQUENCE.size, _SEQUENCE_AT)
                if len(data) == _SIZE and again == data[_SEQUENCE_AT : _SEQUENCE_AT + _SEQUENCE.size]:
                    magic, version, sequence, size = _HEAD.unpack_from(data)
                    if (magic, version) != (_MAGIC, _VERSION):
                        raise InputRefused(
                            "timing.other-release",
                            f"{path} is not a timing page of this release; use the same release to read it.",
                        )
                    if sequence and not sequence & 1:
                        return _timing(data, size)
                time.sleep(0.002)
    except InputRefused:
        raise
    except (OSError, ValueError, msgspec.MsgspecError) as error:
        reason = getattr(error, "strerror", None) or error
        raise InputRefused(
            "timing.no-page",
            f"No controller publishes its timing at {path} ({reason}); start it, or give the path of its page.",
        ) from error
    raise InputRefused(
        "timing.not-written", f"The controller has not written its timing to {path} yet; try again in a second."
    )


def _timing(data: bytes, size: int) -> Timing:
    facts = msgspec.json.decode(data[_HEAD.size : _HEAD.size + size], type=Facts)
    durations, at = {}, _HEAD.size + _FACTS_BYTES
    for name, longest_ns, total_ns in zip(STAGES, facts.longest_ns, facts.total_ns, strict=True):
        durations[name] = Durations(data[at : at + _BLOCK], longest_ns, total_ns)
        at += _BLOCK
    return Timing(facts, durations)
