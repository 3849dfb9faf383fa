"""The compiled codec: equal to cantools bit for bit, never wraps, refuses whole frames."""

from __future__ import annotations

import math
import os
import random
import struct
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from itertools import product
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from can_dbc.dbc import check, codec, codegen
from can_dbc.dbc.ahead_of_time import module_source
from can_dbc.dbc.codegen import key_of
from can_dbc.dbc.signals import FrameRefused, Refusal
from can_dbc.frame import EXTENDED
from runtime.errors import ConfigError, InputRefused
from tests.codes import coded

DATA = Path(os.environ.get("TIMBERHAND_DATA", Path(__file__).parents[3] / "shared" / "data")) / "can"
FOREIGN = sorted([*DATA.glob("*/dbc/*.dbc"), *DATA.glob("opendbc/*.dbc"), *DATA.glob("*/kcd/*.kcd")])
REFUSED_BY_CANTOOLS = {
    "bad_message_length.dbc",
    "message_layout.kcd",
    "hyundai_i30_2014.dbc",
    "vw_mqb.dbc",
    "test.dbc",
}
HEAD = 'VERSION ""\nNS_ :\nBS_:\nBU_: A\n'
MIXED = """VERSION ""
NS_ :
BS_:
BU_: A
BO_ 2147484672 Wide: 24 A
 SG_ Le64 : 0|64@1- (1,0) [0|0] "" A
 SG_ Be64 : 71|64@0+ (1,0) [0|0] "" A
 SG_ Odd : 131|13@0- (0.1,-3) [-200|200] "m" A
 SG_ F32 : 152|32@1- (1,0) [0|0] "V" A
 SG_ Half : 189|3@1+ (0.5,0) [0|3.5] "m" A
BO_ 257 Empty: 0 A
BO_ 258 Double: 8 A
 SG_ D : 7|64@0- (2,1) [-1000|1000] "V" A
BO_ 259 Steps: 8 A
 SG_ Whole : 0|16@1- (5,3) [0|0] "m" A
 SG_ Falling : 16|16@1+ (-0.25,100) [-200|100] "m" A
 SG_ Top : 39|16@0+ (1,-40) [-40|210] "degC" A
BA_DEF_ BO_ "VFrameFormat" ENUM
"StandardCAN","ExtendedCAN","reserved","J1939PG","r","r","r","r","r","r","r","r","r","r","StandardCAN_FD","ExtendedCAN_FD";
BA_DEF_DEF_ "VFrameFormat" "StandardCAN"; BA_ "VFrameFormat" BO_ 2147484672 15; SIG_VALTYPE_ 2147484672 F32
: 1; SIG_VALTYPE_ 258 D : 2;
"""


@cache
def shipped(name: str) -> codec.Database:
    return codec.load(name)


@pytest.fixture
def crane() -> codec.Database:
    return shipped("crane")


def pairs_of(path: Path) -> list[tuple]:
    return [(m, codec.compile_one(m, path)) for m in codec.parse(path).messages]


def id_of(path: object) -> str:
    return getattr(path, "name", str(path))


# -- equal to cantools ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "path",
    [codec.resolve(n) for n in codec.SHIPPED] + [p for p in FOREIGN if p.name not in REFUSED_BY_CANTOOLS],
    ids=id_of,
)
def test_equals_cantools(path: Path) -> None:
    pairs = [p for p in pairs_of(path) if p[1].length or not p[1].signals]

    @settings(max_examples=120, deadline=None, derandomize=True, database=None)
    @given(st.data())
    def compare(data: st.DataObject) -> None:
        message, ours = data.draw(st.sampled_from(pairs))
        payload = data.draw(st.binary(min_size=ours.length, max_size=ours.length))
        assert check.compare_decode(message, ours, payload) == []
        values = check.random_values(random.Random(data.draw(st.integers(0, 2**32))), ours, payload)
        if values is not None:
            assert check.compare_encode(message, ours, values) == []

    compare()
    report = check.check(str(path), 15, 7)
    assert (report.error, report.differences) == ("", ())
    assert report.decoded == 15 * len(pairs)


