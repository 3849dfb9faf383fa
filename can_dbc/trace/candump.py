"""Reads CAN traces of other tools: candump (both forms), PCAN-View and Yacht Devices text, ASC and BLF.

``read_trace`` yields a ``Frame`` per valid record and a ``MalformedRecord`` per line that cannot be parsed; it never
raises for the contents of a file.  Stamps are ns on the trace's own scale, 0 if it has none.  Blank lines, comments and
header lines of the known formats are not records and are skipped.
"""

from __future__ import annotations

import io
import re
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final, NamedTuple

from can_dbc.frame import ERROR, EXTENDED, EXTENDED_MASK, REMOTE, STANDARD_MASK, Frame

CANDUMP: Final = re.compile(r"\((\d+(?:\.\d+)?)\)\s+(\S+)\s+([0-9A-Fa-f]{3}|[0-9A-Fa-f]{8})#(\S*)")
CANDUMP_SCREEN: Final = re.compile(
    r"(?:<0x[0-9a-f]+>)?\s*(?:\((\d+(?:\.\d+)?)\)\s+)?[A-Za-z]\S*\s+"
    r"(?:[TR]X\s(?:[-BE]\s)*\s*)?([0-9A-Fa-f]{3}|[0-9A-Fa-f]{8})\s+"
    r"\[(\d+)\]\s*((?:[0-9A-Fa-f]{2}\s*)*|remote request.*?)(?:'.*')?$"
)
PCAN_VIEW: Final = re.compile(
    r"\d+\)\s+(\d+(?:\.\d+)?)\s+(?:Rx|Tx)\s+([0-9A-Fa-f]{4}|[0-9A-Fa-f]{8})\s+(\d+)\s+((?:[0-9A-Fa-f]{2}\s*)*)$"
)
YACHT_DEVICES: Final = re.compile(r"(\d\d):(\d\d):(\d\d)\.(\d{3}) [RT] ([0-9A-Fa-f]{8})((?: [0-9A-Fa-f]{2}){0,8})\s*$")
PAYLOAD: Final = re.compile(r"(?:#[0-9A-Fa-f])?((?:[0-9A-Fa-f]{2}\.?)*)(?:_[0-9A-Fa-f])?$")
MAX_DATA: Final = 64


class MalformedRecord(NamedTuple):
    """A record that cannot be parsed: line number (0 in a binary file) and its text."""

    line: int
    text: str


def read_trace(path: Path) -> Iterator[Frame | MalformedRecord]:
    """The records of a trace in file order; raises OSError if the file cannot be opened."""
    content = path.read_bytes()
    if path.suffix.lower() == ".blf":
        return _binary(content)
    lines = content.decode("utf-8", "replace").splitlines()
    return _asc(lines) if path.suffix.lower() == ".asc" else _text(lines)


# -- text ----------------------------------------------------------------------------------------------------


def _text(lines: list[str]) -> Iterator[Frame | MalformedRecord]:
    for number, line in enumerate(lines, 1):
        line = line.strip()
        if line and line[0] not in "#;":
            yield parse_line(line) or MalformedRecord(number, line)


def parse_line(line: str) -> Frame | None:
    """The frame in one line of any of the text formats; None if the line is of another format or damaged."""
    try:
        return _parsed(line)
    except ValueError:  # a number too long to convert, or blanks that are none to `bytes.fromhex`
        return None


def _parsed(line: str) -> Frame | None:
    if found := CANDUMP.match(line):
        return _candump(found[1], found[3], found[4])
    if found := CANDUMP_SCREEN.match(line):
        remote = found[4].startswith("remote")
        return _frame(found[1] or "0", found[2], "" if remote else found[4], None if remote else int(found[3]), remote)
    if found := PCAN_VIEW.match(line):
        return _frame(_milliseconds(found[1]), found[2], found[4], int(found[3]))
    if found := YACHT_DEVICES.match(line):
        seconds = int(found[1]) * 3600 + int(found[2]) * 60 + int(found[3])
        return _frame(f"{seconds}.{found[4]}", found[5], found[6])
    return None


def _candump(stamp: str, identifier: str, rest: str) -> Frame | None:
    if rest[:1] == "R":
        return _frame(stamp, identifier, "", None, remote=True)
    payload = PAYLOAD.match(rest)
    return _frame(stamp, identifier, payload[1].replace(".", "")) if payload else None


def _frame(stamp: str, identifier: str, data: str, length: int | None = None, remote: bool = False) -> Frame | None:
    payload = bytes.fromhex(data)
    value = int(identifier, 16)
    if len(payload) > MAX_DATA or length not in (None, len(payload)):
        return None
    if len(identifier) == 8:
        # eight digits with the error bit are an error frame, without it a 29-bit identifier
        key = value & (ERROR | EXTENDED_MASK) if value & ERROR else value & EXTENDED_MASK | EXTENDED
    else:
        key = value & STANDARD_MASK
    return Frame(_nanoseconds(stamp), key | (REMOTE if remote else 0), payload)


def _nanoseconds(text: str) -> int:
    """Decimal seconds as ns, exactly."""
    whole, _, fraction = text.partition(".")
    return int(whole) * 1_000_000_000 + int(fraction[:9].ljust(9, "0"))


def _milliseconds(text: str) -> str:
    nanoseconds = _nanoseconds(text) // 1000
    return f"{nanoseconds // 1_000_000_000}.{nanoseconds % 1_000_000_000:09d}"


# -- Vector formats, through python-can ----------------------------------------------------------------------


def _converted(message: Any) -> Frame:
    key = message.arbitration_id | (EXTENDED if message.is_extended_id else 0)
    key |= (REMOTE if message.is_remote_frame else 0) | (ERROR if message.is_error_frame else 0)
    return Frame(round(message.timestamp * 1e9), key, bytes(message.data))


def _asc(lines: list[str]) -> Iterator[Frame | MalformedRecord]:
    """Reads ASC line by line, each with the header in front, so that a damaged record affects only itself."""
    from can.io.asc import ASCReader

    start = next((i for i, line in enumerate(lines) if re.match(r"\s*\d+\.\d+\s", line)), len(lines))
    header = "\n".join(lines[:start])
    for number, line in enumerate(lines[start:], start + 1):
        if not re.match(r"\s*\d", line):
            continue
        try:
            messages = [_converted(m) for m in ASCReader(io.StringIO(f"{header}\n{line}\n"))]
        except (ValueError, IndexError, KeyError, OverflowError):
            messages = []
        if messages:
            yield from messages
        elif not re.search(r"Start of measurement|Statistic|SV:|J1939TP|\bStatus:|Trigger|log ", line):
            yield MalformedRecord(number, line.strip())


def _binary(content: bytes) -> Iterator[Frame | MalformedRecord]:
    """Reads BLF up to the first damage; records behind a damaged container cannot be found."""
    from can.io.blf import BLFParseError, BLFReader

    try:
        with BLFReader(io.BytesIO(content)) as reader:
            for message in reader:
                yield _converted(message)
    except (BLFParseError, struct.error, zlib.error, ValueError, IndexError, OverflowError) as error:
        yield MalformedRecord(0, f"damaged from here on: {error}")
