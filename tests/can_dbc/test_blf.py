"""BLF as loggers leave it: damaged, cut, packed too well; what is read, and the sentence about the rest."""

from __future__ import annotations

import logging
import random
import zlib
from itertools import islice
from pathlib import Path

import pytest
from can.io import blf

from can_dbc.frame import ERROR, Frame
from can_dbc.trace import blf as reader
from can_dbc.trace.candump import read_trace
from can_dbc.trace.records import MalformedRecord, TraceFrame

START = (2023, 11, 2, 14, 22, 13, 20, 0)
START_NS = 1_700_000_000_000_000_000
MS = 1_000_000


def can_object(stamp_ns: int, value: int, *, size: int = 48, version: int = 1, kind: int = blf.CAN_MESSAGE) -> bytes:
    head = blf.OBJ_HEADER_BASE_STRUCT.pack(b"LOBJ", 32, version, size, kind)
    stamp = blf.OBJ_HEADER_V1_STRUCT.pack(blf.TIME_ONE_NANS, 0, 0, stamp_ns % (1 << 64))
    return head + stamp + blf.CAN_MSG_STRUCT.pack(1, 0, 8, 0x185, value.to_bytes(8, "little"))


def container(data: bytes, *, packed: bool = False, method: int | None = None) -> bytes:
    body = zlib.compress(data) if packed else data
    method = method if method is not None else blf.ZLIB_DEFLATE if packed else blf.NO_COMPRESSION
    size = 32 + len(body)
    head = blf.OBJ_HEADER_BASE_STRUCT.pack(b"LOBJ", 16, 1, size, blf.LOG_CONTAINER)
    return head + blf.LOG_CONTAINER_STRUCT.pack(method, len(data)) + body + bytes(size % 4)


def file(body: bytes, objects: int = 0, file_bytes: int | None = None) -> bytes:
    size = 144 + len(body) if file_bytes is None else file_bytes
    head = blf.FILE_HEADER_STRUCT.pack(b"LOGG", 144, 5, 0, 0, 0, 2, 6, 8, 1, size, size, objects, 0, *START, *START)
    return head.ljust(144, b"\0") + body


def records(content: bytes) -> tuple[list[int], list[MalformedRecord], list[str]]:
    """The first payload byte of every frame, the malformed records and the notes."""
    notes: list[str] = []
    found = list(islice(reader.read_blf(content, notes), 200_000))
    return [r.data[0] for r in found if isinstance(r, Frame)], [r for r in found if not isinstance(r, Frame)], notes


def three(**of_second: int) -> bytes:
    return can_object(MS, 1) + can_object(2 * MS, 2, **of_second) + can_object(3 * MS, 3)


@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize("size", [0, 15, 40, 1 << 31])
def test_an_object_of_impossible_size_ends_the_file(packed: bool, size: int) -> None:
    """What is behind it is not read a second time: python-can follows a size of 0 for ever."""
    values, bad, _ = records(file(container(three(size=size), packed=packed), 3))
    assert (values, len(bad)) == ([1], 1)
    assert ("224" if not packed else "144") in bad[0].text  # the byte where it starts, or where its container does


def test_an_unknown_header_version_is_one_note(caplog: pytest.LogCaptureFixture) -> None:
    body = b"".join(can_object(i * MS, i, version=9) for i in range(200)) + can_object(MS, 7)
    with caplog.at_level(logging.DEBUG):
        values, bad, notes = records(file(container(body), 201))
    assert (values, bad, len(notes), caplog.records) == ([7], [], 1, [])
    assert "200" in notes[0] and "9" in notes[0]


@pytest.mark.parametrize("packed", [False, True])
def test_a_cut_file_says_so_once(packed: bool) -> None:
    rng = random.Random(1)
    body = b"".join(can_object(i * MS, rng.getrandbits(60) << 2 | 1) for i in range(60))
    whole = file(container(body, packed=packed), 60)
    assert len(records(whole)[0]) == 60 and not records(whole)[1]
    for cut in range(150, len(whole) - 4, 37):
        values, bad, _ = records(whole[:cut])
        assert len(values) < 60 and len(bad) == 1 and str(cut) in bad[0].text
        if not packed:
            assert len(values) == max(0, cut - 176) // 48


def test_fewer_objects_than_the_header_counts_are_said() -> None:
    assert len(records(file(container(three()), 9))[1]) == 1
    assert not records(file(container(three()), 4))[1]  # some writers count the container too
    assert not records(file(container(three()), 0, 0))[1]  # and some never complete the header