def test_foreign_data_is_present() -> None:
    if not FOREIGN:
        pytest.skip("no third-party DBC files under TIMBERHAND_DATA/can")
    assert len(FOREIGN) == 28


def test_mixed_layouts_equal_cantools(tmp_path: Path) -> None:
    path = tmp_path / "mixed.dbc"
    path.write_text(MIXED)
    report = check.check(str(path), 500, 3)
    assert (report.error, report.differences, report.messages) == ("", (), 4)
    wide = codec.load(path).messages["Wide"]
    values = (-(2**63), 2**64 - 1, 12.5, 1.5, 2.5)
    assert wide.decode(wide.encode(*values)) == values
    assert codec.load(path).messages["Empty"].encode() == b""


def test_comparison_finds_a_wrong_codec(crane: codec.Database) -> None:
    message = next(m for m in codec.parse(crane.path).messages if m.name == "PressA")
    ours = crane.messages["PressA"]
    wrong = replace(ours, decode=lambda d: (*ours.decode(d)[:-1], 0.3), encode=lambda *v: ours.encode(*v[:-1], 0.3))
    payload = ours.encode(1, 2, 0, 1.0, 2.0, 3.0, 4.0)
    assert check.compare_decode(message, ours, payload) == []
    assert len(check.compare_decode(message, wrong, payload)) == 1
    assert len(check.compare_encode(message, wrong, list(ours.decode(payload)))) == 1


@pytest.mark.parametrize("name", codec.SHIPPED)
def test_every_raw_value_survives_the_round_trip(name: str) -> None:
    for message in shipped(name).messages.values():
        for i, s in enumerate(message.signals):
            if s.bits > 12:
                continue
            for raw in range(s.raw_low, s.raw_high + 1):
                assert s.encode(s.physical(raw)) == raw & (1 << s.bits) - 1, (message.name, i, raw)


# -- refusing ----------------------------------------------------------------------------------------------------

GOOD = {
    "ValveCmdA": (0, 0, 2, 10.0, -10.0, 0.0, 100.0),
    "ValveFbA": (0, 0, 1, 10.0, -10.0, 0.0, 100.0),
    "PressA": (0, 0, 0, 100.0, 0.0, 400.0, 1.0),
}
ENCODE_CASES = [
    # message, signal index, value, refused, or the physical value that arrives
    ("ValveCmdA", 3, math.nan, "codec.not-finite"),
    ("ValveCmdA", 3, math.inf, "codec.not-finite"),
    ("ValveCmdA", 3, -math.inf, "codec.not-finite"),
    ("ValveCmdA", 3, "10", "codec.not-finite"),
    ("ValveCmdA", 3, 100.06, "codec.out-of-range"),
    ("ValveCmdA", 3, -1e300, "codec.out-of-range"),
    ("ValveCmdA", 3, 102.35, "codec.out-of-range"),
    ("ValveCmdA", 3, 204.8, "codec.out-of-range"),
    ("ValveCmdA", 2, 4, "codec.out-of-range"),
    ("ValveCmdA", 1, 16, "codec.out-of-range"),
    ("ValveCmdA", 0, None, "codec.no-not-available"),
    ("ValveCmdA", 3, 0.025, 0.0),
    ("ValveCmdA", 3, 0.125, 0.1),
    ("ValveCmdA", 3, -0.026, -0.05),
    ("ValveFbA", 3, 130.0, 100.0),
    ("ValveFbA", 3, -1e300, -100.0),
    ("ValveFbA", 3, math.nan, "codec.not-finite"),
    ("ValveFbA", 3, math.inf, "codec.not-finite"),
    ("PressA", 3, -5.0, 0.0),
    ("PressA", 3, 1e9, 400.0),
]


