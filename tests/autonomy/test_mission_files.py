"""What a mission file is told that is too large, cut off, of another kind, or says what cannot be."""

from __future__ import annotations

import math
import tracemalloc
from pathlib import Path

import pytest
from mission_texts import (
    ROUTE,
    at,
    collection,
    feature,
    gpx,
    gpx_points,
    kml,
    kml_coordinates,
    line,
    lon_lat,
    polygon,
)
from told_missions import assert_route, good, told

from autonomy.missions import gpx_kml
from autonomy.missions.mission_file import load_mission
from autonomy.missions.model import MissionError, Point

NEWLINE = b"\n"


# -- numbers, counts, sizes -------------------------------------------------------------------------------------


@pytest.mark.parametrize("word", ["NaN", "Infinity", "-Infinity"])
def test_nan_and_infinity_in_json(word: str) -> None:
    text = collection(line()).decode().replace(str(lon_lat(ROUTE)[1][1]), word)
    number = 1 + text[: text.index(word)].count("\n")
    assert told(text.encode()) == (f"m:{number}: {word} is no number in JSON; write the value, or leave the member out")


def test_nan_and_infinity_in_xml() -> None:
    said = told(gpx(f'<rte>{gpx_points("rtept")}<rtept lat="NaN" lon="19.8"/></rte>'))
    assert said == "m:6: waypoint 4 has a coordinate that is no number (NaN or infinite); survey it again"
    assert "no number (NaN or infinite)" in told(
        kml("<Placemark><LineString><coordinates>1,2 inf,3</coordinates></LineString></Placemark>")
    )
    assert 'lat "63,65" has a decimal comma' in told(gpx('<rte><rtept lat="63,65" lon="19.8"/></rte>'))
    assert 'lat "north" is no number' in told(gpx('<rte><rtept lat="north" lon="19.8"/></rte>'))
    assert "has no lon" in told(gpx('<rte><rtept lat="63.1"/></rte>'))


def test_huge_numbers() -> None:
    assert "number out of range" in told(b'{"type": "Point", "coordinates": [1e999, 2]}')
    assert "projection" in told(b'{"type": "Point", "coordinates": [%d, 2]}' % 10**30)


@pytest.mark.parametrize("form", ["geojson", "gpx", "kml", "plan"])
def test_a_million_points_are_refused_in_bounded_memory(form: str, monkeypatch: pytest.MonkeyPatch) -> None:
    count = 1_000_000
    monkeypatch.setattr(gpx_kml, "MAX_KML_POSITIONS", 5_000)  # 100 000 would take seconds while memory is traced
    data = {
        "geojson": lambda: b'{"type":"LineString","coordinates":[' + b"[1,2]," * count + b"[1,2]]}",
        "gpx": lambda: b"<gpx><rte>" + b'<rtept lat="1" lon="2"/>' * count + b"</rte></gpx>",
        "kml": lambda: kml(f"<Placemark><Point><coordinates>{'1,2 ' * count}</coordinates></Point></Placemark>"),
        "plan": lambda: b'{"fileType":"Plan","mission":{"items":[' + b"{}," * count + b"{}]}}",
    }[form]()  # fmt: skip
    tracemalloc.start()
    try:
        said = told(data)
        most = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert "has more than" in said
    assert most < 50e6  # the whole of it would be hundreds


def test_too_many_of_everything() -> None:
    grid = [[19.0 + 1e-6 * i, 63.0] for i in range(2001)]
    assert "has 2001 waypoints; at most 2000" in told(collection(feature("LineString", grid)))
    numbers = b'{"type":"LineString","coordinates":[' + b"1," * 200_000 + b"1]}"
    assert "has more than 200000 positions" in told(numbers)
    angles = [math.tau * i / 2001 for i in range(2001)]
    circle = [Point(63.66 + 1e-4 * math.sin(a), 19.9 + 1e-4 * math.cos(a)) for a in angles]
    assert "has 2001 corners of fences; at most 2000" in told(collection(line(), polygon(circle)))


def test_huge_files(tmp_path: Path) -> None:
    assert "larger than 16 MB" in told(b'{"a": "' + b"x" * (17 << 20) + b'"}')
    with (tmp_path / "huge.gpx").open("wb") as file:
        file.truncate(65 << 20)
    with pytest.raises(MissionError, match=r"huge\.gpx: is larger than 64 MB; a mission has some kB"):
        load_mission(tmp_path / "huge.gpx")


