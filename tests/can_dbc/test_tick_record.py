"""Tick records and their ring: round trip; damage and other versions are refused."""

import dataclasses
import struct
import zlib

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from can_dbc.bus.base import DRAIN_LIMIT, BusState, BusStats
from can_dbc.frame import Frame
from can_dbc.messages import datagrams, record_ring
from can_dbc.messages.crane import OperatorAction, OperatorCommand
from can_dbc.messages.record_ring import HEAD_BYTES, RecordRing, RingReader
from can_dbc.messages.tick_record import BusReading, TickRecord, decode, encode
from runtime.errors import InputRefused
from tests.codes import coded

u64 = st.integers(0, 2**64 - 1)
payload = st.binary(max_size=8)
key = st.integers(0, 2**32 - 1)
readings = st.builds(BusReading, st.integers(0, 65535), u64, u64, u64, u64)
frames_in = st.lists(st.builds(Frame, u64, key, payload), max_size=5).map(tuple)
frames_out = st.lists(st.tuples(key, payload), max_size=5).map(tuple)
ticks = st.builds(
    TickRecord,
    u64,
    st.integers(-(2**63), 2**63 - 1),
    u64,
    u64,
    readings,
    readings,
    frames_in,
    frames_in,
    st.lists(st.binary(max_size=99), max_size=3).map(tuple),
    frames_out,
    frames_out,
    st.binary(max_size=300),
    st.binary(max_size=300),
    st.lists(st.binary(max_size=99), max_size=3).map(tuple),
)


@given(ticks)
@settings(max_examples=100)
def test_round_trip(tick):
    assert decode(encode(tick)) == tick


@given(ticks)
@settings(max_examples=30)
def test_without_a_vehicle_the_record_has_the_former_bytes(tick):
    """A stationary machine has no vehicle report, and its bytes are those of an earlier release."""
    whole, without = encode(tick), encode(dataclasses.replace(tick, vehicle_report=b""))
    assert len(whole) - len(without) == len(tick.vehicle_report)
    assert whole[: len(without) - 4] == without[:-4]


@given(ticks, st.integers(0, 10**6), st.integers(1, 255))
@settings(max_examples=100)
def test_a_damaged_record_is_refused(tick, place, flip):
    data = bytearray(encode(tick))
    data[place % len(data)] ^= flip
    with pytest.raises(InputRefused):
        decode(bytes(data))


@given(st.binary(max_size=200))
def test_arbitrary_bytes_are_refused(data):
    with pytest.raises(InputRefused):
        decode(data)


def sealed(body: bytes) -> bytes:
    return body + struct.pack("<I", zlib.crc32(body))


def test_the_fullest_tick_fits():
    """As many frames as a drain returns from each bus, and both sockets' datagrams at their longest."""
    frames = [Frame(1, 2, bytes(8))] * DRAIN_LIMIT
    sent = [(3, bytes(8))] * 64
    long, pressed = [bytes(2048)] * 16, [bytes(256)] * 16
    quiet = BusReading()
    tick = TickRecord(1, 0, 0, 0, quiet, quiet, frames, frames, long, sent, sent, bytes(400), bytes(400), pressed)
    found = decode(encode(tick))
    assert len(found.frames_in) == len(found.machine_frames_in) == DRAIN_LIMIT and len(found.datagrams) == 16


def test_in_a_record_of_version_2_the_kind_tells_whose_a_datagram_was():
    command = datagrams.encode(OperatorCommand(1, 2, 3, OperatorAction.ARM))
    tick = TickRecord(1, 0, 0, 0, BusReading(), BusReading(), (), (), (b"hello", command), (), (), b"")
    body = bytearray(encode(tick)[:-4])
    assert decode(sealed(bytes(body))).datagrams == (b"hello", command), "today the record itself tells"
    body[4] = 2
    old = decode(sealed(bytes(body)))
    assert (old.datagrams, old.operator) == ((b"hello",), (command,))


def test_a_record_of_version_1_is_refused_by_its_number():
    # An empty tick as version 1 wrote it: one bus, its state and counters in the head.
    old = sealed(struct.pack("<I6HQqQQQQQ", 0x52544854, 1, 0, 0, 0, 0, 0, 10**9, 0, 0, 0, 0, 0, 0))
    with pytest.raises(InputRefused, check=coded("tick-record.version")):
        decode(old)


