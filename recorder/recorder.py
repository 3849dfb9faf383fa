"""The recorder: writes its inputs to a candump file per bus and to ``run.mcap``.

Inputs: frames of the buses, the controller's tick records, state reports and timing page, each with its own monotonic
stamp; the recorder has no clock.  Outputs, in one directory:

* ``<bus>.log``: ``candump -L`` text, for can-utils, SavvyCAN and python-can.
* ``run.mcap`` (then ``run-0002.mcap`` and so on, one per 512 MiB and after a full disk): ``/<bus>/raw`` (the
  16 bytes of the kernel's ``struct can_frame``, then the sender's name if it is known), ``/<bus>/<message>``
  (decoded signals, JSON), ``/controller/tick`` (raw, see ``can_dbc.messages.tick_record``), ``/controller/report``,
  ``/timing`` (the controller's timing page) and ``/manifest`` (JSON), and what Foxglove and Lichtblick draw of the
  machine (``machine.foxglove``).
  Publish time is monotonic; log time is UTC if the manifest has it (live), else monotonic, too.
* ``manifest.json``: see ``recorder.manifest``.
* ``stops/``: a file for every stop of the machine, see ``recorder.stop_recorder``.

A chunk ends at least every 200 ms of recorded time, and live it is flushed to the disk, so that a killed process or a
power cut loses at most 250 ms.  A full disk costs records, counted in ``dropped``, and nothing else.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, Final

import msgspec

from can_dbc.dbc import codec
from can_dbc.dbc.codec import Database, MessageCodec
from can_dbc.frame import ERROR, REMOTE, Frame, describe
from can_dbc.messages import datagrams, tick_record
from can_dbc.messages.crane import StateReport
from can_dbc.messages.envelope import DatagramRefused, without_mac
from can_dbc.messages.json_schema import flat_schema
from can_dbc.messages.mission import decode_grasp, decode_mission
from can_dbc.messages.picture import decode_picture
from can_dbc.messages.vehicle import VehicleReport
from can_dbc.timing.page import Timing
from machine.foxglove import ENCODING, MachineTopics, Message
from machine.profile import Profile
from recorder import manifest as manifests
from recorder.manifest import Manifest
from recorder.recover import RUN_NAME, recover, run_files
from recorder.segment import CommitFile, Segment
from recorder.stop_recorder import TICK as TICK
from recorder.stop_recorder import Stop, StopFiles, StopRecorder
from runtime.errors import InputRefused

# -- Decodes the frames of a bus for a recording: message name, and values under their DBC names.
#
# Values are physical and unchecked (``codec.decode``): a recording shows what was on the bus, including values out
# of range and frames that a receiver refuses.  Only a frame of wrong length has no values.


class BusSignals:
    """The messages of one bus, from one or more databases."""

    def __init__(self, databases: Iterable[Database]) -> None:
        self._databases = tuple(databases)
        self._found: dict[int, tuple[MessageCodec, tuple[str, ...]] | None] = {}

    def messages(self) -> list[MessageCodec]:
        """List every message that can be decoded, in the order of the databases."""
        return [codec for database in self._databases for codec in database.messages.values()]

    def decode(self, key: int, data: bytes) -> tuple[str, dict[str, Any]] | None:
        """Decode message name and values of a frame; None for a foreign frame or a wrong length."""
        try:
            codec_and_names = self._found[key]
        except KeyError:
            codec_and_names = self._found[key] = self._find(key)
        if codec_and_names is None or len(data) != codec_and_names[0].length:
            return None
        codec, names = codec_and_names
        return codec.name, dict(zip(names, codec.decode(data), strict=True))

    def _find(self, key: int) -> tuple[MessageCodec, tuple[str, ...]] | None:
        for database in self._databases:
            if codec := database.find(key):
                return codec, tuple(s.name for s in codec.signals)
        return None


def json_schema(codec: MessageCodec) -> bytes:
    """Write the JSON schema of a message's values, with units and value tables in the descriptions."""
    properties: dict[str, Any] = {}
    for signal in codec.signals:
        table = ", ".join(f"{raw} {label}" for raw, label in sorted(signal.choices.items()))
        text = "; ".join(part for part in (signal.comment, signal.unit and f"[{signal.unit}]", table) if part)
        properties[signal.name] = {"type": "number", "description": text}
    return msgspec.json.encode({"type": "object", "description": codec.comment, "properties": properties})


