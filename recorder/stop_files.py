"""The files of stops in one directory: a bounded ring, of which every file is whole or repaired.

``NUMBER-TIME-CODE.mcap``, in the order of their numbers whatever the clock says; the newest `MAX_FILES` that together
have at most `MAX_BYTES` stay.  A file grows as ``.mcap.part`` by commits of whole chunks, each with its CRC, and gets
its name, flushed to the disk, when it is complete.  A writer that was killed leaves a part, which the next one repairs
up to its last chunk (`recorder.recover`).
"""

from __future__ import annotations

import contextlib
import datetime
import fcntl
import os
from pathlib import Path
from typing import Final

import msgspec

from recorder.manifest import Manifest
from recorder.mcap_scan import Stored, is_complete, scan
from recorder.recover import rewrite
from recorder.segment import Segment
from recorder.stop import TOPIC, Stop
from runtime.errors import InputRefused

TICK: Final = "/controller/tick"
MAX_FILES: Final = 50
MAX_BYTES: Final = 256 * 2**20
_PART: Final = ".part"
_JSON: Final = msgspec.json.Encoder()
_OBJECT: Final = b'{"type":"object"}'


def files_in(directory: Path) -> list[Path]:
    """The complete files of a directory, oldest first."""
    return sorted(directory.glob("*-*.mcap"))


def parts_in(directory: Path) -> list[Path]:
    """The files that are being written, or that a killed writer left, oldest first."""
    return sorted(directory.glob(f"*-*.mcap{_PART}"))


class StopFile:
    """The file of one stop while it is written; its methods raise OSError."""

    def __init__(self, directory: Path, stop: Stop, manifest: Manifest, durable: bool) -> None:
        self.path = directory / _name(stop)
        self._part = self.path.with_name(self.path.name + _PART)
        self._durable = durable
        self._offset_ns = manifest.utc_offset_ns
        self._segment = Segment(self._part, durable)
        self._segment.channel("/manifest", "json", "Manifest", _OBJECT)
        self._segment.channel(TOPIC, "json", "Stop", _OBJECT)
        self._segment.channel(TICK, "timberhand.tick")
        self._add("/manifest", stop.at_ns, _JSON.encode(manifest))
        self.add_stop(stop)

    @property
    def pending(self) -> int:
        """Messages since the last commit."""
        return self._segment.pending

    def add_stop(self, stop: Stop) -> None:
        """Adds the record of this stop, or of a second reason while the machine is stopped."""
        self._add(TOPIC, stop.at_ns, _JSON.encode(stop))

    def add_tick(self, now_ns: int, record: bytes) -> None:
        """Adds the controller's record of a tick."""
        self._add(TICK, now_ns, record)

    def commit(self) -> None:
        """Writes what was added."""
        self._segment.commit()

    def finish(self) -> None:
        """Completes the file and gives it its name."""
        self._segment.finish()
        _put_in_place(self._part, self.path, self._durable)

    def abandon(self) -> None:
        """Closes a file that cannot be written; what was committed stays as a part."""
        self._segment.close()

    def _add(self, topic: str, at_ns: int, data: bytes) -> None:
        self._segment.add(topic, at_ns + self._offset_ns, at_ns, data)


class StopFiles:
    """The ring; it makes its directory with the first stop."""

    def __init__(self, directory: Path, durable: bool) -> None:
        self.directory, self._durable = directory, durable
        self.removed = 0
        """Files that made room for newer ones."""
        with contextlib.suppress(OSError):  # a directory that cannot be written shows at the next stop
            repair(directory)
        self.next_number = 1 + max(map(_number, [*files_in(directory), *parts_in(directory)]), default=0)

    def begin(self, stop: Stop, manifest: Manifest) -> StopFile:
        """A file for a new stop; raises OSError."""
        self.directory.mkdir(parents=True, exist_ok=True)
        self.next_number = max(self.next_number, stop.number + 1)
        return StopFile(self.directory, stop, manifest, self._durable)

    def remove_oldest(self) -> None:
        """Removes the oldest files until the bounds hold; raises OSError."""
        files = files_in(self.directory)
        sizes = [path.stat().st_size for path in files]
        while len(files) > 1 and (len(files) > MAX_FILES or sum(sizes) > MAX_BYTES):
            files.pop(0).unlink()
            sizes.pop(0)
            self.removed += 1


def repair(directory: Path) -> list[Path]:
    """Completes the parts that a killed writer left; one without a stop is removed.  Returns the repaired files.

    A part that another process still writes (``flock``) is not touched.

    Raises:
        OSError: the directory cannot be written; nothing is lost.
    """
    repaired: list[Path] = []
    for part in parts_in(directory):
        with part.open("rb") as held:
            try:
                fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                continue
            if not is_complete(part):
                if not _has_stop(part):
                    part.unlink()
                    continue
                rewrite(part)
            final = part.with_name(part.name.removesuffix(_PART))
            _put_in_place(part, final, True)
            repaired.append(final)
    return repaired


def _has_stop(part: Path) -> bool:
    try:
        return any(isinstance(record, Stored) for record in scan(part, {TOPIC}))
    except InputRefused:
        return False


def _put_in_place(part: Path, final: Path, durable: bool) -> None:
    os.replace(part, final)
    if durable:
        folder = os.open(final.parent, os.O_RDONLY | os.O_DIRECTORY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)


def _name(stop: Stop) -> str:
    if stop.utc_ns is None:
        when = f"{stop.at_ns / 1e9:.3f}s"
    else:
        when = f"{datetime.datetime.fromtimestamp(stop.utc_ns // 10**9, datetime.UTC):%Y%m%dT%H%M%SZ}"
    return f"{stop.number:06d}-{when}-{stop.code}.mcap"


def _number(path: Path) -> int:
    first = path.name.partition("-")[0]
    return int(first) if first.isdigit() else 0