def test_objects_without_containers_are_read() -> None:
    assert records(file(three(), 3)) == ([1, 2, 3], [], [])


def test_objects_over_the_edge_of_containers_are_read() -> None:
    body = three()
    parts = b"".join(container(body[i : i + 7], packed=bool(i % 2)) for i in range(0, len(body), 7))
    assert records(file(parts, 3)) == ([1, 2, 3], [], [])


def test_stamps_before_the_start() -> None:
    found = list(reader.read_blf(file(container(can_object(-60_000 * MS, 1))), []))
    assert [f.stamp_ns for f in found if isinstance(f, Frame)] == [START_NS - 60_000 * MS]


def test_other_objects_are_a_note_and_error_frames_are_frames() -> None:
    body = can_object(MS, 1) + can_object(MS, 2, kind=65) + can_object(MS, 3, kind=reader.CAN_ERROR)
    notes: list[str] = []
    found = list(reader.read_blf(file(container(body), 3), notes))
    assert [(f.key, len(f.data), f.interface) for f in found if isinstance(f, TraceFrame)] == [
        (0x185, 8, "1"),
        (ERROR, 0, "1"),
    ]
    assert len(notes) == 1 and "65" in notes[0]


def test_a_file_unpacks_to_a_bounded_size() -> None:
    body = can_object(MS, 1) * 150_000
    content = file(container(body, packed=True), 150_000)
    assert len(body) > 100 * len(content)
    values, bad, _ = records(content)
    assert 0 < len(values) * 48 <= reader.FREE_EXPANSION_BYTES + reader.MAX_EXPANSION * len(content) < len(body)
    assert len(bad) == 1 and str(reader.MAX_EXPANSION) in bad[0].text


def test_the_rest_of_a_file_does_not_pay_for_what_one_container_unpacks_to() -> None:
    """Otherwise 7 MB, of which most is never reached, cost minutes of equal frames."""
    bomb = container(can_object(MS, 1) * 50_000, packed=True)
    values, bad, _ = records(file(bomb + container(random.Random(1).randbytes(1 << 20)), 50_000))
    assert 0 < len(values) * 48 < 2 * reader.FREE_EXPANSION_BYTES
    assert len(bad) == 1 and "144" in bad[0].text


def test_an_unknown_compression_and_a_foreign_file_are_said() -> None:
    values, bad, _ = records(file(container(three(), method=5) + container(three())))
    assert (values, len(bad)) == ([1, 2, 3], 1)
    assert records(b"hello") == ([], [MalformedRecord(0, records(b"hello")[1][0].text)], [])


def test_damage_anywhere_invents_no_frame(tmp_path: Path) -> None:
    """Every step moves forward: a file of n bytes has less than n records, whatever is in it."""
    rng = random.Random(3)
    whole = file(container(three() * 5, packed=True) + container(three() * 5) + three(), 33)
    path = tmp_path / "x.blf"
    for _ in range(300):
        damaged = bytearray(whole)
        for _ in range(rng.choice((1, 2, 8))):
            damaged[rng.randrange(4, len(whole))] = rng.choice((0, 1, 255, rng.randrange(256)))
        path.write_bytes(damaged)
        found = list(islice(read_trace(path), len(whole)))
        assert len(found) <= 40


@pytest.mark.parametrize(("outside", "cut", "read"), [(0, 0, 1), (136, 0, 1), (238, 0, 1), (238, 8, 0), (60, 0, 0)])
def test_the_place_of_extra_data_of_a_can_fd_object_may_be_wrong(outside: int, cut: int, read: int) -> None:
    """A sample of python-can says 238 in an object of 144 bytes that holds all of its 64."""
    body = blf.CAN_FD_MSG_64_STRUCT.pack(1, 15, 64, 0, 0x185, 0, 0, 0, 0, 0, 0, 0, 0, outside, 0) + bytes(range(64))
    stamp = blf.OBJ_HEADER_V1_STRUCT.pack(blf.TIME_ONE_NANS, 0, 0, MS)
    size = 32 + len(body) - cut
    head = blf.OBJ_HEADER_BASE_STRUCT.pack(b"LOBJ", 32, 1, size, blf.CAN_FD_MESSAGE_64)
    found = list(reader.read_blf(file(container((head + stamp + body)[:size]), 1), []))
    assert [isinstance(r, Frame) for r in found] == [bool(read)]
