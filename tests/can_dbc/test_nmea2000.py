"""NMEA 2000: canboat's samples, the independent ``nmea2000`` package, fast packets with losses."""

from __future__ import annotations

import os
import random
import re
from functools import cache
from pathlib import Path
from typing import Any

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from nmea2000.decoder import NMEA2000Decoder

from can_dbc.dbc import codec
from can_dbc.dbc.signals import FrameRefused
from can_dbc.frame import ERROR, EXTENDED, Frame
from can_dbc.protocols import nmea2000 as n2k
from can_dbc.trace.candump import read_trace
from runtime.errors import InputRefused

CANBOAT = Path(os.environ.get("TIMBERHAND_DATA", Path(__file__).parents[3] / "shared" / "data")) / "can" / "canboat"
PGNS = sorted(CANBOAT.glob("pgns/*.yaml"))
FIXED = settings(max_examples=150, deadline=None, derandomize=True, database=None)
MS = 1_000_000


@cache
def gnss() -> codec.Database:
    return codec.load("gnss")


IDS = [
    # identifier, priority, PGN, source, destination
    (0x09F8011C, 2, 129025, 0x1C, 255),
    (0x0DF80503, 3, 129029, 0x03, 255),
    (0x18EEFF27, 6, 60928, 0x27, 255),
    (0x18EA2780, 6, 59904, 0x80, 0x27),
    (0x19F11224, 6, 127250, 0x24, 255),
]


@pytest.mark.parametrize(("identifier", "priority", "pgn", "source", "destination"), IDS)
def test_identifier(identifier: int, priority: int, pgn: int, source: int, destination: int) -> None:
    assert n2k.split_id(identifier) == n2k.split_id(identifier | EXTENDED) == (priority, pgn, source, destination)
    assert n2k.join_id(priority, pgn, source, destination) == identifier | EXTENDED


@pytest.mark.parametrize(("pgn", "destination"), [(129025, 5), (59905, 255)])
def test_impossible_identifiers(pgn: int, destination: int) -> None:
    with pytest.raises(ValueError, match=f"PGN {pgn}"):
        n2k.join_id(6, pgn, 1, destination)


# -- oracles ---------------------------------------------------------------------------------------------------


def samples() -> list[tuple[int, bytes, dict[str, str]]]:
    """(PGN, payload, expected fields) out of the sample sections; the files' YAML needs no more than this."""
    found: list[tuple[int, bytes, dict[str, str]]] = []
    for path in PGNS:
        for line in path.read_text().partition("\nsamples:")[2].splitlines():
            if raw := re.match(r'- raw: "([^"]+)"', line):
                parts = raw[1].split(",")
                found.append((int(parts[2]), bytes.fromhex("".join(parts[6:])), {}))
            elif field := re.match(r"    (\w+): (.+)", line):
                found[-1][2][field[1]] = field[2].strip('"')
    return found


@pytest.mark.skipif(not PGNS, reason="no canboat PGN definitions under TIMBERHAND_DATA/can")
def test_canboat_samples() -> None:
    fields = 0
    for pgn, payload, expected in samples():
        found = gnss().find(n2k.join_id(3, pgn, 12))
        assert found is not None
        payload = payload[: found.length]
        plain = found.decode(payload)
        try:
            checked = n2k.decode(found, payload)
        except FrameRefused:
            checked = plain
        for name, want in expected.items():
            name = "SID" if name == "sid" else name[0].upper() + name[1:]
            i = found.index[name]
            s = found.signals[i]
            fields += 1
            if want == "~":
                assert checked[i] is None, (pgn, name)
            elif re.fullmatch(r"-?[\d.]+", want):
                assert float(plain[i]) == pytest.approx(float(want), rel=1e-9, abs=5.1e-9), (pgn, name)
            else:
                assert s.choices[plain[i]] == want, (pgn, name)
    assert fields == 105


def theirs_as_ours(message: Any) -> dict[str, Any]:
    """A message of the nmea2000 package with the names of the database and raw numbers."""
    return {
        "SID" if f.id == "sid" else f.id[0].upper() + f.id[1:]: f.raw_value
        for f in message.fields
        if not f.id.startswith("reserved") and f.value is not None and f.raw_value is not None
    }


def same(message: codec.MessageCodec, ours: dict[str, Any], theirs: dict[str, Any]) -> bool:
    """Whether both agree; a lookup without an entry is a number there and None here."""
    none = {s.name: s.sentinels for s in message.signals}
    ours = {name: value for name, value in ours.items() if not name.startswith("Reserved")}
    theirs = {name: value for name, value in theirs.items() if value not in none.get(name, ())}
    return ours.keys() == theirs.keys() and all(
        theirs[name] == pytest.approx(value, rel=1e-12) for name, value in ours.items()
    )


