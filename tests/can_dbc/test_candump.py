"""Trace formats to frames; damage is counted and never fatal."""

from __future__ import annotations

import os
from pathlib import Path

import can
import pytest

from can_dbc.dbc.signals import FrameRefused, Refusal
from can_dbc.frame import ERROR, EXTENDED, REMOTE, Frame
from can_dbc.protocols import nmea2000 as n2k
from can_dbc.trace.candump import parse_line, read_trace
from can_dbc.trace.decoder import Decoder
from can_dbc.trace.records import MalformedRecord, TraceFrame

CANBOAT = Path(os.environ.get("TIMBERHAND_DATA", Path(__file__).parents[3] / "shared" / "data")) / "can" / "canboat"
N2K = 0x09F8027F | EXTENDED
EIGHT = bytes.fromhex("00fcffff0000ffff")
LINES = [
    # line, frame
    ("(1502984866.421964) slcan0 09F8027F#00FCFFFF0000FFFF", (1502984866421964000, N2K, EIGHT)),
    ("(1.5) can0 210#", (1500000000, 0x210, b"")),
    ("(1.5) can0 210#R", (1500000000, 0x210 | REMOTE, b"")),
    ("(1.5) can0 20000088#0000000000000000", (1500000000, 0x88 | ERROR, bytes(8))),
    ("(1.5) can0 210##1112233445566778899AABBCC", (1500000000, 0x210, bytes.fromhex("112233445566778899aabbcc"))),
    ("(1.5) can0 210#11.22.33", (1500000000, 0x210, b"\x11\x22\x33")),
    ("can0  09F8027F   [8]  00 FC FF FF 00 00 FF FF", (0, N2K, EIGHT)),
    ("(000.001000)  can0  210   [2]  00 FC   '..'", (1000000, 0x210, b"\x00\xfc")),
    ("(1.25)  vcan0  RX - -  210   [2]  00 FC", (1250000000, 0x210, b"\x00\xfc")),
    ("can0  210   [4]  remote request", (0, 0x210 | REMOTE, b"")),
    ("<0x09f8027f> can0  09F8027F   [8]  00 FC FF FF 00 00 FF FF", (0, N2K, EIGHT)),
    ("1)         2.7  Rx     09F8027F  8  00 FC FF FF 00 00 FF FF", (2700000, N2K, EIGHT)),
    ("5)      1027.75  Tx     0210  2  00 FC", (1027750000, 0x210, b"\x00\xfc")),
    (
        "(1.25)  can0  20000004   [8]  00 08 00 00 00 00 60 00   ERRORFRAME",
        (1250000000, 4 | ERROR, bytes.fromhex("0008000000006000")),
    ),
    ("(2023-11-14 22:13:20.000100)  can0  210   [2]  00 FC", (1700000000000100000, 0x210, b"\x00\xfc")),
    ("(2023-11-31 22:13:20.000100)  can0  210   [2]  00 FC", None),
    ("can0  210   [4]  remote request" + "'" * 1500 + "x", None),
    ("21:55:35.425 R 09F8027F 00 FC FF FF 00 00 FF FF", (78935425000000, N2K, EIGHT)),
    ("(1502984866.421964) slcan0 09F8027F#00FCFFFF0", None),
    ("(1502984866.421964) slcan0 09F8027F#00FCFFFF00", (1502984866421964000, N2K, EIGHT[:5])),
    ("(1502984866.421964) slcan0 09F80", None),
    ("(15029848", None),
    ("can0  09F8027F   [8]  00 FC FF FF 00 00 FF", None),
    ("1)         2.7  Rx     09F8027F  8  00 FC FF", None),
    ("(1.5) can0 210#" + "00" * 65, None),
    ("hello", None),
    ("can0  210  [1]  AA\u2003", None),  # a blank to the pattern, and none to bytes.fromhex
    (f"({'9' * 5000}) can0 210#00", None),  # more digits than Python converts
]


