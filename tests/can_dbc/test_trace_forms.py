"""Text traces as other tools write them: PCAN, ASC, encodings; and what the summary says of them."""

from __future__ import annotations

import logging
from pathlib import Path

import can
import pytest

from can_dbc.dbc import codec
from can_dbc.frame import ERROR, EXTENDED, REMOTE, Frame
from can_dbc.text import decoded
from can_dbc.trace import candump
from can_dbc.trace.candump import read_trace
from can_dbc.trace.decoder import Decoder
from can_dbc.trace.records import MalformedRecord, Trace, TraceFrame

MS = 1_000_000
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
    with can.TRCWriter(tmp_path / "x.trc") as writer:
        for i in range(20):
            writer.on_message_received(
                can.Message(
                    timestamp=100 + i / 100, arbitration_id=0x210, is_extended_id=False, data=bytes(i % 9), channel=1
                )
            )
    assert list(read_trace(tmp_path / "x.trc")) == [Frame(i * 10 * MS, 0x210, bytes(i % 9)) for i in range(20)]


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
    text = (
        " (1.0)  can0  20000004   [8]  00 08 00 00 00 00 60 00   ERRORFRAME\n\tcontroller-problem{tx-error-warning}\n"
    )
    assert [type(r) for r in write(tmp_path / "x.log", text + "\tstill the same\n (2.0)  can0  210   [0]\n")] == [
        TraceFrame,
        TraceFrame,
    ]


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
    summary = decoder.summary()
    assert (summary["lost_fast_packets"], summary["transported"], summary["refused"], summary["decoded"]) == (
        0,
        0,
        0,
        3,
    )


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
