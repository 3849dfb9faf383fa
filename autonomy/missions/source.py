"""A mission file as bytes: its limits, its text, and the line of everything in it.

``Place`` says where something stands in its file: a line number, or the path of a value within a JSON document, whose
line is looked up only when there is something to complain about.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import msgspec

from autonomy.missions.model import MissionError

MAX_JSON_BYTES: Final = 16 << 20
MAX_XML_BYTES: Final = 64 << 20
"""A harvester's production file of a whole stand has 3 to 15 MB."""
MAX_VALUES: Final = 500_000
"""Lists and objects in a JSON file; 50 000 logs have four each."""
SHOWN: Final = 10

Place = int | tuple[str | int, ...] | None
_SPACE: Final = re.compile(r"[ \t\r\n]*")
_BYTE: Final = re.compile(r"(.*) \(byte (\d+)\)$")
_DECODER: Final = json.JSONDecoder()


@dataclass(frozen=True, slots=True)
class Source:
    """A file's name and, for JSON, its text."""

    name: str
    text: str = field(default="", repr=False)

    def at(self, place: Place) -> str:
        """``name:line`` of a place, ``name`` where there is no line to tell."""
        line = line_of(self.text, place) if isinstance(place, tuple) else place
        return self.name if line is None else f"{self.name}:{line}"

    def error(self, place: Place, sentence: str) -> MissionError:
        """The refusal of a file for what stands at a place."""
        return self.errors([(place, sentence)])

    def errors(self, found: Iterable[tuple[Place, str]]) -> MissionError:
        """The refusal of a file for several reasons; after the first few they are only counted."""
        reasons = list(found)
        # What a file says may hold line breaks; what is said of it is one line.
        lines = [f"{self.at(place)}: {' '.join(sentence.split())}" for place, sentence in reasons[:SHOWN]]
        if len(reasons) > SHOWN:
            lines.append(f"{self.name}: and {len(reasons) - SHOWN} more of the kind")
        return MissionError(*lines)


def read_bytes(path: str | Path) -> bytes:
    """The bytes of a file; raises MissionError when it cannot be read or is larger than any mission."""
    try:
        with Path(path).open("rb") as file:
            data = file.read(MAX_XML_BYTES + 1)
    except OSError as error:
        raise MissionError(f"{path}: cannot be read: {error.strerror or error}") from None
    except ValueError as error:  # a NUL in the name
        raise MissionError(f"{path}: cannot be read: {error}") from None
    if len(data) > MAX_XML_BYTES:
        raise MissionError(f"{path}: is larger than {MAX_XML_BYTES >> 20} MB; a mission has some kB")
    return data


def json_document(data: bytes, name: str) -> tuple[Any, Source]:
    """The JSON value in ``data`` (UTF-8, a byte order mark is ignored) and its source.

    Raises:
        MissionError: not UTF-8, too large, nested too deeply, or no JSON; NaN and Infinity are none (RFC 8259).
    """
    if len(data) > MAX_JSON_BYTES:
        raise MissionError(f"{name}: is larger than {MAX_JSON_BYTES >> 20} MB; a mission has some kB")
    if data.count(b"[") + data.count(b"{") > MAX_VALUES:
        raise MissionError(f"{name}: has more than {MAX_VALUES} lists and objects; thin it out, or split the mission")
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        raise MissionError(
            f"{name}:{line}: byte {error.start} is no UTF-8 text; save the file with the encoding UTF-8"
        ) from None
    source = Source(name, text)
    try:
        return msgspec.json.decode(text), source
    except RecursionError:
        raise source.error(None, "is nested deeper than any mission") from None
    except msgspec.DecodeError as error:
        raise _no_json(source, str(error)) from None


def _no_json(source: Source, complaint: str) -> MissionError:
    """What is wrong with a text that a JSON reader refused, and on which line."""
    found = _BYTE.match(complaint)
    if found is None:
        last = source.text.count("\n") + 1 if "truncated" in complaint else None
        return source.error(last, f"this is no JSON: {complaint[0].lower()}{complaint[1:]}")
    before = source.text.encode()[: int(found[2])]
    line = before.count(b"\n") + 1
    rest = source.text.encode()[len(before) : len(before) + 12].decode(errors="ignore")
    number = re.match(r"-?(NaN|nan|Infinity|inf)", before.decode(errors="ignore")[-1:] + rest) or re.match(
        r"-?(NaN|nan|Infinity|inf)", rest
    )
    if number:
        return source.error(line, f"{number[0]} is no number in JSON; write the value, or leave the member out")
    return source.error(line, f"this is no JSON: {found[1].removeprefix('JSON is malformed: ')}; was the file cut off?")


def line_of(text: str, path: tuple[str | int, ...]) -> int | None:
    """The line, from 1, on which the value at a path of a JSON text begins; of its nearest parent if it is missing."""
    at = _skip(text, 0)
    for step in path:
        inner = _member(text, at, step)
        if inner is None:
            break
        at = inner
    return text.count("\n", 0, at) + 1


def _member(text: str, at: int, step: str | int) -> int | None:
    """Where the member ``step`` of the object or array at ``at`` begins."""
    if at >= len(text) or text[at] != ("{" if isinstance(step, str) else "["):
        return None
    at = _skip(text, at + 1)
    count = 0
    found = None
    while at < len(text) and text[at] not in "]}":
        if isinstance(step, str):
            key, at = _DECODER.raw_decode(text, at)
            at = _skip(text, _skip(text, at) + 1)
            if key == step:
                found = at  # of a repeated key the last one counts
        elif count == step:
            return at
        _, at = _DECODER.raw_decode(text, at)
        at = _skip(text, at)
        if at < len(text) and text[at] == ",":
            at = _skip(text, at + 1)
        count += 1
    return found


def _skip(text: str, at: int) -> int:
    found = _SPACE.match(text, at)
    return found.end() if found else at
