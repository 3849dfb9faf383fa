"""Decodes traces to named values: the core of ``timberhand recording decode``.

Input is every record of `can_dbc.trace.candump`; output is a ``DecodedMessage`` for each message of a database.
Nothing raises for the contents of a trace: a frame of wrong length, out of range or with a bad CRC has ``fault`` set.
The fast packets of NMEA 2000 and the transport protocol of J1939 are reassembled for each interface of the trace apart.
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
from can_dbc.protocols.j1939_transport import CONNECTION_PGN, DATA_PGN, Transport
from can_dbc.protocols.nmea2000 import Reassembler, split_id
from can_dbc.trace.records import MalformedRecord, TraceFrame

MAX_EXAMPLES: Final = 5
FIRST_FAST_PACKET_PGN: Final = 0x1ED00
"""NMEA 2000 has fast packets from here on (126208 is the first in use); the PGNs of J1939 lie below."""


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
    interface: str = ""

    def text(self) -> str:
        """Write the values in one line: ``Name=value unit``, labels where the database has them."""
        parts = []
        for name, value in self.values.items():
            shown = self.labels.get(name) or (f"{value:.10g}" if isinstance(value, float) else str(value))
            unit = "" if name in self.labels else self.units.get(name, "")
            parts.append(f"{name}={shown} {unit}".rstrip())
        return "  ".join(parts)

    def as_dict(self) -> dict[str, Any]:
        """Return a dictionary for JSON; a float that is not finite becomes null."""
        finite = {
            name: None if isinstance(value, float) and not math.isfinite(value) else value
            for name, value in self.values.items()
        }
        entry = {
            "time_ns": self.stamp_ns,
            "interface": self.interface,
            "id": self.identifier,
            "name": self.name,
            "values": finite,
            "labels": self.labels,
        }
        return entry | {"fault": self.fault} if self.fault else entry


class _Bus:
    """What is under way on one interface of a trace."""

    __slots__ = ("frames", "interface", "reassembler", "transport")

    def __init__(self, interface: str) -> None:
        self.interface, self.frames = interface, 0
        self.reassembler, self.transport = Reassembler(), Transport()


class Decoder:
    """Decodes frames with the first database that has their message; raises ConfigError for an unusable file."""

    def __init__(self, files: Sequence[str]) -> None:
        self.databases: list[Database] = [load(file) for file in files]
        self._buses: dict[str, _Bus] = {}
        self.counts: Counter[str] = Counter()
        self.messages: Counter[str] = Counter()
        self.broken_examples: list[str] = []

    def run(self, records: Iterable[Frame | MalformedRecord]) -> Iterator[DecodedMessage]:
        """Yield the decoded messages of a trace; ``summary`` is complete at the end."""
        for record in records:
            if isinstance(record, MalformedRecord):
                self.counts["broken"] += 1
                if len(self.broken_examples) < MAX_EXAMPLES:
                    self.broken_examples.append(record.shown)
                continue
            self.counts["frames"] += 1
            bus = self._bus(record)
            bus.frames += 1
            for entry in self._entries(record, bus):
                self.counts["decoded"] += not entry.fault
                self.messages[entry.name] += 1
                yield entry
        for bus in self._buses.values():
            bus.reassembler.end()
            bus.transport.end()

    def summary(self) -> dict[str, Any]:
        """Count the records, by kind and by message."""
        names = (
            "frames",
            "decoded",
            "unknown",
            "refused",
            "bad_crc",
            "error_frames",
            "remote_frames",
            "broken",
            "transported",
            "unknown_transported",
        )
        buses = self._buses.values()
        return {name: self.counts[name] for name in names} | {
            "lost_fast_packets": sum(bus.reassembler.lost for bus in buses),
            "lost_transported": sum(bus.transport.lost for bus in buses),
            "unopened_transported": sum(bus.transport.unopened for bus in buses),
            "extended_transported": sum(bus.transport.extended for bus in buses),
            "interfaces": {name: bus.frames for name, bus in sorted(self._buses.items()) if name},
            "messages": dict(sorted(self.messages.items())),
            "broken_examples": self.broken_examples,
        }

    def _bus(self, frame: Frame) -> _Bus:
        interface = frame.interface if isinstance(frame, TraceFrame) else ""
        bus = self._buses.get(interface)
        if bus is None:
            bus = self._buses[interface] = _Bus(interface)
        return bus

    def _find(self, key: int) -> MessageCodec | None:
        return next((c for d in self.databases if (c := d.find(key)) is not None), None)

    def _entries(self, frame: Frame, bus: _Bus) -> Iterator[DecodedMessage]:
        entry = self._frame(frame, bus)
        if entry is not None:
            yield entry
        message = bus.transport.receive(frame.key, frame.data, frame.stamp_ns)
        if message is None:
            return
        self.counts["transported"] += 1
        codec = self._find(message.key)
        if codec is None:
            self.counts["unknown_transported"] += 1
            return
        yield self._checked(Frame(frame.stamp_ns, *message), codec, message.data[: codec.length], bus)

    def _frame(self, frame: Frame, bus: _Bus) -> DecodedMessage | None:
        if frame.key & (ERROR | REMOTE):
            self.counts["error_frames" if frame.key & ERROR else "remote_frames"] += 1
            return None
        codec = self._find(frame.key)
        if codec is None:
            if not (frame.key & EXTENDED and split_id(frame.key).pgn in (CONNECTION_PGN, DATA_PGN)):
                self.counts["unknown"] += 1
            return None
        data: bytes | None = frame.data
        if _is_fast_packet(codec):
            try:
                data = bus.reassembler.add(frame.key, frame.data, frame.stamp_ns)
            except FrameRefused as refusal:
                self.counts["refused"] += 1
                return _decoded(frame, codec, {}, str(refusal), bus)
        return None if data is None else self._checked(frame, codec, data, bus)

    def _checked(self, frame: Frame, codec: MessageCodec, data: bytes, bus: _Bus) -> DecodedMessage:
        """Decode a message with all its bytes; a PGN may have more than the database describes, or fewer in J1939."""
        if codec.by_pgn and codec.length > 8:
            data = data[: codec.length]
        fault = ""
        try:
            if codec.by_pgn and len(data) < codec.length and not _is_fast_packet(codec) and codec.length > 8:
                return _decoded(frame, codec, _present(codec, data), "", bus)
            values = codec.named(codec.receive(data))
        except FrameRefused as refusal:
            self.counts["refused"] += 1
            values, fault = self._unchecked(codec, data), str(refusal)
        if not fault and codec.data_ids and frame_crc(data, codec.data_ids) != data[0]:
            self.counts["bad_crc"] += 1
            fault = "bad CRC"
        return _decoded(frame, codec, values, fault, bus)

    @staticmethod
    def _unchecked(codec: MessageCodec, data: bytes) -> dict[str, Any]:
        """Decode the values of a refused frame, as far as they can be decoded."""
        try:
            return codec.named(codec.decode(data))
        except FrameRefused:
            return {}


def _is_fast_packet(codec: MessageCodec) -> bool:
    """Tell whether a message travels as a fast packet; a long message of J1939 uses the transport protocol instead."""
    return codec.by_pgn and codec.length > 8 and split_id(codec.key).pgn >= FIRST_FAST_PACKET_PGN


def _present(codec: MessageCodec, data: bytes) -> dict[str, Any]:
    """Decode the values whose bits a message of J1939 holds that is shorter than the database describes.

    Raises FrameRefused.
    """
    padded = data.ljust(codec.length, b"\xff")
    little, big = int.from_bytes(padded, "little"), int.from_bytes(padded, "big")
    values: dict[str, Any] = {}
    raws: dict[int, int | float] = {}
    for index, s in enumerate(codec.signals):
        last_byte = codec.length - 1 - s.shift // 8 if s.big_endian else (s.shift + s.bits - 1) // 8
        if last_byte >= len(data) or (s.parent is not None and raws.get(s.parent) not in s.parent_ids):
            continue
        raws[index] = raw = s.extract(little, big)
        value = s.valid(raw)
        if value is not None:
            values[s.name] = value
    return values


def _decoded(frame: Frame, codec: MessageCodec, values: dict[str, Any], fault: str, bus: _Bus) -> DecodedMessage:
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
    key = describe(frame.key)
    return DecodedMessage(frame.stamp_ns, key, codec.name, values, labels, units, fault, bus.interface)
