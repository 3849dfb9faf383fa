"""Reads CAN traces of other tools: candump (all forms), PCAN (TRC 1.0 to 2.1), Yacht Devices text, ASC and BLF.

``read_trace`` yields a ``TraceFrame`` per valid record and a ``MalformedRecord`` per line that cannot be parsed; it
never raises for the contents of a file.  Its ``notes`` say what else is not read.  Stamps are ns on the trace's own
scale, 0 if it has none.  Blank lines, comments and header lines of the known formats are not records and are skipped.
"""

from __future__ import annotations

import calendar
import io
import logging
import re
from collections import Counter
from collections.abc import Iterator
from datetime import date
from functools import partial
from itertools import islice, pairwise
from pathlib import Path
from typing import Final

from can_dbc.frame import ERROR, EXTENDED, EXTENDED_MASK, REMOTE, STANDARD_MASK
from can_dbc.text import decoded
from can_dbc.trace.records import MalformedRecord, Trace, TraceFrame

CANDUMP: Final = re.compile(r"\((\d+(?:\.\d+)?)\)\s+(\S+)\s+([0-9A-Fa-f]{3}|[0-9A-Fa-f]{8})#(\S*)")
CANDUMP_SCREEN: Final = re.compile(
    r"(?:<0x[0-9a-f]+>)?\s*(?:\((\d+(?:\.\d+)?|\d{4}-\d\d-\d\d \d\d:\d\d:\d\d\.\d+)\)\s+)?([A-Za-z]\S*)\s+"
    r"(?:[TR]X\s(?:[-BE]\s)*\s*)?([0-9A-Fa-f]{3}|[0-9A-Fa-f]{8})\s+"
    r"\[(\d+)\]\s*((?:[0-9A-Fa-f]{2}\s*)*|remote request[^']*)(?:ERRORFRAME\s*)?(?:'.*')?$"
)
PCAN_VIEW: Final = re.compile(
    r"\d+\)\s+(\d+(?:\.\d+)?)\s+(?:Rx|Tx)\s+([0-9A-Fa-f]{4}|[0-9A-Fa-f]{8})\s+(\d+)\s+((?:[0-9A-Fa-f]{2}\s*)*)$"
)
ZERO_BASED: Final = re.compile(r"\s*\((\d{3,4}\.\d{6})\)\s+[A-Za-z]\S*\s")
"""Stamps of ``candump -tz``, from the first frame, and of ``-td``, from the frame before."""
MAX_STAMPS_COMPARED: Final = 1000
YACHT_DEVICES: Final = re.compile(r"(\d\d):(\d\d):(\d\d)\.(\d{3}) [RT] ([0-9A-Fa-f]{8})((?: [0-9A-Fa-f]{2}){0,8})\s*$")
PAYLOAD: Final = re.compile(r"(?:#[0-9A-Fa-f])?((?:[0-9A-Fa-f]{2}\.?)*)(?:_[0-9A-Fa-f])?$")
MAX_DATA: Final = 64
PACKED: Final = {b"\x1f\x8b": "gzip", b"PK\x03\x04": "zip"}
MAX_STAMP_NS: Final = 1 << 63
MAX_OTHER_LINES: Final = 10_000
"""After so many lines without a single frame the rest of a file is not read."""
MAX_LINE: Final = 2048
"""Characters; a CAN FD frame of 64 bytes with everything that the formats add has less than 500."""
PCAN_COLUMNS: Final = {
    "1.0": "NOIlD",
    "1.1": "NOTIlD",
    "1.2": "NOBTIlD",
    "1.3": "NOBTIRlD",
    "2.0": "NOTIdlD",
    "2.1": "NOTBIdRLD",
}
"""Columns of the TRC versions by the letters of the format: number, offset [ms], type, bus, identifier, data."""
PCAN_DATA: Final = frozenset(("Rx", "Tx", "DT", "FD", "FB", "FE", "BI", "RR"))
PCAN_ERRORS: Final = frozenset(("Warng", "Error", "ST", "ER"))
PCAN_OTHERS: Final = frozenset(("EC", "EV"))
FD_BYTES: Final = (0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64)
ASC_BASE: Final = re.compile(r"base\s+(hex|dec)(?:\s+timestamps\s+(absolute|relative))?", re.IGNORECASE)
ASC_HEADER_LINES: Final = 5
ASC_TIMED: Final = re.compile(r"(-?\d{1,19}\.\d+)\s+(.+)")
ASC_OTHER: Final = re.compile(
    r"(?!CANFD\b)(?:[^\W\d]|[^\x00-\x7f])|\d+\s+(?:Statistic|SV:|J1939TP)|.*(?:\bStatus:|Trigger|log )"
)