@pytest.mark.parametrize(("line", "expected"), LINES)
def test_lines(line: str, expected: tuple[int, int, bytes] | None) -> None:
    assert parse_line(line) == (Frame(*expected) if expected else None)


SAMPLES = [
    ("samples/candumpSample2.txt", 402),
    ("samples/candumpSample3.txt", 2368),
    ("samples/candump-fast.txt", 23),
    ("samples/candump-fast-cr.txt", 23),
    ("samples/actisense-522.candump.log", 106),
    ("samples/sample-YDWG02.txt", 31),
    ("candump2analyzer/tests/pcan-view.in", 10),
]


@pytest.mark.parametrize(("name", "count"), SAMPLES)
def test_real_traces(name: str, count: int) -> None:
    path = CANBOAT / name
    if not path.exists():
        pytest.skip("no canboat samples under TIMBERHAND_DATA/can")
    records = list(read_trace(path))
    assert len(records) == count
    assert not any(isinstance(r, MalformedRecord) for r in records)


def messages() -> list[can.Message]:
    return [
        can.Message(timestamp=1000.0 + i / 100, arbitration_id=0x210 + i, is_extended_id=False, data=bytes((i, 2)))
        for i in range(200)
    ] + [can.Message(timestamp=1003.0, arbitration_id=0x09F8027F, is_extended_id=True, data=EIGHT)]