@pytest.mark.parametrize(("name", "index", "value", "expected"), ENCODE_CASES)
def test_encoding_never_wraps(crane: codec.Database, name: str, index: int, value: object, expected: object) -> None:
    message = crane.messages[name]
    values = list(GOOD[name])
    values[index] = value  # type: ignore[call-overload]
    if isinstance(expected, str):
        with pytest.raises(InputRefused, check=coded(expected)):
            message.encode(*values)
    else:
        values[index] = expected  # type: ignore[call-overload]
        got = message.decode(message.encode(*values[:index], value, *values[index + 1 :]))
        assert got == pytest.approx(tuple(values))


@given(st.floats(allow_nan=True, allow_infinity=True), st.integers(3, 6))
@settings(max_examples=300, deadline=None, derandomize=True, database=None)
def test_no_float_ever_wraps(value: float, index: int) -> None:
    message = shipped("crane").messages["ValveCmdA"]
    values = list(GOOD["ValveCmdA"])
    values[index] = value
    try:
        got = message.receive(message.encode(*values))[index]
    except InputRefused:
        assert not -100.0 <= value <= 100.0
    else:
        assert abs(got - value) <= 0.025000001


VALVE_FRAME = shipped("crane").messages["ValveCmdA"].encode(*GOOD["ValveCmdA"])


def with_bits(shift: int, width: int, raw: int) -> bytes:
    word = int.from_bytes(VALVE_FRAME, "little") & ~(((1 << width) - 1) << shift)
    return (word | raw << shift).to_bytes(8, "little")


RECEIVE_CASES = [
    # payload, reason or the value of signal 3
    (VALVE_FRAME, 10.0),
    (VALVE_FRAME[:7], Refusal.LENGTH),
    (VALVE_FRAME + b"\0", Refusal.LENGTH),
    (with_bits(16, 12, 2000), 100.0),
    (with_bits(16, 12, 2001), Refusal.RANGE),
    (with_bits(16, 12, 4096 - 2001), Refusal.RANGE),
    (with_bits(16, 12, 0x7FF), None),
    (with_bits(16, 12, 0x800), None),
    (with_bits(12, 4, 4), Refusal.RANGE),
]


@pytest.mark.parametrize(("payload", "expected"), RECEIVE_CASES)
def test_receiving_is_strict(crane: codec.Database, payload: bytes, expected: Refusal | float | None) -> None:
    message = crane.messages["ValveCmdA"]
    if isinstance(expected, Refusal):
        with pytest.raises(FrameRefused) as refused:
            message.receive(payload)
        assert refused.value.reason is expected
    else:
        assert message.receive(payload)[3] == expected


@given(st.sampled_from(codec.SHIPPED), st.data())
@settings(max_examples=300, deadline=None, derandomize=True, database=None)
def test_receive_is_decode_or_refusal(name: str, data: st.DataObject) -> None:
    database = shipped(name)
    message = data.draw(st.sampled_from(list(database.messages.values())))
    payload = data.draw(st.binary(min_size=message.length, max_size=message.length))
    plain = message.decode(payload)
    little = int.from_bytes(payload, "little")
    raws = [s.extract(little, 0) for s in message.signals]
    sound = [s.raw_low <= raw <= s.raw_high or raw in s.choices for s, raw in zip(message.signals, raws, strict=True)]
    try:
        got = message.receive(payload)
    except FrameRefused:
        assert not all(sound)
        return
    assert all(sound)
    for s, raw, value, checked in zip(message.signals, raws, plain, got, strict=True):
        assert checked is None if raw in s.sentinels else checked == value


def test_none_is_sent_as_not_available() -> None:
    heading = shipped("gnss").messages["VesselHeading"]
    assert heading.encode(None, 1.5, None, None, 0, None) == bytes.fromhex("ff983aff7fff7ffc")
    assert heading.receive(bytes.fromhex("ff983aff7fff7ffc")) == (None, 1.5, None, None, 0, None)


