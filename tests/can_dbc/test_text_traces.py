"""Text traces to frames, as every tool writes them; damage is counted and never fatal."""

from __future__ import annotations

import logging
import os
from pathlib import Path

import can
import pytest

from can_dbc.dbc import codec
from can_dbc.dbc.signals import FrameRefused, Refusal
from can_dbc.frame import ERROR, EXTENDED, REMOTE, Frame
from can_dbc.protocols import nmea2000 as n2k
from can_dbc.protocols.e2e import protect
from can_dbc.text import decoded
from can_dbc.trace import candump
from can_dbc.trace.candump import parse_line, read_trace
from can_dbc.trace.decoder import Decoder
from can_dbc.trace.records import MalformedRecord, Trace, TraceFrame

CANBOAT = Path(os.environ.get("TIMBERHAND_DATA", Path(__file__).parents[3] / "shared" / "data")) / "can" / "canboat"
MS = 1_000_000
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


def logged(path: Path, messages: list[can.Message]) -> Path:
    with can.Logger(path) as logger:
        for message in messages:
            logger.on_message_received(message)
    return path


@pytest.mark.parametrize("suffix", [".asc", ".blf", ".log"])
def test_files_python_can_writes(tmp_path: Path, suffix: str) -> None:
    frames = list(read_trace(logged(tmp_path / f"x{suffix}", messages())))
    assert [(f.key, f.data) for f in frames] == [
        (m.arbitration_id | (EXTENDED if m.is_extended_id else 0), bytes(m.data)) for m in messages()
    ]
    start = frames[0].stamp_ns
    assert [f.stamp_ns - start for f in frames] == pytest.approx(
        [(m.timestamp - 1000.0) * 1e9 for m in messages()], abs=2e3
    )