def test_a_real_log_against_the_nmea2000_package() -> None:
    log = CANBOAT / "samples/candumpSample3.txt"
    if not log.exists():
        pytest.skip("no canboat samples under TIMBERHAND_DATA/can")
    receiver, compared = n2k.Receiver(), 0
    theirs = NMEA2000Decoder()
    for frame in read_trace(log):
        assert isinstance(frame, Frame)
        reading = receiver.receive(frame.key, frame.data, frame.stamp_ns)
        if reading is not None:
            line = f"({frame.stamp_ns / 1e9:.6f}) can0 {frame.key & 0x1FFFFFFF:08X}#{frame.data.hex().upper()}"
            assert same(reading.codec, reading.fields, theirs_as_ours(theirs.decode(line))), line
            compared += 1
    assert compared == 756 and receiver.reassembler.lost == 0


@FIXED
@given(st.data())
def test_encoding_against_the_nmea2000_package(data: st.DataObject) -> None:
    message = data.draw(st.sampled_from(list(gnss().messages.values())))
    fields: dict[str, Any] = {}
    for s in message.signals:
        if s.name.startswith("Reserved") or data.draw(st.integers(0, 3)) == 0:
            continue
        labelled = [raw for raw in s.choices if raw not in s.sentinels]
        if s.name == "ReferenceStations":
            fields[s.name] = 0
        elif labelled:
            fields[s.name] = data.draw(st.sampled_from(labelled))
        else:
            fields[s.name] = s.physical(data.draw(st.integers(s.raw_low, s.raw_high)))
    fields.pop("Date", None)
    fields.pop("Time", None)
    payload = n2k.encode(message, **fields)
    back = n2k.decode(message, payload)
    assert message.named(back) == pytest.approx(fields, rel=1e-12)
    pgn = n2k.split_id(message.key).pgn
    line = f"2023-01-01-00:00:00.000,3,{pgn},12,255,{len(payload)},{payload.hex(',')}"
    assert same(message, fields, theirs_as_ours(NMEA2000Decoder().decode(line)))


def test_encode_refuses() -> None:
    position = gnss().messages["PositionRapidUpdate"]
    assert n2k.encode(position) == bytes.fromhex("ffffff7fffffff7f")
    for bad in ({"Latitude": 90.1}, {"Latitude": float("nan")}, {"Lattitude": 1.0}):
        with pytest.raises(InputRefused):
            n2k.encode(position, **bad)


# -- fast packets ------------------------------------------------------------------------------------------------

FAST = EXTENDED | 0x0DF8051C


def packet(payload: bytes, sequence: int = 0) -> list[bytes]:
    return list(n2k.fast_packet(payload, sequence))


