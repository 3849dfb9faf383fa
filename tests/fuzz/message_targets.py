"""Datagrams and records: those of planner, operator, controller, mission, camera, recorder and timing page."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Hashable

from autonomy.process.operator_commands import CommandReceiver, CommandRefused
from can_dbc.messages import crane, mission, rgbd, tick_record
from can_dbc.messages.datagrams import decode, encode
from can_dbc.messages.envelope import DatagramRefused, is_operator_command
from can_dbc.messages.record_ring import MAGIC as RING_MAGIC
from can_dbc.messages.record_ring import RecordRing, RingReader
from can_dbc.messages.vehicle import DriveSetpoint, Steering, VehicleReport
from can_dbc.timing.page import TimingWriter, read_timing
from controller.config import load
from controller.requests import RequestGate, RequestRefused
from runtime.errors import InputRefused
from tests.can_dbc.example_mission_report import MISSION_REPORT
from tests.conftest import a_timing
from tests.fuzz.engine import Run, Target, in_file, outcome
from tests.recorder import recordings

MS = 1_000_000
NOW_NS = 10**9
ZERO = (0.0,) * 5
SETTINGS = load("aoro_fc8")
HASH = SETTINGS.profile_hash


def with_crc(data: bytes) -> bytes:
    """The datagram with a CRC-32 that fits."""
    return data[:-4] + struct.pack("<I", zlib.crc32(data[:-4])) if len(data) >= 4 else data


def datagrams() -> list[bytes]:
    """One of each kind, all valid at `NOW_NS`."""
    common = (5, HASH, NOW_NS)
    knots = tuple(crane.Knot(k * 100 * MS, (0.0, 0.5, -1.2, 0.6, 0.0), ZERO) for k in range(3))
    drive = (200 * MS, Steering.WAYPOINT, 63.66, 19.9, 0.0, 0.0, 0.5, (0.3,) * 4, False, False)
    made = [
        crane.CraneSetpoint(*common, 200 * MS, crane.GrappleCommand.HOLD, True, knots),
        crane.SpoolTest(*common, 200 * MS, 2, (crane.SpoolKnot(0, 0.0), crane.SpoolKnot(100 * MS, 20.0))),
        DriveSetpoint(*common, *drive),
        crane.OperatorCommand(*common, crane.OperatorAction.ARM),
        crane.OperatorCommand(*common, crane.OperatorAction.STOP),
        VehicleReport(
            *common, 1, 1, 0, 0, 5, 63.0, 19.0, 100.0, 4, 12, 0.02, 6, 1.0, 0.0, 7, 0.5, 0.1, 0.0, 0.0, (0.3,) * 4, 0
        ),
    ]
    return [*map(encode, made), recordings.report(1)]


def missions() -> list[bytes]:
    """Mission report, grasp, commands and an upload."""
    commands = [mission.MissionCommand(3, HASH, NOW_NS, action) for action in mission.MissionAction]
    grasp = mission.ChosenGrasp(1, (0.1, 4.0, 0.5), 1.2, (3, 8), "two logs")
    upload = mission.MissionUpload(3, HASH, NOW_NS, "a mission.geojson", bytes(32))
    return [
        mission.encode_mission(MISSION_REPORT, 1, HASH, NOW_NS),
        mission.encode_grasp(grasp, 1, HASH, NOW_NS),
        *map(mission.encode_mission_command, commands),
        mission.encode_mission_upload(upload),
    ]


def decoded(data: bytes) -> Hashable:
    is_operator_command(data)
    found: list[Hashable] = []
    for what in (
        decode,
        mission.decode_mission,
        mission.decode_mission_command,
        mission.decode_mission_upload,
        mission.decode_grasp,
    ):
        try:
            message = what(data)
            found.append(type(message).__name__)
            if what is decode:
                assert encode(message)  # what is accepted can be said again
        except DatagramRefused as refused:
            assert str(refused)
            found.append(refused.fault)
    return tuple(found)


def start_gate() -> Run:
    """A gate keeps what it accepted, so its order and leases are tried as well."""
    gate = RequestGate(SETTINGS.profile, HASH)
    missions_gate = CommandReceiver(HASH)
    now_ns = NOW_NS

    def run(data: bytes) -> Hashable:
        nonlocal now_ns
        now_ns += 5 * MS
        found: list[Hashable] = []
        for operator in (False, True):
            try:
                message = gate.accept(data, now_ns, 0, operator)
                found.append(type(message).__name__)
                if isinstance(message, crane.CraneSetpoint | crane.SpoolTest):
                    gate.mark_accepted(message)
            except RequestRefused as refused:
                gate.count_refusal(refused.reason, refused.detail, now_ns)
                found.append(refused.reason)
        told = outcome(
            CommandRefused, missions_gate.accept, data, now_ns, then=lambda o: getattr(o, "action", "upload")
        )
        found.append(told)
        return tuple(found)

    return run


def keyed(data: bytes) -> Hashable:
    """With a key nothing passes that was not made with it."""
    try:
        decode(data, b"0123456789abcdef")
    except DatagramRefused as refused:
        return refused.fault
    raise AssertionError("a datagram passed without the key")


def recorded(data: bytes) -> Hashable:
    return outcome(InputRefused, tick_record.decode, data, then=lambda tick: (len(tick.frames_in), len(tick.datagrams)))


def pictured(data: bytes) -> Hashable:
    """Both sides read the fixed part first, with its exact length."""
    found = [outcome(InputRefused, rgbd.decode, data)]
    parts = ((rgbd.decode_header, rgbd.HEADER_BYTES), (rgbd.request_name_bytes, rgbd.REQUEST_HEADER.size))
    found += [outcome(InputRefused, what, data[:size]) for what, size in parts if len(data) >= size]
    return tuple(found)


def pictures() -> list[bytes]:
    picture = rgbd.RgbdMessage("mast", NOW_NS, 6, 4, 5.0, 5.0, 3.0, 2.0, bytes(6 * 4 * 3), bytes(6 * 4 * 2))
    return [rgbd.encode_request("mast"), rgbd.encode_refusal("mast", "There is no such camera."), rgbd.encode(picture)]


RING_BYTES = 1 << 14


def ring_seeds() -> list[bytes]:
    """Three records as the writer leaves them, at the beginning of a ring and around its end."""
    path = in_file("seed.ring")
    ring = RecordRing(path)
    try:
        for k in range(3):
            ring.append(recordings.tick(k))
        whole = path.read_bytes()
    finally:
        ring.close()
    return [whole[:4000], whole[:24] + struct.pack("<Q", 1 << 40) + whole[32:4000]]


def start_ring() -> Run:
    """A reader of a file that another process writes: whatever it finds there, it ends and keeps nothing."""
    path = in_file("read.ring")

    def run(data: bytes) -> Hashable:
        begun = bytearray(data[: 64 + RING_BYTES].ljust(64 + RING_BYTES, b"\0"))
        struct.pack_into("<QQ", begun, 0, RING_MAGIC, RING_BYTES)
        struct.pack_into("<Q", begun, 24, 0)
        path.write_bytes(begun)
        reader = RingReader(path)
        try:
            with path.open("r+b") as file:  # not rewritten: a file that is mapped must not become shorter
                file.seek(24)
                file.write(data[24:32].ljust(8, b"\0"))
            found = reader.read()
            for record in found:
                recorded(record)
        finally:
            reader.close()
        path.write_bytes(data)
        RingReader(path).close()
        return min(len(found), 4), reader.lost > 0

    return run


FACTS_BYTES = 1 << 14
"""Of the page's beginning, with the facts; the histograms behind it are counts, any of which is valid."""