def read_trace(path: Path) -> Trace:
    """Read the records of a trace in file order; raises OSError if the file cannot be opened."""
    content = path.read_bytes()
    if path.suffix.lower() == ".blf" or content.startswith(b"LOGG"):
        from can_dbc.trace.blf import read_blf

        return Trace(partial(read_blf, content))
    if (packed := next((kind for mark, kind in PACKED.items() if content.startswith(mark)), None)) is not None:
        return Trace(lambda _: iter([MalformedRecord(0, f"a {packed} file; unpack it and give the log inside")]))
    lines = decoded(content, "utf-8").splitlines()
    asc = path.suffix.lower() == ".asc" or any(ASC_BASE.match(line) for line in lines[:ASC_HEADER_LINES])
    return Trace(partial(_asc if asc else _text, lines))


# -- text ----------------------------------------------------------------------------------------------------


def _text(lines: list[str], notes: list[str]) -> Iterator[TraceFrame | MalformedRecord]:
    pcan = Pcan()
    error_frame, frame_found = False, False
    added_ns = 0 if _are_differences(lines) else None
    for number, raw in enumerate(lines, 1):
        line = raw.strip()
        if not line or line[0] == "#":
            continue
        if number > MAX_OTHER_LINES and not frame_found:
            yield MalformedRecord(number, f"no frame in the {number - 1} lines before; the rest is not read")
            break
        if line[0] == ";":
            pcan.header(line)
        elif error_frame and raw[0] == "\t":
            continue  # the words of `candump -e` about the error frame above
        elif len(line) > MAX_LINE:
            yield MalformedRecord(number, line[:MAX_LINE])
        elif (frame := parse_line(line) or pcan.frame(line)) is not None:
            error_frame, frame_found = bool(frame.key & ERROR), True
            if added_ns is not None:
                added_ns += frame.stamp_ns
                frame = TraceFrame(added_ns, frame.key, frame.data, frame.interface)
            yield frame
        elif not pcan.other(line):
            yield MalformedRecord(number, line)
    if added_ns is not None:
        notes.append("the stamps are those of candump -td, from one frame to the next, and are added up")
    if pcan.others:
        kinds = ", ".join(sorted(pcan.others))
        notes.append(f"{pcan.others.total()} rows of PCAN hold no frames ({kinds})")


def _are_differences(lines: list[str]) -> bool:
    """Tell whether stamps are those of ``candump -td``: the first is 0, more than a fifth of the others do not rise."""
    matches = (ZERO_BASED.match(line) for line in islice(lines, MAX_STAMPS_COMPARED))
    stamps = [float(match[1]) for match in matches if match is not None]
    return stamps[:1] == [0.0] and sum(b <= a for a, b in pairwise(stamps[1:])) * 5 > len(stamps)


def parse_line(line: str) -> TraceFrame | None:
    """Parse the frame in one line of any of the text formats; None if the line is of another format or damaged."""
    try:
        return _parsed(line)
    except ValueError:  # a number too long to convert, or blanks that are none to `bytes.fromhex`
        return None