def test_floats(tmp_path: Path) -> None:
    path = tmp_path / "mixed.dbc"
    path.write_text(MIXED)
    double = codec.load(path).messages["Double"]
    assert double.encode(5.0) == struct.pack(">d", 2.0)
    for bad in (math.nan, math.inf, 1000.1):
        with pytest.raises(InputRefused):
            double.encode(bad)
        with pytest.raises(FrameRefused):
            double.receive(struct.pack(">d", bad))


# -- multiplexing ------------------------------------------------------------------------------------------------


def test_multiplexed_signals_are_none_when_absent() -> None:
    path = DATA / "cantools/dbc/issue_184_extended_mux_cascaded.dbc"
    if not path.exists():
        pytest.skip("no cantools files under TIMBERHAND_DATA/can")
    (message,) = codec.load(path).messages.values()
    seen = {}
    for first, second in product(range(4), range(4)):
        try:
            values = message.decode(bytes((first, second, 34, 51, 0, 0, 0, 0)))
        except FrameRefused as refused:
            assert refused.reason is Refusal.MULTIPLEXER
            continue
        assert message.decode(message.encode(*values)) == values
        seen[first, second] = set(message.named(values))
        surplus = [0 if value is None else value for value in values]
        with pytest.raises(InputRefused, check=coded("codec.absent-signal")):
            message.encode(*surplus)
    cascade = {"MUX_A", "muxed_A_2_MUX_B"}
    assert seen == {(1, n): {"MUX_A", "muxed_A_1"} for n in range(4)} | {
        (2, 0): cascade | {"muxed_B_0"},
        (2, 1): cascade | {"muxed_B_1"},
    }


def test_a_named_multiplexer_value_needs_no_signals(tmp_path: Path) -> None:
    path = tmp_path / "f.dbc"
    path.write_text(
        HEAD + 'BO_ 1 M: 2 A\n SG_ S M : 0|8@1+ (1,0) [0|0] "" A\n SG_ X m1 : 8|8@1+ (1,0) [0|0] "" A\n'
        'VAL_ 1 S 3 "Idle" ;\n'
    )
    report = check.check(str(path), 300, 1)
    assert (report.error, report.differences) == ("", ())
    message = codec.load(path).messages["M"]
    assert message.receive(b"\x03\x07") == (3, None)
    assert message.encode(3, None) == b"\x03\x00"
    for refused in ((2, None), (3, 0), (1, None), (None, 0), (math.nan, 0)):
        with pytest.raises(InputRefused):
            message.encode(*refused)
    with pytest.raises(TypeError):
        message.encode(3)


# -- loading -------------------------------------------------------------------------------------------------------

BROKEN = [
    ("BO_ 1 M: 8 A\n SG_ X 0|8@1+\n", "dbc.invalid", ("f.dbc:6: ",)),
    (
        'BO_ 1 M: 8 A\n SG_ X : 0|8@1+ (1,0) [0|0] "" A\n SG_ Y : 7|8@1+ (1,0) [0|0] "" A\n',
        "dbc.invalid",
        ("f.dbc:5: ",),
    ),
    ('BO_ 1 M: 1 A\n SG_ X : 0|9@1+ (1,0) [0|0] "" A\n', "dbc.invalid", ("f.dbc:5: ",)),
    ('BO_ 1 M: 8 A\n SG_ X : -1|8@1+ (1,0) [0|0] "" A\n', "dbc.invalid", ("X",)),
    ("BO_ 1 M: 1 A\nBO_ 1 N: 1 A\n", "dbc.duplicate", ("001",)),
    ('BO_ 1 M: 1 A\n SG_ X : 0|8@1+ (1,0) [0|1e400] "" A\n', "dbc.invalid", ("M",)),
    ("BO_ 1 M: 1 A\nBO_ 2 M: 1 A\n", "dbc.duplicate", ("M",)),
    (
        'BO_ 1 M: 8 A\nBA_DEF_ BO_ "E2EProfile" ENUM "None","P02";\nBA_DEF_DEF_ "E2EProfile" "None";\n'
        'BA_ "E2EProfile" BO_ 1 1;\n',
        "dbc.data-ids",
        ("M",),
    ),
]


