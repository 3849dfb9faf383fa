"""A mission file as text: its size limits, what it is packed in, and the line of every value in it.

``Place`` is a line number, or the path of a value in a JSON document, whose line is only looked up for an error.
"""

from __future__ import annotations

import io
import json
import re
import struct
import sys
import zipfile
import zlib
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import msgspec

from autonomy.missions.model import MissionError, Problem

MAX_JSON_BYTES: Final = 16 << 20
MAX_XML_BYTES: Final = 64 << 20
"""A harvester's production file of a whole stand has 3 to 15 MB."""
MAX_VALUES: Final = 500_000
"""Lists and objects in a JSON file; 50 000 logs have four each."""
MAX_PACKED: Final = 1000
"""Entries of a zip file; a KMZ has one for each of its pictures."""
MAX_MEMBERS: Final = 16
"""Pieces of a gzip file, each of which is copied."""
MAX_SHOWN: Final = 10
MAX_LINED_CHARS: Final = 1 << 20
"""In a longer text no line is looked for: every level of it is read again, which takes a second in 6 MB."""

Place = int | tuple[str | int, ...] | None
_ZIP, _GZIP = b"PK", b"\x1f\x8b"
_MISSION_NAMES: Final = (".kml", ".hpr", ".gpx", ".geojson", ".json", ".plan", ".xml")
_SPACE: Final = re.compile(r"[ \t\r\n]*")
_BYTE: Final = re.compile(r"(.*) \(byte (\d+)\)$")
_DECODER: Final = json.JSONDecoder()
_LONG_NUMBER: Final = re.compile(r"(?<![0-9])[0-9]{309}")
"""An integer that no float holds; the look-behind has every digit looked at once."""


@dataclass(frozen=True, slots=True)
class Source:
    """A file's name and, for JSON, its text."""

    name: str
    text: str = field(default="", repr=False)

    def at(self, place: Place) -> str:
        """Return ``name:line`` of a place, or ``name`` if the line is unknown."""
        if isinstance(place, tuple):
            line = None
            if len(self.text) <= MAX_LINED_CHARS:
                with suppress(RecursionError):  # nested nearly as deep as json_document reads
                    line = line_of(self.text, place)
        else:
            line = place
        return self.name if line is None else f"{self.name}:{line}"

    def error(self, code: str, place: Place, sentence: str) -> MissionError:
        """Make the error of one problem."""
        return self.errors([(place, code, sentence)])

    def errors(self, found: Iterable[tuple[Place, str, str]]) -> MissionError:
        """Make the error of several problems (place, code, sentence); those after the first few are only counted."""
        reasons = list(found)
        # Values from the file may contain line breaks; each problem is one line.
        problems = [
            Problem(code, " ".join(sentence.split()), self.at(location))
            for location, code, sentence in reasons[:MAX_SHOWN]
        ]
        more = f"{self.name}: and {len(reasons) - MAX_SHOWN} more of the kind" if len(reasons) > MAX_SHOWN else ""
        return MissionError.of(problems, more)


def read_bytes(path: str | Path) -> bytes:
    """Read the bytes of a file.

    Raises:
        MissionError: it cannot be read, or is larger than any mission.
    """
    try:
        with Path(path).open("rb") as file:
            data = file.read(MAX_XML_BYTES + 1)
    except OSError as error:
        raise MissionError("mission.unreadable", f"cannot be read: {error.strerror or error}", str(path)) from None
    except ValueError as error:  # a NUL in the name
        raise MissionError("mission.unreadable", f"cannot be read: {error}", str(path)) from None
    if len(data) > MAX_XML_BYTES:
        raise _too_large(str(path))
    return data


def unpacked(data: bytes, name: str) -> tuple[bytes, str, list[str]]:
    """Return the mission in a zip (``.kmz``, ``.hprz``) or gzip file, its name in errors, and notes; another file as it
    is.

    Raises:
        MissionError: damaged, encrypted, larger than any mission, an archive in an archive, or not one mission.
    """
    if data.startswith(_ZIP):
        inner, inside, notes = _from_zip(data, name)
    elif data.startswith(_GZIP):
        inner, inside, notes = _from_gzip(data, name), name, []
    else:
        return data, name, []
    if inner.startswith((_ZIP, _GZIP)):
        raise MissionError("mission.archive", "holds an archive again; unpack it and give the file inside", inside)
    return inner, inside, notes


