"""The decoded CAN table of one bus; pure: frames and integer times in, JSON-ready dictionaries out.

Each message has a row: rate, age, the values of its newest frame by signal name with unit, and what a receiver would
refuse.  Frames with an end-to-end protection are checked as a receiver checks them (`can_dbc.protocols.e2e`), on their
own: the counts are those of this table since it was opened, not the controller's.  The load counts the bits of every
frame without stuff bits, so the true load is up to a fifth higher.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

from can_dbc.dbc.codec import Database, FrameRefused, MessageCodec
from can_dbc.frame import ERROR, EXTENDED, REMOTE, Frame, describe
from can_dbc.protocols.canopen import parse_heartbeat
from can_dbc.protocols.e2e import Checker, Status

WINDOW_NS: Final = 1_000_000_000
"""Rates and load are those of the last second."""
MAX_ROWS: Final = 256
"""Foreign identifiers beyond this are counted together: a babbling node must not fill the memory."""
PROTECTION: Final = ("Crc", "Counter")
"""Signals of an end-to-end protection, whose verdict is in the columns."""
_STANDARD_BITS: Final = 47
_EXTENDED_BITS: Final = 67
"""Bits of a frame without data and stuff bits, with the pause behind it (ISO 11898-1, 10.4)."""


@dataclass(slots=True)
class _Row:
    """What is known of one identifier."""

    key: int
    name: str
    codec: MessageCodec | None
    checker: Checker | None
    stamps: deque[int] = field(default_factory=deque)
    count: int = 0
    stamp_ns: int = 0
    data: bytes = b""
    refused: int = 0
    lost: int = 0
    why: str = ""


class CanTable:
    """The table of one bus; ``bitrate`` [bit/s] 0: unknown, and the load with it."""

    def __init__(self, bus: str, databases: Iterable[Database], bitrate: int = 0) -> None:
        self.bus = bus
        self._databases = tuple(databases)
        self._bitrate = bitrate
        self._rows: dict[int, _Row] = {}
        self._bits: deque[tuple[int, int]] = deque()
        self._other = 0

    def on_frames(self, frames: Sequence[Frame]) -> None:
        """Take received frames, oldest first."""
        for stamp_ns, key, data in frames:
            if key & ERROR:
                continue
            row = self._rows.get(key)
            if row is None:
                if len(self._rows) >= MAX_ROWS:
                    self._other += 1
                    continue
                row = self._rows[key] = self._new_row(key, data)
            row.count += 1
            row.stamps.append(stamp_ns)
            row.stamp_ns, row.data = stamp_ns, data
            bits = _EXTENDED_BITS if key & EXTENDED else _STANDARD_BITS
            self._bits.append((stamp_ns, bits + (0 if key & REMOTE else 8 * len(data))))
            if row.codec is not None:
                _check(row, row.codec, data)

    def table(self, now_ns: int) -> dict[str, Any]:
        """Return the table now, rows in the order of their identifiers."""
        since_ns = now_ns - WINDOW_NS
        while self._bits and self._bits[0][0] <= since_ns:
            self._bits.popleft()
        bits = sum(b for _, b in self._bits)
        load = round(100.0 * bits * 1e9 / WINDOW_NS / self._bitrate, 1) if self._bitrate and self._rows else None
        return {
            "bus": self.bus,
            "load_pct": load,
            "frames_per_s": len(self._bits),
            "other": self._other,
            "rows": [self._row(row, now_ns, since_ns) for _, row in sorted(self._rows.items())],
        }

    def _new_row(self, key: int, data: bytes) -> _Row:
        codec = next((c for database in self._databases if (c := database.find(key))), None)
        if codec is not None:
            return _Row(key, codec.name, codec, Checker(codec.data_ids) if codec.data_ids else None)
        return _Row(key, "heartbeat" if parse_heartbeat(key, data) else "", None, None)

    def _row(self, row: _Row, now_ns: int, since_ns: int) -> dict[str, Any]:
        while row.stamps and row.stamps[0] <= since_ns:
            row.stamps.popleft()
        codec, age_ns = row.codec, max(0, now_ns - row.stamp_ns)
        return {
            "id": describe(row.key),
            "name": row.name,
            "sender": ", ".join(codec.senders) if codec else "",
            "rate_hz": len(row.stamps),
            "age_ms": round(age_ns / 1e6),
            "late": bool(codec and codec.timeout_ns and age_ns > codec.timeout_ns),
            "count": row.count,
            "e2e": row.checker is not None,
            "refused": row.refused,
            "lost": row.lost,
            "why": row.why,
            "values": _values(codec, row.data) if codec else [["", row.data.hex(" ").upper(), ""]],
        }


def _check(row: _Row, codec: MessageCodec, data: bytes) -> None:
    """Count what a receiver would refuse: length, checksum, counter, range."""
    if len(data) != codec.length:
        row.refused, row.why = row.refused + 1, f"length {len(data)} instead of {codec.length}"
        return
    if row.checker is not None:
        status = row.checker.check(data)
        if status is Status.OK_SOME_LOST:
            row.lost += 1
        elif status in (Status.ERROR, Status.REPEATED, Status.WRONG_SEQUENCE):
            row.refused, row.why = row.refused + 1, _STATUS_WORDS[status]
            return
    try:
        codec.receive(data)
    except FrameRefused as error:
        row.refused, row.why = row.refused + 1, str(error)


_STATUS_WORDS: Final = {
    Status.ERROR: "wrong checksum",
    Status.REPEATED: "repeated counter",
    Status.WRONG_SEQUENCE: "jump of the counter",
}


def _values(codec: MessageCodec, data: bytes) -> list[list[str]]:
    """List name, value and unit of every signal; an unavailable value is a dash, one with a label has its label."""
    if len(data) != codec.length:
        return [["", data.hex(" ").upper(), ""]]
    shown = []
    for signal, value in zip(codec.signals, codec.decode(data), strict=True):
        if value is None or (codec.data_ids and signal.name in PROTECTION):  # left out by the multiplexer
            continue
        raw = round((value - signal.offset) / signal.scale) if not signal.is_float else None
        label = signal.choices.get(raw) if raw is not None else None
        if label in ("NotAvailable", "Error"):
            shown.append([signal.name, "–" if label == "NotAvailable" else label, ""])
        elif label is not None:
            shown.append([signal.name, f"{label} ({raw})", ""])
        else:
            shown.append([signal.name, f"{value:.6g}" if isinstance(value, float) else str(value), signal.unit])
    return shown