@pytest.mark.parametrize("suffix", [".asc", ".blf", ".log"])
def test_files_python_can_writes(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"x{suffix}"
    with can.Logger(path) as logger:
        for message in messages():
            logger.on_message_received(message)
    frames = list(read_trace(path))
    assert [(f.key, f.data) for f in frames] == [
        (m.arbitration_id | (EXTENDED if m.is_extended_id else 0), bytes(m.data)) for m in messages()
    ]
    start = frames[0].stamp_ns
    assert [f.stamp_ns - start for f in frames] == pytest.approx(
        [(m.timestamp - 1000.0) * 1e9 for m in messages()], abs=2e3
    )


@pytest.mark.parametrize("suffix", [".asc", ".blf", ".log"])
def test_truncation_at_any_byte_never_crashes(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"x{suffix}"
    with can.Logger(path) as logger:
        for message in messages()[:20]:
            logger.on_message_received(message)
    whole = path.read_bytes()
    for cut in range(0, len(whole), max(1, len(whole) // 60)):
        path.write_bytes(whole[:cut])
        assert len([r for r in read_trace(path) if isinstance(r, Frame)]) <= 20
    for position in range(0, len(whole), max(1, len(whole) // 60)):
        path.write_bytes(whole[:position] + b"\xfe" + whole[position + 1 :])
        list(read_trace(path))


def test_damage_in_asc_affects_only_its_line(tmp_path: Path) -> None:
    path = tmp_path / "x.asc"
    with can.Logger(path) as logger:
        for message in messages()[:20]:
            logger.on_message_received(message)
    lines = path.read_text().splitlines()
    at = next(i for i, line in enumerate(lines) if " 21A " in line)
    lines[at] = lines[at][:20]
    path.write_text("\n".join(lines))
    records = list(read_trace(path))
    assert sum(isinstance(r, Frame) for r in records) == 19
    assert [r.line for r in records if isinstance(r, MalformedRecord)] == [at + 1]


def test_decoder_counts_everything() -> None:
    from can_dbc.dbc import codec
    from can_dbc.protocols.e2e import protect

    press = codec.load("crane").messages["PressA"]
    assert press.data_ids
    good = protect(press.encode(0, 0, 0, 1.0, 2.0, None, 4.0), 3, press.data_ids)
    records: list[Frame | MalformedRecord] = [
        Frame(1, 0x1A0, good),
        Frame(2, 0x1A0, good[:-1] + b"\x01"),
        Frame(3, 0x1A0, good[:7]),
        Frame(4, 0x210, bytes.fromhex("0000d10700000000")),
        Frame(5, 0x7FF, b""),
        Frame(6, ERROR | 0x88, bytes(8)),
        Frame(7, 0x1A0 | REMOTE, b""),
        MalformedRecord(9, "x"),
    ]
    decoder = Decoder(["crane"])
    entries = list(decoder.run(records))
    assert [bool(e.fault) for e in entries] == [False, True, True, True]
    assert entries[2].fault == str(FrameRefused(Refusal.LENGTH, "PressA"))
    assert entries[3].fault == str(FrameRefused(Refusal.RANGE, "Slew"))
    assert entries[0].values["LiftB"] == 2.0 and "TiltA" not in entries[0].values
    assert entries[0].text().startswith("Crc=")
    assert "LiftB=2 bar" in entries[0].text() and "Status=Ok" in entries[0].text()
    summary = decoder.summary()
    assert {k: v for k, v in summary.items() if isinstance(v, int)} == {
        "frames": 7,
        "decoded": 1,
        "unknown": 1,
        "refused": 2,
        "bad_crc": 1,
        "error_frames": 1,
        "remote_frames": 1,
        "broken": 1,
        "lost_fast_packets": 0,
        "transported": 0,
        "unknown_transported": 0,
        "lost_transported": 0,
        "unopened_transported": 0,
        "extended_transported": 0,
    }


@pytest.mark.parametrize(
    ("line", "interface"),
    [
        ("(1502984866.421964) slcan0 09F8027F#00FCFFFF0000FFFF", "slcan0"),
        ("(1.5) can1 210#R", "can1"),
        ("(1.25)  vcan0  RX - -  210   [2]  00 FC", "vcan0"),
        ("can3  210   [4]  remote request", "can3"),
        ("5)      1027.75  Tx     0210  2  00 FC", ""),
    ],
)
def test_a_line_names_its_interface(line: str, interface: str) -> None:
    frame = parse_line(line)
    assert isinstance(frame, TraceFrame) and frame.interface == interface


def test_channels_of_a_file_are_its_interfaces(tmp_path: Path) -> None:
    for name in ("x.asc", "x.blf"):
        with can.Logger(tmp_path / name) as logger:
            for channel in (0, 1):
                logger.on_message_received(can.Message(timestamp=1.0, arbitration_id=1, data=b"\0", channel=channel))
        frames = list(read_trace(tmp_path / name))
        assert [f.interface for f in frames if isinstance(f, TraceFrame)] == ["1", "2"]


def fix(interface: str, latitude_deg: float, sequence: int) -> list[TraceFrame]:
    """The frames of a position, 1 ms apart."""
    from can_dbc.dbc import codec

    message = codec.load("gnss").messages["GnssPositionData"]
    payload = n2k.encode(message, Latitude=latitude_deg, Longitude=1.0)
    frames = n2k.frames(message, payload, source=0x1C, sequence=sequence)
    return [TraceFrame(i * 1_000_000, key, data, interface) for i, (key, data) in enumerate(frames)]


def test_two_interfaces_are_two_buses() -> None:
    north, south = fix("can0", 63.0, 3), fix("can1", 47.0, 3)
    mixed = [frame for pair in zip(north, south, strict=True) for frame in pair]
    decoder = Decoder(["gnss"])
    found = [(e.interface, e.values["Latitude"]) for e in decoder.run(mixed)]
    assert found == [("can0", pytest.approx(63.0)), ("can1", pytest.approx(47.0))]
    assert decoder.summary()["interfaces"] == {"can0": 7, "can1": 7}
    torn = Decoder(["gnss"])
    assert list(torn.run(south[:4] + north[4:])) == []
    assert torn.summary()["lost_fast_packets"] == 2


def test_a_message_cut_by_the_end_of_a_trace_is_lost() -> None:
    decoder = Decoder(["gnss"])
    assert list(decoder.run(fix("can0", 63.0, 0)[:-1])) == []
    assert decoder.summary()["lost_fast_packets"] == 1