def timing_page() -> bytes:
    path = in_file("seed.timing")
    writer = TimingWriter(path)
    try:
        timing = a_timing()
        writer.publish(timing.facts, timing.durations)
        return path.read_bytes()
    finally:
        writer.close()


def start_timing() -> Run:
    path, whole = in_file("read.timing"), timing_page()

    def run(data: bytes) -> Hashable:
        data = data[:FACTS_BYTES] + whole[len(data[:FACTS_BYTES]) :]
        if data[8:16] == bytes(8) or data[8] & 1:
            return "not written"  # the reader waits for the writer, 0.1 s each time
        path.write_bytes(data)
        return outcome(InputRefused, read_timing, path, then=lambda timing: timing.facts.mode)

    return run


def all_datagrams() -> list[bytes]:
    return [*datagrams(), *missions()]


MESSAGES = (
    Target("datagrams", "datagrams", lambda: decoded, all_datagrams, mend=with_crc),
    Target("request-gate", "datagrams", start_gate, all_datagrams, mend=with_crc, runs_per_state=2000),
    Target("datagrams-keyed", "datagrams", lambda: keyed, datagrams, mend=with_crc),
    Target("tick-record", "records", lambda: recorded, lambda: [recordings.tick(k) for k in range(3)], mend=with_crc),
    Target("record-ring", "rings", start_ring, ring_seeds, max_bytes=1 << 13),
    Target("timing-page", "pages", start_timing, lambda: [timing_page()[:FACTS_BYTES].rstrip(b"\0")]),
    Target("camera-stream", "messages", lambda: pictured, pictures, mend=with_crc, max_bytes=1 << 13),
)