def _parsed(line: str) -> TraceFrame | None:
    if match := CANDUMP.match(line):
        return _candump(match[1], match[2], match[3], match[4])
    if match := CANDUMP_SCREEN.match(line):
        remote = match[5].startswith("remote")
        data, length = ("", None) if remote else (match[5], int(match[4]))
        return _frame(match[1] or "0", match[3], data, length, remote, match[2])
    if match := PCAN_VIEW.match(line):
        return _frame(_milliseconds(match[1]), match[2], match[4], int(match[3]))
    if match := YACHT_DEVICES.match(line):
        seconds = int(match[1]) * 3600 + int(match[2]) * 60 + int(match[3])
        return _frame(f"{seconds}.{match[4]}", match[5], match[6])
    return None


def _candump(stamp: str, interface: str, identifier: str, rest: str) -> TraceFrame | None:
    if rest[:1] == "R":
        return _frame(stamp, identifier, "", None, remote=True, interface=interface)
    payload = PAYLOAD.match(rest)
    return _frame(stamp, identifier, payload[1].replace(".", ""), interface=interface) if payload else None


def _frame(
    stamp: str, identifier: str, data: str, length: int | None = None, remote: bool = False, interface: str = ""
) -> TraceFrame | None:
    payload = bytes.fromhex(data)
    value = int(identifier, 16)
    if len(payload) > MAX_DATA or length not in (None, len(payload)):
        return None
    if len(identifier) == 8:
        # eight digits with the error bit are an error frame, without it a 29-bit identifier
        key = value & (ERROR | EXTENDED_MASK) if value & ERROR else value & EXTENDED_MASK | EXTENDED
    else:
        key = value & STANDARD_MASK
    stamp_ns = _nanoseconds(stamp)
    if stamp_ns >= MAX_STAMP_NS:
        return None
    return TraceFrame(stamp_ns, key | (REMOTE if remote else 0), payload, interface)


def _nanoseconds(text: str) -> int:
    """Convert decimal seconds to ns, exactly; date and time of ``candump -tA``, which names no time zone, as UTC."""
    if text[4:5] == "-":
        day, _, clock = text.partition(" ")
        hour, minute, second = clock.split(":")
        days = calendar.timegm(date.fromisoformat(day).timetuple())
        return (days + int(hour) * 3600 + int(minute) * 60) * 1_000_000_000 + _nanoseconds(second)
    if text[:1] == "-":
        return -_nanoseconds(text[1:])
    whole, _, fraction = text.partition(".")
    return int(whole) * 1_000_000_000 + int(fraction[:9].ljust(9, "0"))


def _milliseconds(text: str) -> str:
    nanoseconds = _nanoseconds(text) // 1000
    return f"{nanoseconds // 1_000_000_000}.{nanoseconds % 1_000_000_000:09d}"


