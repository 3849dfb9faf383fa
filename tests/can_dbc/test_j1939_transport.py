"""The transport protocol of J1939: broadcast and addressed messages, losses, and what the decoder makes of them."""

from __future__ import annotations

from pathlib import Path

import pytest

from can_dbc.frame import EXTENDED, Frame
from can_dbc.protocols import j1939_transport as tp
from can_dbc.protocols.nmea2000 import join_id
from can_dbc.trace.decoder import Decoder

MS = 1_000_000
ENGINE, TOOL = 0x00, 0xF9
DM1, COMPONENT, REQUEST_2 = 0xFECA, 0xFEEB, 0xC900
TEXT = bytes(range(40, 60))
DATABASE = """VERSION ""

NS_ :

BS_:

BU_: ECU

BO_ 2566834942 Faults: 14 ECU
 SG_ Lamp : 0|8@1+ (1,0) [0|250] "" ECU
 SG_ First : 16|16@1+ (1,0) [0|65535] "" ECU
 SG_ Big : 47|8@0+ (1,0) [0|250] "" ECU
 SG_ Third : 80|16@1+ (1,0) [0|60000] "" ECU

BA_DEF_ BO_ "VFrameFormat" ENUM "StandardCAN","ExtendedCAN","reserved","J1939PG";
BA_DEF_DEF_ "VFrameFormat" "J1939PG";
"""


def control(kind: int, size: int, frames: int, pgn: int, source: int, destination: int) -> tuple[int, bytes]:
    data = bytes((kind, size & 0xFF, size >> 8, frames, 0xFF)) + pgn.to_bytes(3, "little")
    return join_id(7, tp.CONNECTION_PGN, source, destination), data


def parts(payload: bytes, source: int, destination: int) -> list[tuple[int, bytes]]:
    key = join_id(7, tp.DATA_PGN, source, destination)
    chunks = [payload[i : i + 7] for i in range(0, len(payload), 7)]
    return [(key, bytes((n,)) + chunk.ljust(7, b"\xff")) for n, chunk in enumerate(chunks, 1)]


def broadcast(payload: bytes, pgn: int = DM1, source: int = ENGINE) -> list[tuple[int, bytes]]:
    frames = parts(payload, source, 255)
    return [control(32, len(payload), len(frames), pgn, source, 255), *frames]


def heard(transport: tp.Transport, frames: list[tuple[int, bytes]], gap_ms: int = 50) -> list[tp.Transported]:
    found = [transport.receive(key, data, i * gap_ms * MS) for i, (key, data) in enumerate(frames)]
    return [message for message in found if message is not None]


@pytest.mark.parametrize("size", [9, 14, 20, 1785])
def test_broadcast(size: int) -> None:
    payload = bytes(i & 0x7F for i in range(size))
    transport = tp.Transport()
    assert heard(transport, broadcast(payload)) == [(join_id(6, DM1, ENGINE), payload)]
    transport.end()
    assert transport.lost == 0


def test_addressed_with_frames_asked_for_again() -> None:
    first, second, third = parts(TEXT, ENGINE, TOOL)
    again = (join_id(7, tp.CONNECTION_PGN, TOOL, ENGINE), bytes.fromhex("1102 02ff ff00 c900".replace(" ", "")))
    start = control(16, len(TEXT), 3, REQUEST_2, ENGINE, TOOL)
    transport = tp.Transport()
    found = heard(transport, [start, first, second, again, second, third])
    assert found == [(join_id(6, REQUEST_2, ENGINE, TOOL), TEXT)]


def test_messages_of_two_sources_at_once() -> None:
    one, other = broadcast(TEXT), broadcast(TEXT[::-1], COMPONENT, source=3)
    found = heard(tp.Transport(), [frame for pair in zip(one, other, strict=True) for frame in pair])
    assert found == [(join_id(6, DM1, ENGINE), TEXT), (join_id(6, COMPONENT, 3), TEXT[::-1])]


@pytest.mark.parametrize("missing", range(1, 4))
def test_a_missing_frame_loses_the_message(missing: int) -> None:
    frames, transport = broadcast(TEXT), tp.Transport()
    del frames[missing]
    assert heard(transport, frames) == []
    transport.end()
    assert transport.lost == 1


def test_silence_a_clock_set_back_an_abort_and_impossible_sizes_lose_the_message() -> None:
    late = tp.Transport()
    assert heard(late, broadcast(TEXT), gap_ms=1251) == [] and late.lost == 1
    back = tp.Transport()
    assert [back.receive(k, d, (9 - i) * MS) for i, (k, d) in enumerate(broadcast(TEXT))] == [None] * 4
    assert back.lost == 1
    aborted, addressed = tp.Transport(), parts(TEXT, ENGINE, TOOL)
    stop = (join_id(7, tp.CONNECTION_PGN, TOOL, ENGINE), bytes.fromhex("ff03ffffff00c900"))
    start = control(16, len(TEXT), 3, REQUEST_2, ENGINE, TOOL)
    assert heard(aborted, [start, addressed[0], stop, *addressed[1:]]) == [] and aborted.lost == 1
    wrong = tp.Transport()
    assert heard(wrong, [control(32, 20, 2, DM1, ENGINE, 255), *parts(TEXT, ENGINE, 255)]) == [] and wrong.lost == 1


def test_frames_whose_opening_was_not_heard_are_counted() -> None:
    transport = tp.Transport()
    assert heard(transport, parts(TEXT, ENGINE, 255)) == [] and (transport.unopened, transport.lost) == (3, 0)
    damaged = broadcast(TEXT)
    del damaged[1]
    assert heard(transport, damaged) == [] and (transport.unopened, transport.lost) == (4, 1)


def test_extended_transport_is_counted() -> None:
    transport = tp.Transport()
    key = join_id(7, tp.EXTENDED_CONNECTION_PGN, ENGINE, TOOL)
    assert transport.receive(key, bytes.fromhex("14d007000000ee00"), 0) is None
    assert transport.extended == 1


def test_decoder_takes_both_forms_of_a_message(tmp_path: Path) -> None:
    database = tmp_path / "j1939.dbc"
    database.write_text(DATABASE)
    whole = bytes.fromhex("04ff6e0004050708090a3412aabb")
    short = (EXTENDED | 0x18FECA00, bytes.fromhex("04ff6e00040501ff"))
    records = [
        Frame(i * MS, *frame) for i, frame in enumerate([*broadcast(whole), short, *broadcast(whole, COMPONENT)])
    ]
    decoder = Decoder([str(database)])
    assert [entry.values for entry in decoder.run(records)] == [
        {"Lamp": 4, "First": 0x6E, "Big": 5, "Third": 0x1234},
        {"Lamp": 4, "First": 0x6E, "Big": 5},
    ]
    summary = decoder.summary()
    counts = {"transported": 2, "unknown_transported": 1, "lost_transported": 0, "lost_fast_packets": 0, "unknown": 0}
    assert {name: summary[name] for name in counts} == counts


def test_a_longer_message_than_a_shipped_database_describes() -> None:
    decoder = Decoder(["machine"])
    frames = broadcast(bytes.fromhex("04ff6e0004050708090a"))
    (entry,) = decoder.run([Frame(i * MS, *frame) for i, frame in enumerate(frames)])
    assert entry.name == "DM1" and not entry.fault and entry.labels["AmberLamp"] == "On"