def test_deep_nesting() -> None:
    assert "nested deeper" in told(b'{"a":' + b"[" * 100_000)
    assert "nested deeper" in told(b"<kml>" + b"<Folder>" * 100_000)


# -- text -------------------------------------------------------------------------------------------------------


def test_byte_order_mark_and_crlf() -> None:
    for data in (collection(line()), gpx(f"<rte>{gpx_points('rtept')}</rte>")):
        assert_route(good(b"\xef\xbb\xbf" + data.replace(b"\n", b"\r\n")).mission)
    wrong = collection(line([*ROUTE, Point(95.0, 100.0)])).replace(b"\n", b"\r\n")
    before = wrong[: wrong.index(b"95.0")].count(b"\n")  # its position begins two lines before, lines count from 1
    assert told(wrong).startswith(f"m:{before - 1}: waypoint 4")


def test_not_utf_8() -> None:
    data = collection(line(name="x")).replace(b'"x"', b'"H\xf6rnefors"')
    number = 1 + data[: data.index(b"\xf6")].count(b"\n")
    assert told(data).startswith(f"m:{number}: byte ") and "no UTF-8 text" in told(data)
    assert "neither JSON nor XML" in told("{}".encode("utf-16-le") + b"\x00")
    latin = gpx("<metadata><name>H\xf6rnefors</name></metadata>" + f"<rte>{gpx_points('rtept')}</rte>").decode()
    named = latin.replace("UTF-8", "ISO-8859-1").encode("latin-1")
    assert good(named).mission.name == "Hörnefors"
    assert good(latin.replace('encoding="UTF-8"', "").encode("utf-16")).mission.name == "Hörnefors"
    assert "was the file cut off" in told(latin.encode("latin-1"))
    assert "encoding" in told(latin.replace("UTF-8", "no-such").encode())


@pytest.mark.parametrize(
    "declared",
    [
        '<!DOCTYPE gpx [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;&a;&a;&a;&a;&a;&a;&a;">]>',
        '<!DOCTYPE gpx [<!ENTITY x SYSTEM "file:///etc/passwd">]>',
        '<!DOCTYPE gpx SYSTEM "http://127.0.0.1:9/evil.dtd">',
    ],
    ids=["billion laughs", "file", "external"],
)
def test_entity_expansion(declared: str) -> None:
    data = f'<?xml version="1.0"?>\n{declared}\n<gpx><metadata><name>&b;</name></metadata></gpx>'.encode()
    said = told(data)
    assert said.startswith("m:2: declares a document type or entities") and "root:" not in said


def test_files_cut_off_and_files_of_other_kinds(tmp_path: Path) -> None:
    data = collection(line())
    assert told(data[:-20]).startswith(f"m:{1 + data[:-20].count(NEWLINE)}: this is no JSON: input data was truncated")
    assert "well-formed XML" in told(gpx(f"<rte>{gpx_points('rtept')}</rte>")[:-8])
    assert "zip file; unpack it" in told(b"PK\x03\x04rest")
    assert "<html>, which is no mission" in told(b"<html><body/></html>")
    assert "neither JSON nor XML" in told(b"QGC WPL 110\n")
    with pytest.raises(MissionError, match="cannot be read"):
        load_mission(tmp_path / "none.gpx")
    with pytest.raises(MissionError, match="cannot be read"):
        load_mission(tmp_path)


# -- what the parts of GeoJSON must be --------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("data", "sentence"),
    [
        (collection(line(role="raod")), "role 'raod' is none; use one of route, waypoint"),
        (collection(polygon(role="log")), "a polygon cannot be a log; draw a point or a line"),
        (collection(feature("MultiLineString", [])), "make the route one LineString"),
        (collection(feature("Circle", [])), "type 'Circle' is no geometry of GeoJSON"),
        (collection(feature("LineString", [[1, 2], "x"])), "a position is [longitude, latitude]"),
        (collection(feature("LineString", [[1, 2], [1, True]])), "a position is made of numbers"),
        (collection(feature("LineString", 7)), "coordinates is no list"),
        (b'{"type": "FeatureCollection"}', "features is no list"),
        (b'{"type": "FeatureCollection", "features": [3]}', "this is no feature"),
        (collection(line(), feature("Point", [1, 2], role="log", length_m="x")), "length_m is 'x', which is no number"),
        (collection(line(), feature("Point", [1, 2], role="log", key=[1])), "key is [1], which is no text"),
        (collection(line(), timberhand=3), "timberhand is no object"),
        (collection(line(), timberhand={"schema": 2}), "schema is 2; this release reads schema 1"),
        (collection(line(), timberhand={"schema": 1, "options": {"laps": "two"}}), "laps: expected `int`, got `str`"),
        (collection(line(), timberhand={"schema": 1, "options": {"lap": 2}}), "options are laps, speed_m_s"),
        (collection(line(), timberhand={"schema": 1, "options": {"laps": 0}}), "laps is 0; it goes from 1 to 1000"),
        (collection(line(), timberhand={"schema": 1, "options": {"speed_m_s": 30}}), "speed_m_s is 30; it goes from"),
    ],
)  # fmt: skip
def test_what_geojson_must_be(data: bytes, sentence: str) -> None:
    assert sentence in told(data)


