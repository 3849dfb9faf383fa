"""Tick records: what goes in comes out, and damage is refused."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from can_dbc.frame import Frame
from can_dbc.tick_record import RecordRefused, decode, encode

u64 = st.integers(0, 2**64 - 1)
payload = st.binary(max_size=8)
key = st.integers(0, 2**32 - 1)
ticks = st.tuples(
    u64, st.integers(-(2**63), 2**63 - 1), u64, u64, st.tuples(st.integers(0, 65535), u64, u64, u64),
    st.lists(st.builds(Frame, u64, key, payload), max_size=5), st.lists(st.binary(max_size=99), max_size=3),
    st.lists(st.tuples(key, payload), max_size=5), st.binary(max_size=300),
)  # fmt: skip


@given(ticks)
@settings(max_examples=100)
def test_round_trip(tick):
    now, late, work, missed, bus, frames, datagrams, out, report = tick
    got = decode(encode(*tick))
    assert (got.now_ns, got.late_ns, got.tick_ns, got.missed_ticks) == (now, late, work, missed)
    assert (got.bus_state, got.bus_dropped, got.bus_refused, got.bus_errors) == bus
    assert got.frames_in == tuple(frames) and got.datagrams == tuple(datagrams)
    assert got.frames_out == tuple(out) and got.report == report


@given(ticks, st.integers(0, 10**6), st.integers(1, 255))
@settings(max_examples=100)
def test_a_damaged_record_is_refused(tick, place, flip):
    data = bytearray(encode(*tick))
    data[place % len(data)] ^= flip
    with pytest.raises(RecordRefused):
        decode(bytes(data))


@given(st.binary(max_size=200))
def test_rubbish_is_refused(data):
    with pytest.raises(RecordRefused):
        decode(data)