@pytest.mark.parametrize(("text", "code", "named"), BROKEN)
def test_broken_files_name_line_and_reason(tmp_path: Path, text: str, code: str, named: tuple[str, ...]) -> None:
    path = tmp_path / "f.dbc"
    path.write_text(HEAD + text)
    with pytest.raises(ConfigError, check=coded(code)) as refused:
        codec.load(path)
    assert all(word in str(refused.value) for word in named)


@pytest.mark.parametrize("name", ["nowhere.dbc", "wheel"])
def test_missing_files(name: str) -> None:
    with pytest.raises(ConfigError, check=coded("dbc.no-file")):
        codec.load(name)


@pytest.mark.parametrize("path", [p for p in FOREIGN if p.name in REFUSED_BY_CANTOOLS], ids=id_of)
def test_files_cantools_refuses(path: Path) -> None:
    with pytest.raises(ConfigError, match=rf"{path.name}:\d+: ", check=coded("dbc.invalid")):
        codec.load(path)
    report = check.check(str(path), 1, 1)
    assert report.error
    if path.name != "test.dbc":
        assert {f.rule for f in report.warnings} & {"overlap", "length"}


def test_unknown_message_is_a_clear_error(crane: codec.Database) -> None:
    with pytest.raises(ConfigError, check=coded("dbc.unknown-message")):
        crane.message("ValveCmdC")


FIND_CASES = [
    # database, key, message
    ("crane", 0x210, "ValveCmdA"),
    ("crane", 0x210 | EXTENDED, None),
    ("machine", 0x0CFF2203 | EXTENDED, "VehStat"),
    ("machine", 0x0CFF2204 | EXTENDED, None),
    ("machine", 0x0CF00400 | EXTENDED, "EEC1"),
    ("machine", 0x18F00421 | EXTENDED, "EEC1"),
    ("machine", 0x18EEFF80 | EXTENDED, "AddressClaim"),
    ("machine", 0x18EE2780 | EXTENDED, "AddressClaim"),
    ("machine", 0x0CEA30FE | EXTENDED, "Request"),
    ("machine", 0x0CF00400, None),
    ("gnss", 0x09F8011C | EXTENDED, "PositionRapidUpdate"),
    ("gnss", 0x19F80124 | EXTENDED, "PositionRapidUpdate"),
    ("gnss", 0x09F80324 | EXTENDED, None),
]


@pytest.mark.parametrize(("name", "key", "expected"), FIND_CASES)
def test_find_matches_exactly_or_by_pgn(name: str, key: int, expected: str | None) -> None:
    found = shipped(name).find(key)
    assert (found and found.name) == expected


PROTOCOL = 'BA_DEF_ "ProtocolType" STRING ;\nBA_DEF_DEF_ "ProtocolType" "";\nBA_ "ProtocolType" "J1939";\n'


@pytest.mark.parametrize(
    ("attributes", "by_pgn"),
    [
        (PROTOCOL, True),
        (PROTOCOL.replace('DEF_ "ProtocolType" ""', 'DEF_ "ProtocolType" "J1939"').rpartition("BA_ ")[0], True),
        (PROTOCOL.replace('"J1939"', '"CANopen"'), False),
        (
            PROTOCOL + 'BA_DEF_ BO_ "VFrameFormat" ENUM "StandardCAN","ExtendedCAN","reserved","J1939PG";\n'
            'BA_DEF_DEF_ "VFrameFormat" "ExtendedCAN";\n',
            False,
        ),
        ("", False),
    ],
)
def test_a_database_of_j1939_as_a_whole_is_matched_by_pgn(tmp_path: Path, attributes: str, by_pgn: bool) -> None:
    path = tmp_path / "j1939.dbc"
    signal = ' SG_ S : 0|8@1+ (1,0) [0|255] "" E\n'
    path.write_text(f'VERSION ""\nBU_: E\nBO_ 2364540158 A: 8 E\n{signal}\nBO_ 5 B: 8 E\n{signal}\n{attributes}')
    database = codec.load(path)
    assert database.find(0x18F00421 | EXTENDED) == (database.message("A") if by_pgn else None)
    assert database.find(0x0CF004FE | EXTENDED) == database.message("A")
    assert not database.message("B").by_pgn