@pytest.mark.parametrize(
    ("properties", "sentence"),
    [
        ({"length_m": 200.0}, "log 1: length_m is 200; logs have 0.3 to 30 m (is it in another unit?)"),
        ({"length_m": 3.0, "diameter_m": 250.0}, "diameter_m is 250"),
        ({"length_m": 0.5, "diameter_m": 0.6}, "0.5 m long and 0.6 m wide, which is no log"),
        ({"bearing_deg": 400.0}, "bearing_deg is 400"),
        ({"sigma_m": -1.0}, "sigma_m is -1"),
    ],
)
def test_what_a_log_must_be(properties: dict[str, float], sentence: str) -> None:
    log = feature("Point", lon_lat([at(0, -9)])[0], role="log", **properties)
    assert sentence in told(collection(line(), log))


def test_sorting_needs_a_landing_for_every_assortment() -> None:
    log = feature("Point", lon_lat([at(0, -9)])[0], role="log", assortment="veneer")
    landing = feature("Point", lon_lat([at(0, 9)])[0], role="landing", assortments=["pulpwood"])
    sort = {"timberhand": {"schema": 1, "options": {"sort_by_assortment": True}}}
    sort["timberhand"]["options"]["logs"] = "listed"
    assert 'log 1 is "veneer", which no landing takes' in told(collection(line(), log, landing, **sort))
    sort["timberhand"]["options"]["assortments"] = ["pulpwood"]
    good(collection(line(), log, landing, **sort))  # it stays lying
    assert "there is no landing to sort to; add landings" in told(collection(line(), log, **sort))


@pytest.mark.parametrize("name", ["sort_by_assortment", "assortments"])
def test_choosing_needs_logs_that_say_what_they_are(name: str) -> None:
    landing = feature("Point", lon_lat([at(0, 9)])[0], role="landing")
    log = feature("Point", lon_lat([at(0, -9)])[0], role="log")
    options: dict[str, object] = {name: True if name.startswith("sort") else ["pulpwood"]}
    head = {"timberhand": {"schema": 1, "options": options}}
    searched = told(collection(line(), log, landing, **head))
    assert searched == (
        f'm: {name} needs to know what each log is; list the logs and set logs to "listed", or leave it out'
    )
    options["logs"] = "listed"
    assert "and no log says it; give the logs an assortment" in told(collection(line(), log, landing, **head))
    good(collection(line(), landing, **head))  # a harvester's file may bring the logs


def test_the_line_of_every_kind_of_problem() -> None:
    """Each sentence names the line on which what it is about begins."""
    data = collection(line([*ROUTE, at(36, 12)]), polygon())
    path = '"coordinates": [\n'
    start = data.decode().index(path) + len(path)
    wanted = 1 + data.decode()[:start].count("\n") + 3 * 4  # three positions of four lines are before it
    assert told(data).startswith(f"m:{wanted}: waypoint 4")
    said = told(gpx(f"<rte>\n{gpx_points('rtept', [*ROUTE, ROUTE[2]])}</rte>"))
    assert said.startswith("m:7: waypoint 4")
    points = f"<coordinates>\n{kml_coordinates([*ROUTE, ROUTE[2]])}\n</coordinates>"
    body = f"<Placemark><LineString>{points}</LineString></Placemark>"
    assert told(kml(body)).startswith("m:8: waypoint 4")


def test_many_problems_are_counted() -> None:
    away = [at(100 + 3 * i, 0) for i in range(40)]
    said = told(collection(line(away), polygon())).splitlines()
    assert len(said) == 11 and said[-1] == "m: and 30 more of the kind"