class Pcan:
    """The rows of a TRC file; the header says which columns it has, without one they are those of 1.0."""

    def __init__(self) -> None:
        self.columns = PCAN_COLUMNS["1.0"]
        self.others: Counter[str] = Counter()

    def header(self, line: str) -> None:
        """Take the version and the columns out of a comment line."""
        key, _, value = line[1:].replace(" ", "").partition("=")
        if key == "$FILEVERSION":
            self.columns = PCAN_COLUMNS.get(value, self.columns)
        elif key == "$COLUMNS":
            self.columns = value.replace(",", "")

    def frame(self, line: str) -> TraceFrame | None:
        """Parse a row's frame: data, remote, or an error frame for a bus error or warning; None for another row."""
        try:
            return self._parsed(self._cells(line))
        except (KeyError, ValueError):
            return None

    def other(self, line: str) -> bool:
        """Tell whether a row is of a kind that holds no frame; counts it."""
        kind = self._cells(line).get("T", "")
        self.others.update([kind] if kind in PCAN_OTHERS else [])
        return kind in PCAN_OTHERS

    def _cells(self, line: str) -> dict[str, str]:
        kind = line.split(maxsplit=3)[2:3]
        columns = self.columns
        if columns == PCAN_COLUMNS["1.0"] and kind and kind[0] in PCAN_DATA | PCAN_ERRORS:
            columns = PCAN_COLUMNS["1.1"]  # PCAN-View's rows, pasted without their header
        return dict(zip(columns, line.split(maxsplit=len(columns) - 1), strict=False))

    def _parsed(self, cells: dict[str, str]) -> TraceFrame | None:
        kind, identifier, data = cells.get("T", "Rx"), cells["I"], cells.get("D", "")
        if not re.fullmatch(r"\d+\)?", cells["N"]) or not re.fullmatch(r"\d+(\.\d+)?", cells["O"]):
            return None
        stamp, bus = _milliseconds(cells["O"]), cells.get("B", "")
        if kind in PCAN_ERRORS or identifier == "FFFFFFFF":
            if _nanoseconds(stamp) >= MAX_STAMP_NS:
                return None
            shown = re.match(r"(?:[0-9A-Fa-f]{2}\b\s*){0,8}", data)
            return TraceFrame(_nanoseconds(stamp), ERROR, bytes.fromhex(shown[0]) if shown else b"", bus)
        if kind not in PCAN_DATA or not re.fullmatch(r"[0-9A-Fa-f]{4}|[0-9A-Fa-f]{8}", identifier):
            return None
        remote = kind == "RR" or data.strip() == "RTR"
        length = int(cells["l"] if "l" in cells else cells["L"])
        if "l" not in cells and kind not in ("DT", "RR", "Rx", "Tx"):
            length = FD_BYTES[length] if length < len(FD_BYTES) else -1
        return _frame(stamp, identifier, "" if remote else data, None if remote else length, remote, bus)


# -- ASC, each line through python-can -----------------------------------------------------------------------


def _asc(lines: list[str], notes: list[str]) -> Iterator[TraceFrame | MalformedRecord]:
    """Read ASC line by line, so that a damaged line affects only itself.

    The stamp is read here: python-can takes neither a negative nor a relative one.
    """
    base, relative, stamp_ns, others = "hex", False, 0, 0
    for number, raw in enumerate(lines, 1):
        line = raw.strip()
        if match := ASC_BASE.match(line):
            base, relative = match[1].lower(), (match[2] or "").lower() == "relative"
        timed = ASC_TIMED.match(line)
        if timed is None:
            if line[:1].isdigit() or re.match(r"-\d", line):
                yield MalformedRecord(number, line[:MAX_LINE])
            continue
        if len(line) > MAX_LINE:
            yield MalformedRecord(number, line[:MAX_LINE])
            continue
        stamp_ns = _nanoseconds(timed[1]) + (stamp_ns if relative else 0)
        if abs(stamp_ns) >= MAX_STAMP_NS:
            yield MalformedRecord(number, line[:MAX_LINE])
            stamp_ns = 0
            continue
        frame = _asc_frame(timed[2], base, stamp_ns)
        if frame is not None:
            yield frame
        elif ASC_OTHER.match(timed[2]):
            others += "Start" not in timed[2]
        else:
            yield MalformedRecord(number, line)
    if others:
        notes.append(f"{others} lines are events of other kinds and hold no CAN frames")


def _asc_frame(event: str, base: str, stamp_ns: int) -> TraceFrame | None:
    from can.io.asc import ASCReader

    from can_dbc.trace.blf import converted

    logging.getLogger("can.io.asc").setLevel(logging.ERROR)  # a line a frame about lengths, which are checked below
    text = f"base {base} timestamps absolute\ninternal events logged\n0.0 {event}\n"
    try:
        messages = list(ASCReader(io.StringIO(text)))
    except (ValueError, IndexError, KeyError, OverflowError):
        return None
    if len(messages) != 1:
        return None
    message = messages[0]
    whole = message.is_remote_frame or message.is_error_frame or len(message.data) == min(message.dlc, MAX_DATA)
    return converted(message, stamp_ns) if whole or (not message.is_fd and len(message.data) == 8) else None