# -- The recorder


STOPS_NAME: Final = "stops"
CHUNK_NS: Final = 200_000_000
SEGMENT_BYTES: Final = 512 * 2**20
END_NS: Final = 2**32 * 10**9
"""Times from here on fit into no recording: those of Foxglove's messages have 32 bits of seconds (year 2106)."""
REPORT: Final = "/controller/report"
VEHICLE: Final = "/controller/vehicle"
TIMING: Final = "/timing"

_CAN_FRAME: Final = struct.Struct("<IB3x8s")
_JSON: Final = msgspec.json.Encoder()
_OBJECT: Final = b'{"type":"object"}'


class Recorder:
    """One recording (module docstring: contract)."""

    def __init__(
        self,
        directory: Path,
        profile: Profile,
        manifest: Manifest,
        key: bytes | None = None,
        sync: bool = True,
        stops: Path | None = None,
        on_stop: Callable[[Stop, Path], None] | None = None,
    ) -> None:
        """Start a recording in ``directory``, which is created; ``key`` is that of authenticated reports.

        ``stops`` is the directory of the stops' files, default ``directory/stops``; ``on_stop`` is called with every
        stop and the path that its file will have.

        Raises:
            InputRefused: The directory cannot be written or contains a recording.
        """
        self.dropped = 0
        """Records lost because they could not be written."""
        self.refused = 0
        """Reports, pictures and tick records that were invalid, or of a time that fits into no recording."""
        self.other_key = False
        """A refused datagram was a state report with an authenticator of another key, or there is no key here."""
        self._directory = directory
        self._manifest = manifest
        self._durable = sync and manifest.live
        self._key, self._drives = key, profile.carrier is not None
        self._offset_ns = manifest.utc_offset_ns
        databases = manifests.databases(profile)
        self._signals = {bus: BusSignals(map(codec.load, databases[bus])) for bus in manifest.buses}
        self._topics = MachineTopics(profile)
        self._chunk_start_ns: int | None = None
        self._chunk_end_ns: int | None = None
        self._now_ns = manifest.start_monotonic_ns or 0
        self._segments = 0
        self._segment: Segment | None = None
        self._text: dict[str, CommitFile] = {}
        try:
            directory.mkdir(parents=True, exist_ok=True)
            if run_files(directory):
                recover(directory)
                raise InputRefused(
                    "recording.exists", f"{directory} already contains a recording; give another directory"
                )
            manifests.write(directory, manifest)
            for bus in manifest.buses:
                self._text[bus] = CommitFile(directory / f"{bus}.log", self._durable)
            self._open_segment()
        except OSError as error:
            for bus, text in self._text.items():  # else the next attempt finds them
                text.close()
                (directory / f"{bus}.log").unlink(missing_ok=True)
            raise InputRefused(
                "recording.cannot-write",
                f"cannot record in {directory} ({error.strerror}); free space on the disk or give another directory",
            ) from error
        self._stops = StopRecorder(StopFiles(stops or directory / STOPS_NAME, self._durable), manifest, on_stop)

    @property
    def lost(self) -> int:
        """Records and stops that could not be written."""
        return self.dropped + self._stops.dropped

    def on_frame(self, bus: str, frame: Frame, sent_by: str = "") -> None:
        """Record a frame on ``bus``; ``sent_by`` names the sender if it is known."""
        stamp_ns, key, data = frame
        self._at(stamp_ns)
        us = (stamp_ns + self._offset_ns) // 1000
        payload = "R" if key & REMOTE else data.hex().upper()
        line = f"({us // 1_000_000}.{us % 1_000_000:06d}) {bus} {describe(key)}#{payload}\n"
        self._text[bus].write(line.encode())
        self._add(f"/{bus}/raw", stamp_ns, _CAN_FRAME.pack(key, len(data), data) + sent_by.encode())
        if not key & (ERROR | REMOTE) and (decoded := self._signals[bus].decode(key, data)):
            self._add(f"/{bus}/{decoded[0]}", stamp_ns, _JSON.encode(decoded[1]))

    def on_tick(self, record: bytes) -> None:
        """Record the controller's record of one tick, unchanged."""
        try:
            tick = tick_record.decode(record)
        except InputRefused:
            self.refused += 1
            return
        self._at(tick.now_ns)
        self._add(TICK, tick.now_ns, record)
        self._stops.on_tick(tick, record)

    def on_report(self, datagram: bytes) -> None:
        """Record the controller's state report or vehicle report, and the log map of the planner's mission report."""
        try:
            report = datagrams.decode(datagram, self._key)
        except DatagramRefused:
            if self._on_planner(datagram):
                return
            report = None
        if isinstance(report, VehicleReport) and self._drives:
            topic = VEHICLE
        elif isinstance(report, StateReport):
            topic = REPORT
        else:
            self.refused += 1
            self.other_key = self.other_key or _is_signed_report(datagram)
            return
        stamp_ns, time_ns = report.stamp_ns, report.stamp_ns + self._offset_ns
        if not self._holds(stamp_ns):
            return
        self._at(stamp_ns)
        self._add(topic, stamp_ns, _JSON.encode(report))
        on = self._topics.on_position if isinstance(report, VehicleReport) else self._topics.on_state
        self._add_drawing(on(report, time_ns), stamp_ns)  # type: ignore[arg-type]

    def _on_planner(self, datagram: bytes) -> bool:
        """Record the log map of a mission report; False when the planner did not send the datagram."""
        try:
            _, stamp_ns, mission = decode_mission(datagram, self._key)
        except DatagramRefused:
            return _is_grasp(datagram, self._key)
        if self._holds(stamp_ns):
            self._at(stamp_ns)
            self._add_drawing(self._topics.on_mission(mission, stamp_ns + self._offset_ns), stamp_ns)
        return True

    def on_picture(self, datagram: bytes) -> None:
        """Record a log detector's reply to a request for its newest picture; a reply without one is not recorded."""
        try:
            facts, jpeg = decode_picture(datagram)
        except InputRefused:
            return
        if jpeg and self._holds(facts.measured_ns):
            self._at(facts.measured_ns)
            messages = self._topics.on_picture(facts.camera, jpeg, facts.measured_ns + self._offset_ns)
            self._add_drawing(messages, facts.measured_ns)

    def on_timing(self, timing: Timing) -> None:
        """Record the controller's timing, once per state of its page."""
        stamp_ns = timing.facts.written_ns
        self._at(stamp_ns)
        self._add(TIMING, stamp_ns, _JSON.encode(timing.named()))

    def flush(self, now_ns: int) -> None:
        """End the chunk and write everything to the files; ``dropped`` counts what cannot be written."""
        self._now_ns = now_ns
        self._chunk_start_ns = self._chunk_end_ns = None
        self._stops.commit(now_ns)
        for text in self._text.values():
            lines = text.buffer.count(b"\n")
            try:
                text.commit()
            except OSError:
                self.dropped += lines
        try:
            if self._segment is None:
                self._open_segment()
            elif self._segment.commit() > SEGMENT_BYTES:
                self._segment.finish()
                self._segment = None
                self._open_segment()
        except OSError:
            self._abandon()

    def close(self) -> None:
        """Complete the files."""
        self._stops.close()
        self.flush(self._now_ns)
        if self._segment:
            try:
                self._segment.finish()
            except OSError:
                self._abandon()
        for text in self._text.values():
            text.close()
        complete = msgspec.structs.replace(self._manifest, complete=True, dropped=self.lost)
        try:
            manifests.write(self._directory, complete)
        except OSError:
            self.dropped += 1

    def _holds(self, stamp_ns: int) -> bool:
        """Tell whether a recording can hold this time, which another process says; count what it cannot as refused."""
        holds = 0 <= stamp_ns < END_NS - self._offset_ns
        self.refused += not holds
        return holds

    def _at(self, stamp_ns: int) -> None:
        """End the chunk before a record that would make it longer than CHUNK_NS, in any order of records."""
        start_ns = self._chunk_start_ns
        if start_ns is not None and start_ns <= stamp_ns < start_ns + CHUNK_NS:  # the usual case
            self._chunk_end_ns = max(self._chunk_end_ns or 0, stamp_ns)
            return
        start_ns = stamp_ns if start_ns is None else min(start_ns, stamp_ns)
        if self._chunk_end_ns is not None and max(self._chunk_end_ns, stamp_ns) - start_ns >= CHUNK_NS:
            self.flush(stamp_ns)
            start_ns = stamp_ns
        self._chunk_start_ns = start_ns
        self._chunk_end_ns = stamp_ns if self._chunk_end_ns is None else max(self._chunk_end_ns, stamp_ns)

    def _add(self, topic: str, stamp_ns: int, data: bytes) -> None:
        if self._segment is None:
            self.dropped += 1
        else:
            self._segment.add(topic, stamp_ns + self._offset_ns, stamp_ns, data)

    def _add_drawing(self, messages: list[Message], stamp_ns: int) -> None:
        """Add what is drawn from a record that is kept anyway: a full disk does not count it as lost."""
        if self._segment is not None:
            for topic, data in messages:
                self._segment.add(topic, stamp_ns + self._offset_ns, stamp_ns, data, counted=False)

    def _open_segment(self) -> None:
        """Open the next file; its first chunk has every channel and the manifest, and is written immediately."""
        name = f"run-{self._segments + 1:04d}.mcap" if self._segments else RUN_NAME
        segment = Segment(self._directory / name, self._durable)
        for bus, signals in self._signals.items():
            segment.channel(f"/{bus}/raw", "socketcan")
            for message in signals.messages():
                segment.channel(f"/{bus}/{message.name}", "json", message.name, json_schema(message))
        segment.channel(TICK, "timberhand.tick")
        segment.channel(REPORT, "json", "StateReport", flat_schema(StateReport))
        if self._drives:
            segment.channel(VEHICLE, "json", "VehicleReport", flat_schema(VehicleReport))
        segment.channel(TIMING, "json", "Timing", _OBJECT)
        segment.channel("/manifest", "json", "Manifest", _OBJECT)
        for topic, schema in self._topics.topics:
            segment.channel(topic, ENCODING, schema.name, schema.data, schema.encoding)
        segment.add("/manifest", self._now_ns + self._offset_ns, self._now_ns, _JSON.encode(self._manifest))
        try:
            segment.commit()
        except OSError:
            segment.close()
            (self._directory / name).unlink()
            raise
        self._segments += 1
        self._segment = segment

    def _abandon(self) -> None:
        """Close a file that could not be written, readable up to its last commit; the next flush opens another."""
        if self._segment:
            self.dropped += self._segment.pending
            self._segment.close()
            self._segment = None


def _is_grasp(datagram: bytes, key: bytes | None) -> bool:
    """Tell whether it is a chosen grasp, which the planner sends to all that it tells; it is not recorded."""
    try:
        decode_grasp(datagram, key)
    except DatagramRefused:
        return False
    return True


def _is_signed_report(datagram: bytes) -> bool:
    """Tell whether it is a state report with an authenticator, whose key is not checked."""
    try:
        return isinstance(datagrams.decode(without_mac(datagram)), StateReport)
    except DatagramRefused:
        return False