@pytest.mark.parametrize("bus", [2, 255])
def test_a_frame_of_an_unknown_bus_is_refused(bus):
    tick = TickRecord(1, 0, 0, 0, BusReading(), BusReading(), (Frame(1, 2, b""),), (), (), (), (), b"")
    body = bytearray(encode(tick)[:-4])
    at = body.index(struct.pack("<QIB", 1, 2, 0)) + 12
    body[at] = bus
    with pytest.raises(InputRefused, check=coded("tick-record.contents")):
        decode(sealed(bytes(body)))


def test_a_reading_copies_the_counters_of_a_bus():
    stats = BusStats(state=BusState.OFF, refused=1, dropped=2, error_frames=3, recoveries=4)
    reading = BusReading()
    reading.copy_from(stats)
    assert reading == BusReading(state=3, dropped=2, refused=1, errors=3, recoveries=4)


# -- the ring that holds them: order, wrap-around, a slow reader, a restarted writer

SMALL = 4096


@pytest.fixture
def small(monkeypatch):
    monkeypatch.setattr(record_ring, "CAPACITY_BYTES", SMALL)


@given(st.lists(st.lists(st.binary(max_size=600), max_size=4), max_size=30))
@settings(max_examples=60, deadline=None)
def test_a_reader_that_keeps_up_gets_every_record_in_order(tmp_path_factory, turns):
    path = tmp_path_factory.mktemp("ring") / "ticks"
    before, record_ring.CAPACITY_BYTES = record_ring.CAPACITY_BYTES, SMALL
    try:
        reader, ring = RingReader(path), RecordRing(path)
        for records in turns:
            for record in records:
                ring.append(record)
            assert reader.read() == records
        assert reader.lost == 0
        reader.close()
        ring.close()
    finally:
        record_ring.CAPACITY_BYTES = before


def test_a_slow_reader_loses_records_and_counts_them(small, tmp_path):
    reader, ring = RingReader(tmp_path / "ticks"), RecordRing(tmp_path / "ticks")
    ring.append(b"first")
    assert reader.read() == [b"first"]
    for k in range(1000):
        ring.append(b"%04d" % k)
    assert reader.read() == []  # the whole ring was overwritten: nothing in it is certain
    ring.append(b"next")
    assert reader.read() == [b"next"] and reader.lost == 1000
    reader.close()
    ring.close()


def test_a_ring_that_is_there_is_read_from_now_on_and_a_new_one_from_its_beginning(tmp_path):
    path = tmp_path / "ticks"
    first = RecordRing(path)
    first.append(b"before")
    reader = RingReader(path)
    first.append(b"after")
    assert reader.read() == [b"after"] and reader.lost == 0
    second = RecordRing(path)  # a restarted controller, before the old one removed its ring
    first.close()
    second.append(b"new")
    assert reader.read() == [] and reader.read() == [b"new"] and reader.lost == 0
    assert path.exists()
    second.close()
    assert not path.exists()
    reader.close()


@pytest.mark.parametrize("length", [SMALL, 0xFFFF_FFF0, 40])
def test_a_damaged_length_ends_the_reading_and_the_next_record_is_read(small, tmp_path, length):
    """A length that reaches beyond what is written; a reader that believed it would never end."""
    path = tmp_path / "ticks"
    reader, ring = RingReader(path), RecordRing(path)
    ring.append(b"first record")
    with path.open("r+b") as file:
        file.seek(HEAD_BYTES)
        file.write(length.to_bytes(4, "little"))
    assert reader.read() == []
    ring.append(b"next")
    assert reader.read() == [b"next"]
    reader.close()
    ring.close()


HEAD = record_ring.MAGIC.to_bytes(8, "little").ljust(HEAD_BYTES, b"\0")


@pytest.mark.parametrize(
    "content",
    [b"", HEAD[:3], HEAD, bytes(HEAD_BYTES + SMALL)],
    ids=["empty", "too short for a head", "a head alone", "another file"],
)
def test_a_file_that_is_no_ring_is_not_read(tmp_path, content):
    path = tmp_path / "ticks"
    path.write_bytes(content)
    reader = RingReader(path)
    assert reader.read() == []
    reader.close()
