"""The guard's own parser of ``crane.dbc`` and ``machine.dbc``, by regular expression, with no fault of the codecs.

It reads only what the guard needs: identifier (a key as in `can_dbc.frame`), length, Data IDs, time-out and the bits
of little-endian signals.  Anything missing or of another form stops the start with `GuardConfigError`.
"""

from __future__ import annotations

import re
from pathlib import Path


class GuardConfigError(Exception):
    """The guard cannot start; the sentence tells what is wrong, where, and what to do; ``code`` is stable."""

    def __init__(self, code: str, sentence: str) -> None:
        super().__init__(sentence)
        self.code = code


class Field:
    """One signal: the position of its bits, its scale and its range."""

    __slots__ = ("_mask", "_shift", "_sign", "maximum", "minimum", "scale")

    def __init__(self, shift: int, bits: int, signed: bool, scale: float, minimum: float, maximum: float) -> None:
        self._shift, self._mask = shift, (1 << bits) - 1
        self._sign = 1 << (bits - 1) if signed else 0
        self.scale, self.minimum, self.maximum = scale, minimum, maximum

    def raw(self, word: int) -> int:
        """Extract the raw value from a payload that was read as a little-endian number."""
        value = word >> self._shift & self._mask
        return value - 2 * self._sign if value & self._sign else value

    def put(self, value: int) -> int:
        """Put the bits of an unsigned raw value at their position."""
        return (value & self._mask) << self._shift

    def inside(self, raw: int) -> bool:
        """Tell whether a raw value lies in the range that the DBC declares."""
        return self.minimum - 1e-9 <= raw * self.scale <= self.maximum + 1e-9


class Layout:
    """One message of the DBC."""

    __slots__ = ("data_ids", "fields", "key", "length", "timeout_ns")

    def __init__(self, key: int, length: int, fields: dict[str, Field], data_ids: bytes, timeout_ns: int) -> None:
        self.key, self.length, self.fields = key, length, fields
        self.data_ids, self.timeout_ns = data_ids, timeout_ns


def read_layouts(path: Path, names: list[str]) -> dict[str, Layout]:
    """Read the layouts of the named messages; raises GuardConfigError."""
    try:
        text = path.read_text(encoding="utf-8-sig", errors="replace")  # what is read here is ASCII
    except OSError as error:
        raise GuardConfigError("guard.dbc-unreadable", f"{path}: cannot be read: {error}.") from error
    try:
        return {name: _layout(text, name, path) for name in names}
    except (ValueError, OverflowError) as error:  # a number of a form that Python does not convert
        raise GuardConfigError("guard.dbc-unreadable", f"{path}: a number cannot be read: {error}.") from error


def _layout(text: str, name: str, path: Path) -> Layout:
    head = re.search(rf"^BO_ (\d+) {re.escape(name)}: (\d+) \w+\n((?: SG_ .*\n)*)", text, re.MULTILINE)
    if head is None:
        raise GuardConfigError("guard.message-missing", f"{path}: message {name} is missing; use the shipped DBC.")
    number = int(head[1])
    fields = {}
    for line in head[3].splitlines():
        match = re.match(r" SG_ (\w+) : (\d+)\|(\d+)@1([+-]) \(([^,]+),([^)]+)\) \[([^|]+)\|([^\]]+)\]", line)
        if match is None or float(match[6]) != 0.0 or not 1 <= int(match[3]) <= 64 or int(match[2]) > 63:
            raise GuardConfigError("guard.signal-unreadable", f"{path}: unreadable signal of {name}: {line.strip()}")
        fields[match[1]] = Field(
            int(match[2]), int(match[3]), match[4] == "-", float(match[5]), float(match[7]), float(match[8])
        )
    ids = re.search(rf'^BA_ "E2EDataIds" BO_ {number} "([0-9A-F ]+)";', text, re.MULTILINE)
    timeout = re.search(rf'^BA_ "TimeoutMs" BO_ {number} (\d+);', text, re.MULTILINE)
    data_ids = bytes.fromhex(ids[1]) if ids else b""
    if data_ids and len(data_ids) != 16:
        raise GuardConfigError("guard.data-ids", f"{path}: {name} needs 16 Data IDs.")
    return Layout(number, int(head[2]), fields, data_ids, int(timeout[1]) * 1_000_000 if timeout else 0)
