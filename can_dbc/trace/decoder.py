"""Decodes traces to named values: the core of ``timberhand recording decode``.

Input is every record of `can_dbc.trace.candump`; output is a ``DecodedMessage`` for each message of a database.
Nothing raises for the contents of a trace: a frame of wrong length, out of range or with a bad CRC has ``fault`` set.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Final

from can_dbc.dbc.codec import Database, FrameRefused, MessageCodec, load
from can_dbc.frame import ERROR, EXTENDED, REMOTE, Frame, describe
from can_dbc.protocols.e2e import frame_crc
from can_dbc.protocols.nmea2000 import Reassembler, split_id
from can_dbc.trace.records import MalformedRecord

MAX_EXAMPLES: Final = 5
FIRST_FAST_PACKET_PGN: Final = 0x1ED00
"""Long messages of NMEA 2000 travel as fast packets; those of J1939, whose PGNs are lower, by J1939 transport."""
TRANSPORT_PGNS: Final = (0xEB00, 0xEC00)


@dataclass(frozen=True, slots=True)
class DecodedMessage:
    """One decoded message: stamp of its last frame [ns], identifier as candump writes it, values by name."""

    stamp_ns: int
    identifier: str
    name: str
    values: dict[str, Any]
    labels: dict[str, str]
    units: dict[str, str]
    fault: str

    def text(self) -> str:
        """The values in one line: ``Name=value unit``, labels where the database has them."""
        parts = []
        for name, value in self.values.items():
            shown = self.labels.get(name) or (f"{value:.10g}" if isinstance(value, float) else str(value))
            unit = "" if name in self.labels else self.units.get(name, "")
            parts.append(f"{name}={shown} {unit}".rstrip())
        return "  ".join(parts)

    def as_dict(self) -> dict[str, Any]:
        """For JSON; a float that is not finite becomes null."""
        finite = {
            name: None if isinstance(value, float) and not math.isfinite(value) else value
            for name, value in self.values.items()
        }
        entry = {
            "time_ns": self.stamp_ns,
            "id": self.identifier,
            "name": self.name,
            "values": finite,
            "labels": self.labels,
        }
        return entry | {"fault": self.fault} if self.fault else entry


class Decoder:
    """Decodes frames with the first database that has their message; raises DbcError for an unusable file."""

    def __init__(self, files: Sequence[str]) -> None:
        self.databases: list[Database] = [load(file) for file in files]
        self.reassembler = Reassembler()
        self.counts: Counter[str] = Counter()
        self.messages: Counter[str] = Counter()
        self.broken_examples: list[str] = []

    def run(self, records: Iterable[Frame | MalformedRecord]) -> Iterator[DecodedMessage]:
        """Yields the decoded messages of a trace; ``summary`` is complete at the end."""
        for record in records:
            if isinstance(record, MalformedRecord):
                self.counts["broken"] += 1
                if len(self.broken_examples) < MAX_EXAMPLES:
                    where = f"line {record.line}: " if record.line else ""
                    self.broken_examples.append(where + record.text[: 80 if record.line else None])
                continue
            self.counts["frames"] += 1
            entry = self._frame(record)
            if entry is not None:
                self.counts["decoded"] += not entry.fault
                self.messages[entry.name] += 1
                yield entry

    def summary(self) -> dict[str, Any]:
        """Counts of the records, by kind and by message."""
        names = ("frames", "decoded", "unknown", "refused", "bad_crc", "error_frames", "broken", "j1939_transport")
        return {name: self.counts[name] for name in names} | {
            "lost_fast_packets": self.reassembler.lost,
            "messages": dict(sorted(self.messages.items())),
            "broken_examples": self.broken_examples,
        }

    def _frame(self, frame: Frame) -> DecodedMessage | None:
        if frame.key & (ERROR | REMOTE):
            self.counts["error_frames" if frame.key & ERROR else "unknown"] += 1
            return None
        codec = next((c for d in self.databases if (c := d.find(frame.key)) is not None), None)
        if codec is None:
            self.counts["unknown"] += 1
            self.counts["j1939_transport"] += bool(frame.key & EXTENDED) and split_id(frame.key).pgn in TRANSPORT_PGNS
            return None
        try:
            data = self._payload(frame, codec)
        except FrameRefused as refusal:
            self.counts["refused"] += 1
            return _decoded(frame, codec, {}, str(refusal))
        if data is None:
            return None
        fault = ""
        try:
            values = codec.named(codec.receive(data))
        except FrameRefused as refusal:
            self.counts["refused"] += 1
            values, fault = self._unchecked(codec, data), str(refusal)
        if not fault and codec.data_ids and frame_crc(data, codec.data_ids) != data[0]:
            self.counts["bad_crc"] += 1
            fault = "bad CRC"
        return _decoded(frame, codec, values, fault)

    def _payload(self, frame: Frame, codec: MessageCodec) -> bytes | None:
        """The bytes to decode; None while a fast packet is incomplete."""
        if not codec.by_pgn or codec.length <= 8 or split_id(frame.key).pgn < FIRST_FAST_PACKET_PGN:
            return frame.data
        data = self.reassembler.add(frame.key, frame.data, frame.stamp_ns)
        return None if data is None else data[: codec.length]

    @staticmethod
    def _unchecked(codec: MessageCodec, data: bytes) -> dict[str, Any]:
        """The values of a refused frame, as far as they can be decoded."""
        try:
            return codec.named(codec.decode(data))
        except FrameRefused:
            return {}


def _decoded(frame: Frame, codec: MessageCodec, values: dict[str, Any], fault: str) -> DecodedMessage:
    labels, units = {}, {}
    values = {name: value for name, value in values.items() if not name.startswith("Reserved")}
    for s in codec.signals:
        value = values.get(s.name)
        if value is not None and math.isfinite(value):
            label = s.choices.get(int(s.convert(value)))
            if label is not None:
                labels[s.name] = label
        if s.unit not in ("", "1"):
            units[s.name] = s.unit
    return DecodedMessage(frame.stamp_ns, describe(frame.key), codec.name, values, labels, units, fault)