def _from_zip(data: bytes, name: str) -> tuple[bytes, str, list[str]]:
    if data.count(b"PK\x01\x02") > MAX_PACKED:  # the mark of an entry in the directory
        sentence = f"is a zip file of more than {MAX_PACKED} files; unpack it and give the mission"
        raise MissionError("mission.archive", sentence, name)
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            named = [e for e in archive.infolist() if e.filename]  # is_dir fails without a name
            files = [e for e in named if not e.is_dir() and not e.filename.startswith("__MACOSX/")]
            mission_entries = [e for e in files if e.filename.lower().endswith(_MISSION_NAMES)]
            mission_entries = [e for e in mission_entries if e.filename.lower() == "doc.kml"] or mission_entries
            if len(mission_entries) != 1:
                sentence = (
                    f"is a zip file with {len(mission_entries) or 'no'} missions in it; unpack it and give one of them"
                )
                raise MissionError("mission.archive", sentence, name)
            entry = mission_entries[0]
            if entry.flag_bits & 1 or entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
                sentence = "is a zip file that is encrypted or packed in an unusual way; unpack it and give the mission"
                raise MissionError("mission.archive", sentence, name)
            with archive.open(entry) as file:
                inner = file.read(MAX_XML_BYTES + 1)
    except MissionError:  # a ValueError, too: its sentence is true, and the next one would not be
        raise
    except (zipfile.BadZipFile, zlib.error, NotImplementedError, OSError, ValueError, EOFError, struct.error) as error:
        sentence = f"is a zip file that is damaged or cut off ({error}); copy it anew"
        raise MissionError("mission.archive-damaged", sentence, name) from None
    inside = f"{name}/{' '.join(entry.filename.split())[:80]}"
    if len(inner) > MAX_XML_BYTES:
        raise _too_large(inside)
    rest = len(files) - 1
    return inner, inside, [f"{rest} other file{'' if rest == 1 else 's'} in the zip file ignored"] if rest else []


def _from_gzip(data: bytes, name: str) -> bytes:
    unpacked_bytes = b""
    try:
        for _ in range(MAX_MEMBERS):
            unpacker = zlib.decompressobj(wbits=31)
            unpacked_bytes += unpacker.decompress(data, MAX_XML_BYTES + 1 - len(unpacked_bytes))
            if len(unpacked_bytes) > MAX_XML_BYTES:
                raise _too_large(name)
            if not unpacker.eof:
                raise MissionError("mission.archive-damaged", "is a gzip file that is cut off; copy it anew", name)
            data = unpacker.unused_data
            if not data.startswith(_GZIP):
                if data.strip(b"\0"):
                    break
                return unpacked_bytes
    except zlib.error as error:
        sentence = f"is a gzip file that is damaged ({error}); copy it anew"
        raise MissionError("mission.archive-damaged", sentence, name) from None
    raise MissionError("mission.archive", "is a gzip file of several pieces; unpack it and give the file inside", name)


def _too_large(name: str, limit: int = MAX_XML_BYTES) -> MissionError:
    sentence = f"is larger than {limit >> 20} MB; a mission has some kB"
    return MissionError("mission.too-large", sentence, name)


def utf_8(data: bytes, name: str) -> bytes:
    """Convert JSON in UTF-16 to UTF-8; leave everything else as it is: an XML file says itself what it is written in.

    Raises:
        MissionError: JSON in damaged UTF-16.
    """
    marked = data[:2] in (b"\xff\xfe", b"\xfe\xff")
    encoding = "utf-16" if marked else "utf-16-be" if data[:1] == b"\0" else "utf-16-le" if data[1:2] == b"\0" else ""
    if not encoding or not data[:256].decode(encoding, "ignore").lstrip().startswith("{"):
        return data
    if len(data) > 2 * MAX_JSON_BYTES + 2:
        raise _too_large(name, MAX_JSON_BYTES)
    try:
        return data.decode(encoding).encode()
    except UnicodeError as error:
        at = getattr(error, "start", 0)
        sentence = f"is no UTF-16 text from byte {at} on; if it was not cut off, save it with the encoding UTF-8"
        raise MissionError("mission.encoding", sentence, name) from None