@pytest.mark.parametrize("what", ["Message", "Signal"])
def test_a_kcd_message_or_signal_without_a_name_is_refused(tmp_path: Path, what: str) -> None:
    """The fuzzer found it: cantools gives it the name None."""
    text = (
        '<NetworkDefinition xmlns="http://kayak.2codeornot2code.org/1.0"><Document/><Bus name="b">'
        '<Message id="0x1" length="8" name="M"><Signal name="X" offset="0" length="8"/></Message></Bus>'
        "</NetworkDefinition>"
    )
    path = tmp_path / "f.kcd"
    path.write_text(text)
    assert "M" in codec.load(path).messages
    path.write_text(text.replace(' name="M"' if what == "Message" else ' name="X"', ""))
    with pytest.raises(ConfigError, check=coded("dbc.invalid")):
        codec.load(path)


# -- the typed codecs for the compiler give the same, here run as plain Python

CODECS = [one for name in codec.SHIPPED for one in shipped(name).messages.values()]
UNUSUAL = (None, math.nan, math.inf, -math.inf, -0.0, 1e300, 10**30, 2**53 + 1, True, "7", 0.5, 2.5)


@pytest.fixture(scope="module")
def classes() -> dict[str, Any]:
    # As a Python int a word has no sign.
    space: dict[str, Any] = {"__name__": "generated"}
    exec(module_source(CODECS).replace('Struct("<q")', 'Struct("<Q")'), space)
    found: dict[str, Any] = space["CODECS"]
    return found


def compiled(one: codec.MessageCodec, classes: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> codec.MessageCodec:
    """The same message, made while the classes are there."""
    path = next(shipped(name).path for name in codec.SHIPPED if one.name in shipped(name).messages)
    monkeypatch.setattr(codegen, "AHEAD_OF_TIME", classes)
    return codec.compile_one(codec.parse(path).get_message_by_name(one.name), path)


def outcome(function: Callable[..., Any], *arguments: object) -> tuple[str, ...]:
    try:
        return (repr(function(*arguments)),)
    except (ValueError, TypeError, OverflowError) as error:
        return type(error).__name__, str(error)


def test_all_shipped_messages_are_covered_but_those_longer_than_a_frame(classes: dict[str, Any]) -> None:
    assert {one.name for one in CODECS if key_of(one.source) not in classes} == {
        one.name for one in CODECS if one.length > 8
    }


@pytest.mark.parametrize("name", ["EncSlew", "EncTilt", "ValveFbA", "EEC1", "GuardStat", "CtrlStatus", "ValveCmdA"])
def test_they_agree_with_the_interpreters_codecs(
    name: str, classes: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    one = next(one for one in CODECS if one.name == name)
    other = compiled(one, classes, monkeypatch)
    assert other.receive != one.receive and other.source == one.source
    rng = random.Random(name)
    for _ in range(1500):
        data = rng.randbytes(one.length if rng.random() < 0.95 else rng.randrange(9))
        data = bytes(rng.choice((0, 1, 127, 128, 255)) for _ in data) if rng.random() < 0.3 else data
        assert outcome(one.receive, data) == outcome(other.receive, data)
        if len(data) != one.length:
            continue
        values = list(one.decode(data))
        for i, s in enumerate(one.signals):
            choice = rng.random()
            if choice < 0.1:
                values[i] = rng.choice((*UNUSUAL, s.minimum, s.maximum))
            elif choice < 0.5:
                values[i] = rng.choice((values[i], s.minimum or 0, s.maximum or 0))
                values[i] += rng.choice((0.5, -0.5, 1e-7, -1e-7, 1e-6, rng.uniform(-1, 1))) * s.scale
        assert outcome(one.encode, *values) == outcome(other.encode, *values), values