@FIXED
@given(st.binary(min_size=1, max_size=n2k.MAX_FAST_PACKET_BYTES), st.integers(0, 7))
def test_fast_packet_round_trip(payload: bytes, sequence: int) -> None:
    frames = packet(payload, sequence)
    assert len(frames) == 1 + max(0, -(-(len(payload) - 6) // 7))
    reassembler = n2k.Reassembler()
    results = [reassembler.add(FAST, frame, i) for i, frame in enumerate(frames)]
    assert results == [None] * (len(frames) - 1) + [payload]
    reassembler.end()
    assert reassembler.lost == 0


def received(reassembler: n2k.Reassembler, frames: list[tuple[int, bytes]]) -> list[bytes]:
    """The payloads of (stamp in ms, frame) that are complete."""
    found = [reassembler.add(FAST, data, stamp_ms * MS) for stamp_ms, data in frames]
    return [payload for payload in found if payload is not None]


def stream(payloads: list[bytes], sequences: list[int]) -> list[list[tuple[int, bytes]]]:
    """Messages 200 ms apart, their frames 1 ms apart."""
    return [
        [(200 * i + j, frame) for j, frame in enumerate(packet(payload, sequence))]
        for i, (payload, sequence) in enumerate(zip(payloads, sequences, strict=True))
    ]


@FIXED
@given(st.integers(0, 2**32), st.booleans(), st.sets(st.integers(0, 34), max_size=12))
@example(0, False, {7})  # a first frame
@example(0, False, {10})
@example(0, False, {13})  # a last one
def test_whatever_is_lost_no_message_is_made_of_two(seed: int, counts: bool, dropped: set[int]) -> None:
    # A sender that does not count its sequences repeats one; a burst that ends inside the next message cannot be told
    # from one message then, so without the counter only single frames are lost.
    rng = random.Random(seed)
    payloads = [rng.randbytes(43) for _ in range(5)]
    if not counts:
        dropped = set(sorted(dropped)[:1])
    messages = stream(payloads, [i if counts else 0 for i in range(5)])
    reassembler = n2k.Reassembler()
    frames = [frame for message in messages for frame in message]
    got = received(reassembler, [frame for i, frame in enumerate(frames) if i not in dropped])
    whole = [payload for i, payload in enumerate(payloads) if not dropped & set(range(7 * i, 7 * i + 7))]
    reassembler.end()
    assert got == whole
    assert len(got) + reassembler.lost == 5 - sum(set(range(7 * i, 7 * i + 7)) <= dropped for i in range(5))


@pytest.mark.parametrize(
    ("sequences", "begins_ms"),
    [((2, 3), (0, 200)), ((0, 0), (5_000, 1_000)), ((0, 0), (0, 751))],
    ids=["two sequences", "a clock that goes back", "after the time-out"],
)
def test_frames_of_two_messages_are_not_joined(sequences: tuple[int, int], begins_ms: tuple[int, int]) -> None:
    old, new = packet(bytes(43), sequences[0]), packet(bytes(range(43)), sequences[1])
    torn = [(begins_ms[0], frame) for frame in old[:3]] + [(begins_ms[1], frame) for frame in new[3:]]
    reassembler = n2k.Reassembler()
    assert received(reassembler, torn) == []
    reassembler.end()
    assert reassembler.lost == 2
    assert received(reassembler, [(begins_ms[1], frame) for frame in new]) == [bytes(range(43))]
    assert reassembler.lost == 2


@pytest.mark.parametrize("short", range(6))
def test_a_frame_that_lacks_bytes_of_the_message_is_refused(short: int) -> None:
    frames = packet(bytes(range(43)))  # the padding of the last frame would make up for what is missing
    frames[short] = frames[short][:6]
    reassembler, refused = n2k.Reassembler(), 0
    for frame in frames:
        try:
            assert reassembler.add(FAST, frame, 0) is None
        except FrameRefused:
            refused += 1
    assert (refused, reassembler.lost) == (1, 0)


def test_interleaved_sources_and_sequences() -> None:
    rng = random.Random(4)
    streams = {(source, seq): rng.randbytes(43) for source in (1, 2, 3) for seq in (0, 5)}
    queues = {slot: [(slot, f) for f in packet(p, slot[1])] for slot, p in streams.items()}
    reassembler, got = n2k.Reassembler(), {}
    while any(queues.values()):
        slot, frame = rng.choice([q for q in queues.values() if q]).pop(0)
        payload = reassembler.add(FAST & ~0xFF | slot[0], frame, 0)
        if payload is not None:
            got[slot] = payload
    assert got == streams


def test_frames_out_of_order_are_not_used() -> None:
    reassembler = n2k.Reassembler()
    frames = packet(bytes(range(20)))
    assert [reassembler.add(FAST, frames[i], 0) for i in (0, 2, 1)] == [None] * 3
    assert [reassembler.add(FAST, frame, 0) for frame in frames][-1] == bytes(range(20))
    assert reassembler.lost == 2


def test_memory_is_bounded() -> None:
    reassembler = n2k.Reassembler()
    for source in range(200):
        reassembler.add(FAST & ~0xFF | source, packet(bytes(20))[0], source)
    assert reassembler.lost == 200 - n2k.MAX_OPEN_PACKETS


@pytest.mark.parametrize("frame", [b"", b"\x00", b"\x00\xe0\x00", b"\x00\xff"])
def test_impossible_fast_packet_frames(frame: bytes) -> None:
    with pytest.raises(FrameRefused):
        n2k.Reassembler().add(FAST, frame, 0)


def test_short_payload_in_a_fast_packet_is_refused() -> None:
    receiver = n2k.Receiver(gnss())
    assert receiver.receive(FAST, bytes.fromhex("0008000000000000"), 0) is None
    with pytest.raises(FrameRefused):
        receiver.receive(FAST, bytes.fromhex("01aabbccddeeff11"), 1)


def test_receiver_round_trip_and_foreign_frames() -> None:
    receiver = n2k.Receiver(gnss())
    message = gnss().messages["GnssPositionData"]
    payload = n2k.encode(message, SID=1, Latitude=48.5, Longitude=-71.25, Method=4, NumberOfSvs=14, Hdop=0.6)
    frames = n2k.frames(message, payload, source=0x1C, sequence=3)
    assert len(frames) == 7 and {key for key, _ in frames} == {FAST}
    readings = [receiver.receive(key, data, 0) for key, data in frames]
    assert readings[:-1] == [None] * 6
    last = readings[-1]
    assert last is not None and last.identifier == (3, 129029, 0x1C, 255)
    assert last.fields["Latitude"] == pytest.approx(48.5) and "Altitude" not in last.fields
    for key in (0x210, FAST | ERROR, EXTENDED | 0x09FD0224):
        assert receiver.receive(key, bytes(8), 0) is None
    longer = [receiver.receive(FAST, data, 0) for data in n2k.fast_packet(payload + bytes(4), 4)][-1]
    assert longer is not None and longer.values == last.values
    heading = gnss().messages["VesselHeading"]
    assert n2k.frames(heading, bytes(8), source=7) == [(EXTENDED | 0x09F11207, bytes(8))]
