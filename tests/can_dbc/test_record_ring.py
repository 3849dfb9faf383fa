"""The ring of tick records: order, wrap-around, a slow reader, a restarted writer, two processes at once."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from can_dbc.messages import record_ring
from can_dbc.messages.record_ring import HEAD_BYTES, RecordRing, RingReader

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


def test_a_file_that_is_no_ring_is_not_read(tmp_path):
    (tmp_path / "ticks").write_bytes(bytes(HEAD_BYTES + SMALL))
    reader = RingReader(tmp_path / "ticks")
    assert reader.read() == []
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


@pytest.mark.parametrize("size", [0, 3, HEAD_BYTES])
def test_a_file_that_is_too_short_is_no_ring(tmp_path, size):
    path = tmp_path / "ticks"
    path.write_bytes(record_ring.MAGIC.to_bytes(8, "little")[:size] + bytes(max(0, size - 8)))
    reader = RingReader(path)
    assert reader.read() == []
    reader.close()