def json_document(data: bytes, name: str) -> tuple[Any, Source]:
    """Return the JSON value in ``data`` (UTF-8, a byte order mark is ignored) and its source.

    Raises:
        MissionError: not UTF-8, too large, nested too deeply, or not JSON; NaN and Infinity are not JSON (RFC 8259).
    """
    if len(data) > MAX_JSON_BYTES:
        raise _too_large(name, MAX_JSON_BYTES)
    if data.count(b"[") + data.count(b"{") > MAX_VALUES:
        sentence = f"has more than {MAX_VALUES} lists and objects; thin it out, or split the mission"
        raise MissionError("mission.too-many-values", sentence, name)
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        raise MissionError(
            "mission.encoding",
            f"byte {error.start} is not UTF-8 text; save the file with the encoding UTF-8",
            f"{name}:{line}",
        ) from None
    source = Source(name, text)
    try:
        value = msgspec.json.decode(text)
    except RecursionError:
        raise source.error("mission.nesting", None, "is nested deeper than any mission") from None
    except msgspec.DecodeError as error:
        raise _no_json(source, str(error)) from None
    if _LONG_NUMBER.search(text):
        _refuse_long_numbers(value, source)
    return value, source


def _refuse_long_numbers(value: Any, source: Source) -> None:
    """Refuse integers that no float holds, so that every number of a document can be computed with."""
    left: list[tuple[Any, tuple[str | int, ...]]] = [(value, ())] if isinstance(value, dict | list) else []
    while left:
        at, path = left.pop()
        for key, inner in at.items() if isinstance(at, dict) else enumerate(at):
            if isinstance(inner, dict | list):
                left.append((inner, (*path, key)))
            elif isinstance(inner, int) and abs(inner) > sys.float_info.max:
                sentence = "this number has more than 308 digits; write the value that it stands for"
                raise source.error("mission.json-number", (*path, key), sentence)


def _no_json(source: Source, complaint: str) -> MissionError:
    """Make the error for text that the JSON reader refused, with its line."""
    byte_match = _BYTE.match(complaint)
    if byte_match is None:
        cut = "truncated" in complaint
        last = source.text.count("\n") + 1 if cut else None
        if "out of range" in complaint:
            sentence = "a number is larger than a computer's; write the value that it stands for"
            return source.error("mission.json-number", last, sentence)
        reason = "it ends too early; was the file cut off?" if cut else f"{complaint[0].lower()}{complaint[1:]}"
        return source.error("mission.not-json", last, f"this is not JSON: {reason}")
    before = source.text.encode()[: int(byte_match[2])]
    line = before.count(b"\n") + 1
    rest = source.text.encode()[len(before) : len(before) + 12].decode(errors="ignore")
    number = re.match(r"-?(NaN|nan|Infinity|inf)", before.decode(errors="ignore")[-1:] + rest) or re.match(
        r"-?(NaN|nan|Infinity|inf)", rest
    )
    if number:
        sentence = f"{number[0]} is not a number in JSON; write the value, or leave the member out"
        return source.error("mission.json-number", line, sentence)
    sentence = f"this is not JSON: {byte_match[1].removeprefix('JSON is malformed: ')}"
    return source.error("mission.not-json", line, sentence)


def line_of(text: str, path: tuple[str | int, ...]) -> int | None:
    """Find the line, from 1, on which the value at a path of a JSON text begins; if missing, its nearest parent's."""
    at = _skip(text, 0)
    for step in path:
        inner = _member(text, at, step)
        if inner is None:
            break
        at = inner
    return text.count("\n", 0, at) + 1


def _member(text: str, at: int, step: str | int) -> int | None:
    """Find the position of the member ``step`` of the object or array at ``at``."""
    if at >= len(text) or text[at] != ("{" if isinstance(step, str) else "["):
        return None
    at = _skip(text, at + 1)
    count = 0
    member_at = None
    while at < len(text) and text[at] not in "]}":
        if isinstance(step, str):
            key, at = _DECODER.raw_decode(text, at)
            at = _skip(text, _skip(text, at) + 1)
            if key == step:
                member_at = at  # the last one of a repeated key counts
        elif count == step:
            return at
        _, at = _DECODER.raw_decode(text, at)
        at = _skip(text, at)
        if at < len(text) and text[at] == ",":
            at = _skip(text, at + 1)
        count += 1
    return member_at


def _skip(text: str, at: int) -> int:
    space = _SPACE.match(text, at)
    return space.end() if space else at
