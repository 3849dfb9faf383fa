"""The decoded CAN table: values by name with units, rates, ages, and what a receiver would refuse."""

from __future__ import annotations

import json

from can_dbc.dbc.codec import load
from can_dbc.frame import EXTENDED, Frame
from can_dbc.protocols.e2e import Sender, Status
from console.can_table import _STATUS_WORDS, MAX_ROWS, WINDOW_NS, CanTable

CRANE = load("crane")
ESTOP, VALVE, LIFT = (CRANE.message(name) for name in ("EstopStat", "ValveFbA", "EncLift"))
MS = 1_000_000


def rows_of(table: CanTable, now_ns: int) -> dict:
    seen = table.table(now_ns)
    json.dumps(seen, allow_nan=False)
    return {row["name"] or row["id"]: row for row in seen["rows"]}


def protected(codec, count: int, period_ns: int = 20 * MS, begin_ns: int = 0) -> list[Frame]:
    sender = Sender(codec.data_ids)
    return [Frame(begin_ns + k * period_ns, codec.key, sender.protect(bytes(codec.length))) for k in range(count)]


def test_a_message_has_rate_age_and_values_with_units() -> None:
    table = CanTable("crane0", [CRANE], 1_000_000)
    data = LIFT.encode(*(1234 if s.name == "Position" else 0 for s in LIFT.signals))
    table.on_frames([Frame(k * 5 * MS, LIFT.key, data) for k in range(201)])
    row = rows_of(table, 1_000 * MS)["EncLift"]
    assert (row["rate_hz"], row["age_ms"], row["count"]) == (200, 0, 201)
    units = {name: (value, unit) for name, value, unit in row["values"]}
    assert units["Position"][0] == "1234"
    assert set(units) == {s.name for s in LIFT.signals}
    late = rows_of(table, 2_000 * MS)["EncLift"]
    assert (late["rate_hz"], late["age_ms"], late["late"]) == (0, 1000, True)


def test_a_value_has_its_unit_and_a_label_its_words() -> None:
    table = CanTable("crane0", [CRANE])
    table.on_frames(protected(VALVE, 3))
    values = {name: (value, unit) for name, value, unit in rows_of(table, 0)["ValveFbA"]["values"]}
    state = next(s for s in VALVE.signals if s.name == "State")
    assert values["State"] == (f"{state.choices[0]} (0)", "")
    table.on_frames([Frame(0, LIFT.key, bytes(LIFT.length))])
    united = {s.name: s.unit for s in LIFT.signals if s.unit}
    assert united and {n: u for n, _, u in rows_of(table, 0)["EncLift"]["values"] if u} == united


def test_checksum_counter_and_length_are_refused_and_named() -> None:
    table = CanTable("crane0", [CRANE])
    good = protected(ESTOP, 8)
    broken = good[5]._replace(data=bytes([good[5].data[0] ^ 1, *good[5].data[1:]]))
    table.on_frames([*good[:3], good[4], broken, good[6]._replace(data=b"\0"), good[6], good[6]])
    row = rows_of(table, 200 * MS)["EstopStat"]
    assert (row["lost"], row["refused"], row["why"]) == (2, 3, _STATUS_WORDS[Status.REPEATED])
    assert row["e2e"]


def test_foreign_frames_are_shown_raw_and_bounded() -> None:
    table = CanTable("crane0", [CRANE])
    table.on_frames([Frame(0, k | EXTENDED, b"\x01\xab") for k in range(MAX_ROWS + 7)])
    seen = table.table(0)
    assert len(seen["rows"]) == MAX_ROWS and seen["other"] == 7
    assert seen["rows"][0]["values"] == [["", "01 AB", ""]] and seen["rows"][0]["name"] == ""


def test_the_load_is_that_of_the_last_second_and_unknown_without_a_bit_rate() -> None:
    table, unrated = CanTable("crane0", [CRANE], 125_000), CanTable("crane0", [CRANE])
    frames = [Frame(k * MS, 0x123, bytes(8)) for k in range(1, 501)]
    for each in (table, unrated):
        each.on_frames(frames)
    assert table.table(500 * MS)["load_pct"] == 44.4  # 500 frames of 111 bits
    assert unrated.table(500 * MS)["load_pct"] is None
    assert table.table(500 * MS + WINDOW_NS)["load_pct"] == 0.0