@pytest.mark.parametrize("suffix", [".asc", ".blf", ".log"])
def test_truncation_at_any_byte_never_crashes(tmp_path: Path, suffix: str) -> None:
    path = logged(tmp_path / f"x{suffix}", messages()[:20])
    whole = path.read_bytes()
    for cut in range(0, len(whole), max(1, len(whole) // 60)):
        path.write_bytes(whole[:cut])
        assert len([r for r in read_trace(path) if isinstance(r, Frame)]) <= 20
    for position in range(0, len(whole), max(1, len(whole) // 60)):
        path.write_bytes(whole[:position] + b"\xfe" + whole[position + 1 :])
        list(read_trace(path))


def test_damage_in_asc_affects_only_its_line(tmp_path: Path) -> None:
    path = logged(tmp_path / "x.asc", messages()[:20])
    lines = path.read_text().splitlines()
    at = next(i for i, line in enumerate(lines) if " 21A " in line)
    lines[at] = lines[at][:20]
    path.write_text("\n".join(lines))
    records = list(read_trace(path))
    assert sum(isinstance(r, Frame) for r in records) == 19
    assert [r.line for r in records if isinstance(r, MalformedRecord)] == [at + 1]


def test_decoder_counts_everything() -> None:
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
    assert {k: v for k, v in summary.items() if isinstance(v, int) and v} == {
        "frames": 7,
        "decoded": 1,
        "unknown": 1,
        "refused": 2,
        "bad_crc": 1,
        "error_frames": 1,
        "remote_frames": 1,
        "broken": 1,
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
        sent = [can.Message(timestamp=1.0, arbitration_id=1, data=b"\0", channel=channel) for channel in (0, 1)]
        frames = list(read_trace(logged(tmp_path / name, sent)))
        assert [f.interface for f in frames if isinstance(f, TraceFrame)] == ["1", "2"]


def fix(interface: str, latitude_deg: float, sequence: int) -> list[TraceFrame]:
    """The frames of a position, 1 ms apart."""
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


# -- forms of other tools: PCAN, ASC, encodings

TRC = {
    "1.0": "  1)  10  0210  2 00 FC\n  2)  12  0210  8 RTR\n  3)  14  09F8027F  1 FF\n"
    "  4)  15  FFFFFFFF  4 00 00 00 08 BUSHEAVY\n",
    "1.1": "  1)  10.0  Rx  0210  2  00 FC\n  2)  12.0  Tx  0210  8  RTR\n  3)  14.0  Rx  09F8027F  1  FF\n"
    "  4)  15.0  Warng  FFFFFFFF  4  00 00 00 08  BUSHEAVY\n  5)  16.0  Error  0008  4  00 19 08 08\n",
    "1.2": "  1)  10.0 1 Rx  0210  2  00 FC\n  2)  12.0 1 Rx  0210  8  RTR\n  3)  14.0 2 Rx  09F8027F  1  FF\n"
    "  4)  15.0 1 Error  0008  4  00 19 08 08\n",
    "1.3": "  1)  10.0 1  Rx  0210 -  2  00 FC\n  2)  12.0 1  Rx  0210 -  8  RTR\n  3)  14.0 2  Rx  09F8027F -  1  FF\n"
    "  4)  15.0 1  Warng  FFFFFFFF -  4  00 00 00 08  BUSHEAVY\n",
    "2.0": ";$COLUMNS=N,O,T,I,d,l,D\n 1  10.000 DT 0210 Rx 2  00 FC\n 2  12.000 RR 0210 Rx 8\n"
    " 3  14.000 DT 09F8027F Rx 1  FF\n 4  15.000 ER    - Rx 5  04 00 02 00 00\n 5  16.000 EC    - Rx 2  02 00\n",
    "2.1": ";$COLUMNS=N,O,T,B,I,d,R,L,D\n 1  10.000 DT 1 0210 Rx -  2  00 FC\n 2  12.000 RR 1 0210 Rx -  8\n"
    " 3  14.000 DT 1 09F8027F Rx -  1  FF\n 4  15.000 ST 1    - Rx -  4  00 00 00 08\n"
    " 5  16.000 EV 1 A text of the user\n",
}
ASC = "date Mon Jun 1 12:00:00.000 am 2026\nbase hex  timestamps {}\ninternal events logged\n"


def write(path: Path, text: str, encoding: str = "utf-8") -> Trace:
    path.write_bytes(text.encode(encoding))
    return read_trace(path)


@pytest.mark.parametrize("version", TRC)
def test_pcan_rows(tmp_path: Path, version: str) -> None:
    trace = write(tmp_path / "x.trc", f";$FILEVERSION={version}\n;$STARTTIME=43474.5\n;  a comment\n{TRC[version]}")
    found = list(trace)
    assert found[:3] == [
        Frame(10 * MS, 0x210, b"\x00\xfc"),
        Frame(12 * MS, 0x210 | REMOTE, b""),
        Frame(14 * MS, 0x09F8027F | EXTENDED, b"\xff"),
    ]
    assert all(isinstance(r, Frame) and r.key == ERROR for r in found[3:]) and len(found) > 3
    assert len(trace.notes) == (version in ("2.0", "2.1"))
    buses = {"1.2": ["1", "1", "2", "1"], "1.3": ["1", "1", "2", "1"], "2.1": ["1"] * 4}.get(version, [""] * 4)
    assert [r.interface for r in found[:4] if isinstance(r, TraceFrame)] == buses


@pytest.mark.parametrize("version", ["1.0", "1.1", "1.3", "2.0", "2.1"])
def test_a_cut_pcan_row_is_malformed(tmp_path: Path, version: str) -> None:
    columns = [line for line in TRC[version].splitlines() if line[0] == ";"]
    row = next(line for line in TRC[version].splitlines() if line.endswith("00 FC"))
    trace = write(tmp_path / "x.trc", "\n".join([f";$FILEVERSION={version}", *columns, row[:-3]]))
    assert [type(r) for r in trace] == [MalformedRecord]


def test_pcan_files_of_python_can(tmp_path: Path) -> None:
    every = {"arbitration_id": 0x210, "is_extended_id": False, "channel": 1}
    sent = [can.Message(timestamp=100 + i / 100, data=bytes(i % 9), **every) for i in range(20)]
    assert list(read_trace(logged(tmp_path / "x.trc", sent))) == [
        Frame(i * 10 * MS, 0x210, bytes(i % 9)) for i in range(20)
    ]


def test_asc_with_relative_stamps(tmp_path: Path) -> None:
    lines = " 0.100 1  210 Rx d 1 00\n 0.100 1 Statistic: D 0\n 0.100 1  210 Rx d 1 01\n"
    trace = write(tmp_path / "x.asc", ASC.format("relative") + " 0.000 Start of measurement\n" + lines)
    assert [r.stamp_ns for r in trace if isinstance(r, Frame)] == [100 * MS, 300 * MS]
    assert len(trace.notes) == 1


def test_asc_before_the_trigger_and_in_another_language(tmp_path: Path) -> None:
    lines = "-0.250 1  210 Rx d 1 00\n 0.000 Start der Messung\n 0.500 1  9F8027Fx Rx d 1 01\n"
    assert list(write(tmp_path / "x.asc", ASC.format("absolute") + lines)) == [
        Frame(-250 * MS, 0x210, b"\x00"),
        Frame(500 * MS, 0x09F8027F | EXTENDED, b"\x01"),
    ]


@pytest.mark.parametrize(
    ("steps_ms", "stamps_ms"),
    [
        ([0, 100, 100, 100], [0, 100, 200, 300]),
        ([0, 100, 99, 1, 1500, 7], [0, 100, 199, 200, 1700, 1707]),
        ([0, 100, 200, 200, 300, 1500], [0, 100, 200, 200, 300, 1500]),  # -tz, and two buses in the same moment
        ([5, 3, 2, 1], [5, 3, 2, 1]),
    ],
)
def test_differences_of_candump_are_added_up(tmp_path: Path, steps_ms: list[int], stamps_ms: list[int]) -> None:
    lines = "".join(f" ({ms // 1000:03d}.{ms % 1000:03d}000)  can0  210   [1]  00\n" for ms in steps_ms)
    trace = write(tmp_path / "x.log", lines)
    assert [r.stamp_ns for r in trace if isinstance(r, Frame)] == [ms * MS for ms in stamps_ms]
    assert len(trace.notes) == (steps_ms != stamps_ms)


def test_asc_by_its_header_and_in_any_code_page(tmp_path: Path) -> None:
    (tmp_path / "x.txt").write_bytes(
        (ASC.format("absolute") + " 0.0 測定開始\n 0.1 1 210 Rx d 1 00\n").encode("shift-jis")
    )
    assert list(read_trace(tmp_path / "x.txt")) == [Frame(100 * MS, 0x210, b"\x00")]


def test_asc_lines_that_lack_bytes_are_malformed_and_quiet(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """python-can takes the bytes that are there, and logs a line for each."""
    lines = " 0.1 1  210 Rx d 8 00 11\n" + " 0.2 CANFD 1 Rx 210 x 1 0 d 8 01 02 03 04 05 06 07 08\n" * 50
    found = list(write(tmp_path / "x.asc", ASC.format("absolute") + lines))
    assert found[0] == MalformedRecord(4, " 0.1 1  210 Rx d 8 00 11".strip())
    assert not [r for r in caplog.records if r.levelno >= logging.WARNING]


def test_a_long_header_costs_no_line_more(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The work is counted: python-can gets the same few characters for each line, whatever stands in front of it."""
    given: list[int] = []

    def frame(event: str, base: str, stamp_ns: int) -> Frame:
        given.append(len(event))
        return Frame(stamp_ns, 0x210, b"")

    monkeypatch.setattr(candump, "_asc_frame", frame)
    lines = " 0.1 1  210 Rx d 1 00\n" * 30
    list(write(tmp_path / "x.asc", ASC.format("absolute") + "// comment\n" * 1000 + lines))
    assert given == [16] * 30


@pytest.mark.parametrize("suffix", [".log", ".asc"])
def test_a_line_that_is_too_long_is_malformed(tmp_path: Path, suffix: str) -> None:
    line = " 0.1 1  210 Rx d 8 " + "00 " * 5000
    (record,) = write(tmp_path / f"x{suffix}", line)
    assert isinstance(record, MalformedRecord) and len(record.text) <= candump.MAX_LINE


def test_the_words_about_an_error_frame_belong_to_it(tmp_path: Path) -> None:
    error = " (1.0)  can0  20000004   [8]  00 08 00 00 00 00 60 00   ERRORFRAME\n"
    words = "\tcontroller-problem{tx-error-warning}\n\tstill the same\n"
    records = list(write(tmp_path / "x.log", f"{error}{words} (2.0)  can0  210   [0]\n"))
    assert [type(r) for r in records] == [TraceFrame, TraceFrame]


ENCODINGS = ["utf-8", "utf-8-sig", "utf-16", "utf-16-le", "utf-16-be"]


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_logs_in_every_encoding(tmp_path: Path, encoding: str, end: str) -> None:
    text = f"(1.0) can0 210#00{end}(2.0) can0 210#01{end}"
    assert list(write(tmp_path / "x.log", text, encoding)) == [
        Frame(1000 * MS, 0x210, b"\x00"),
        Frame(2000 * MS, 0x210, b"\x01"),
    ]


DBC = """VERSION ""\n\nNS_ :\n\nBS_:\n\nBU_: ECU\n
BO_ 291 Temps: 8 ECU\n SG_ Oil : 0|8@1+ (1,-40) [-40|215] "°C" ECU\n
CM_ BO_ 291 "{}";\n"""


@pytest.mark.parametrize("encoding", [*ENCODINGS, "cp1252"])
def test_databases_in_every_encoding(tmp_path: Path, encoding: str) -> None:
    comment = "plain" if encoding == "cp1252" else "Teplota oleje: č, ť, Ť"
    path = tmp_path / "x.dbc"
    path.write_bytes(DBC.format(comment).encode(encoding))
    assert codec.load(path).messages["Temps"].signals[0].unit == "°C"


def test_a_database_of_another_code_page_is_read(tmp_path: Path) -> None:
    """Bytes that cp1252 does not have stand in a comment here, and a comment decodes no frame."""
    path = tmp_path / "x.dbc"
    path.write_bytes(DBC.format("Ťť").encode("cp1250"))
    assert codec.load(path).messages["Temps"].signals[0].name == "Oil"


def test_one_byte_of_another_encoding_does_not_change_the_rest() -> None:
    assert decoded("°C ".encode() + "grün".encode("cp1252"), "cp1252") == "°C grün"
    assert decoded(b"\xb0C", "cp1252") == "°C" and decoded(b"\x81\xb0", "utf-8") == "��"


@pytest.mark.parametrize("content", [b"", b"\0", b"\xff\xfe", b"\xff\xfea", b"\xef\xbb\xbf", b"\x81"])
def test_any_bytes_have_a_text(content: bytes) -> None:
    assert isinstance(decoded(content, "cp1252"), str)


J1939 = """VERSION ""\n\nNS_ :\n\nBS_:\n\nBU_: ECU\n
BO_ 2566834942 DM1: 14 Vector__XXX\n SG_ Spn1 : 16|16@1+ (1,0) [0|65535] "" Vector__XXX\n
BA_DEF_ BO_ "VFrameFormat" ENUM "StandardCAN","ExtendedCAN","reserved","J1939PG";
BA_DEF_DEF_ "VFrameFormat" "J1939PG";\n"""


def test_a_message_of_j1939_is_no_fast_packet(tmp_path: Path) -> None:
    path = tmp_path / "x.dbc"
    path.write_text(J1939)
    decoder = Decoder([str(path)])
    frames = [Frame(i * MS, 0x18FECA00 | EXTENDED, bytes(8)) for i in range(3)]
    frames += [Frame(9 * MS, pgn | EXTENDED, bytes(8)) for pgn in (0x1CECFF00, 0x1CEBFF00)]
    assert [(e.values, e.fault) for e in decoder.run(frames)] == [({"Spn1": 0}, "")] * 3
    counts = {"lost_fast_packets": 0, "transported": 0, "refused": 0, "decoded": 3}
    assert counts.items() <= decoder.summary().items()


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("t.log", "(99999999999.0) can0 185#00\n"),
        ("t.log", "(" + "9" * 900 + ") can0 185#00\n"),
        ("t.trc", ";$FILEVERSION=1.1\n  1)  99999999999999.0  Rx  0210  2  00 FC\n"),
        ("t.trc", ";$FILEVERSION=1.1\n  1)  99999999999999.0  Error  0008  4  00 19 08 08\n"),
        ("t.asc", ASC.format("relative") + " 99999999999.0 1  185 Rx d 1 00\n"),
    ],
)
def test_a_stamp_that_no_clock_has_is_malformed(tmp_path: Path, name: str, text: str) -> None:
    assert [type(record) for record in write(tmp_path / name, text)] == [MalformedRecord]


@pytest.mark.parametrize("content", [b"\x1f\x8b\x08rest", b"PK\x03\x04rest"])
def test_a_packed_log_is_named_so(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "t.log"
    path.write_bytes(content)
    (record,) = read_trace(path)
    assert isinstance(record, MalformedRecord) and record.line == 0


def test_a_text_without_frames_is_not_read_to_its_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(candump, "MAX_OTHER_LINES", 5)
    frame = "(1.0) can0 185#00\n"
    assert len(list(write(tmp_path / "t.log", "x\n" * 9 + frame))) == 6
    assert len(list(write(tmp_path / "t.log", frame + "x\n" * 9 + frame))) == 11
