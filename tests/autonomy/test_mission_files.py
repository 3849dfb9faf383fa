"""Mission files that are too large, cut off, of another kind, or have invalid values."""

from __future__ import annotations

import math
import tracemalloc
from pathlib import Path

import pytest

from autonomy.missions import gpx_kml, xml_tree
from autonomy.missions.mission_file import load_mission
from autonomy.missions.model import MissionError, Point
from tests.autonomy.mission_checks import assert_route, codes, good, place, refused
from tests.autonomy.mission_texts import (
    ROUTE,
    at,
    collection,
    feature,
    gpx,
    gpx_points,
    item,
    kml,
    kml_coordinates,
    line,
    lon_lat,
    plan,
    polygon,
)
from tests.codes import coded, numbers_in

NEWLINE = b"\n"


# -- numbers, counts, sizes -------------------------------------------------------------------------------------


@pytest.mark.parametrize("word", ["NaN", "Infinity", "-Infinity"])
def test_nan_and_infinity_in_json(word: str) -> None:
    text = collection(line()).decode().replace(str(lon_lat(ROUTE)[1][1]), word)
    number = 1 + text[: text.index(word)].count("\n")
    assert codes(text.encode()) == ["json-number"] and place(text.encode()) == f"m:{number}"


def test_nan_and_infinity_in_xml() -> None:
    nan = gpx(f'<rte>{gpx_points("rtept")}<rtept lat="NaN" lon="19.8"/></rte>')
    assert codes(nan) == ["non-finite-coordinate"] and place(nan) == "m:6"
    assert codes(kml("<Placemark><LineString><coordinates>1,2 inf,3</coordinates></LineString></Placemark>")) == [
        "non-finite-coordinate"
    ]
    assert codes(gpx('<rte><rtept lat="63,65" lon="19.8"/></rte>')) == ["decimal-comma"]
    assert codes(gpx('<rte><rtept lat="north" lon="19.8"/></rte>')) == ["number"]
    assert codes(gpx('<rte><rtept lat="63.1"/></rte>')) == ["gpx.missing-coordinate"]


def test_huge_numbers() -> None:
    assert codes(b'{"type": "Point", "coordinates": [1e999, 2]}') == ["json-number"]
    assert codes(b'{"type": "Point", "coordinates": [%d, 2]}' % 10**30) == ["projected-coordinates"]
    assert codes(gpx(f'<rte><rtept lat="{10**400}" lon="2"/></rte>')) == ["non-finite-coordinate"]
    assert codes(b'{"type": "Point", "coordinates": ["%d", 2]}' % 10**400) == ["geojson-position"]  # a text


@pytest.mark.parametrize(
    "data",
    [
        b'{"type": "Point",\n"coordinates": [%d, 2]}',
        b'{"type": "Point",\n"coordinates": [1, 2, -%d]}',
        b'{"type":"Feature","geometry":null,\n"properties":{"length_m":%d}}',
        b'{"fileType":"Plan","mission":{\n"items":[{"command":16,"params":[0,0,0,0,%d,2,0]}]}}',
        b'{"fileType":"Plan","mission":{\n"items":[{"command":178,"params":[1,%d]}]}}',
        b'{"fileType":"Plan","mission":{"items":[]},\n"geoFence":{"circles":[{"circle":{"center":[1,2],"radius":%d}}]}}',
    ],
    ids=["longitude", "height", "length", "waypoint", "speed", "radius"],
)
def test_numbers_of_400_digits(data: bytes) -> None:
    assert codes(data % 10**400) == ["json-number"] and place(data % 10**400) == "m:2"


@pytest.mark.parametrize("form", ["geojson", "gpx", "kml", "plan"])
def test_a_million_points_are_refused_in_bounded_memory(form: str, monkeypatch: pytest.MonkeyPatch) -> None:
    count = 1_000_000
    monkeypatch.setattr(gpx_kml, "MAX_KML_POSITIONS", 5_000)  # 100 000 would take seconds while memory is traced
    data = {
        "geojson": lambda: b'{"type":"LineString","coordinates":[' + b"[1,2]," * count + b"[1,2]]}",
        "gpx": lambda: b"<gpx><rte>" + b'<rtept lat="1" lon="2"/>' * count + b"</rte></gpx>",
        "kml": lambda: kml(f"<Placemark><Point><coordinates>{'1,2 ' * count}</coordinates></Point></Placemark>"),
        "plan": lambda: b'{"fileType":"Plan","mission":{"items":[' + b"{}," * count + b"{}]}}",
    }[form]()
    tracemalloc.start()
    try:
        (code,) = codes(data)
        most = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert code.startswith("too-many-")
    assert most < 50e6  # the whole of it would be hundreds


def test_too_many_of_everything() -> None:
    grid = [[19.0 + 1e-6 * i, 63.0] for i in range(2001)]
    assert codes(collection(feature("LineString", grid))) == ["too-many-waypoints"]
    numbers = b'{"type":"LineString","coordinates":[' + b"1," * 200_000 + b"1]}"
    assert codes(numbers) == ["too-many-positions"]
    angles = [math.tau * i / 2001 for i in range(2001)]
    circle = [Point(63.66 + 1e-4 * math.sin(a), 19.9 + 1e-4 * math.cos(a)) for a in angles]
    assert codes(collection(line(), polygon(circle))) == ["too-many-corners"]


def test_huge_files(tmp_path: Path) -> None:
    assert codes(b'{"a": "' + b"x" * (17 << 20) + b'"}') == ["too-large"]
    with (tmp_path / "huge.gpx").open("wb") as file:
        file.truncate(65 << 20)
    with pytest.raises(MissionError, check=coded("mission.too-large")):
        load_mission(tmp_path / "huge.gpx")


def test_deep_nesting() -> None:
    assert codes(b'{"a":' + b"[" * 100_000) == ["nesting"]
    assert codes(b"<kml>" + b"<Folder>" * 100_000) == ["nesting"]


# -- text -------------------------------------------------------------------------------------------------------


def test_byte_order_mark_and_crlf() -> None:
    for data in (collection(line()), gpx(f"<rte>{gpx_points('rtept')}</rte>")):
        assert_route(good(b"\xef\xbb\xbf" + data.replace(b"\n", b"\r\n")).mission)
    wrong = collection(line([*ROUTE, Point(95.0, 100.0)])).replace(b"\n", b"\r\n")
    before = wrong[: wrong.index(b"95.0")].count(b"\n")  # its position begins two lines before, lines count from 1
    (problem,) = refused(wrong).problems
    assert problem.place == f"m:{before - 1}" and 4 in numbers_in(problem.sentence)


def test_not_utf_8() -> None:
    data = collection(line(name="x")).replace(b'"x"', b'"H\xf6rnefors"')
    number = 1 + data[: data.index(b"\xf6")].count(b"\n")
    assert codes(data) == ["encoding"] and place(data) == f"m:{number}"
    assert codes("{}".encode("utf-16-le") + b"\x00") == ["encoding"]
    latin = gpx("<metadata><name>H\xf6rnefors</name></metadata>" + f"<rte>{gpx_points('rtept')}</rte>").decode()
    named = latin.replace("UTF-8", "ISO-8859-1").encode("latin-1")
    assert good(named).mission.name == "Hörnefors"
    assert good(latin.replace('encoding="UTF-8"', "").encode("utf-16")).mission.name == "Hörnefors"
    assert codes(latin.encode("latin-1")) == ["encoding"]
    assert codes(latin.encode("utf-16")) == ["encoding"]  # says UTF-8 and is not
    assert codes(latin.replace("UTF-8", "no-such").encode()) == ["encoding"]


@pytest.mark.parametrize("encoding", ["utf-16", "utf-16-le", "utf-16-be", "utf-8-sig"])
def test_json_in_every_encoding(encoding: str) -> None:
    for text in (collection(line()).decode(), plan(list(map(item, ROUTE))).decode()):
        assert_route(good(text.encode(encoding)).mission)
        assert codes(text.encode(encoding)[:-31]) == ["not-json" if encoding == "utf-8-sig" else "encoding"]
    assert good(collection(line()).decode().encode("utf-16-be")).notes == []


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
    assert codes(data) == ["xml-doctype"] and place(data) == "m:2"
    assert "root:" not in str(refused(data))


@pytest.mark.parametrize(
    ("old", "new", "code", "line"),
    [
        ("<?xml", "\n <?xml", "xml-start", 2),
        ("<rte>", "<rte><a:x/>", "xml-prefix", 3),
        ("<rte>", "<rte><name>Ca&ntilde;on</name>", "xml-entity", 3),
        ("<rte>", "<rte><name>a & b</name>", "not-xml", 3),
    ],
)
def test_why_a_file_is_not_xml(old: str, new: str, code: str, line: int) -> None:
    data = gpx(f"<rte>{gpx_points('rtept')}</rte>").decode().replace(old, new, 1).encode()
    assert codes(data) == [code] and place(data) == f"m:{line}"


@pytest.mark.parametrize(
    "body",
    [
        "<wpt " + " ".join(f'a{i}="1"' for i in range(60_000)) + "/>",
        "<!--" + "x" * 700_000 + "-->",
        "<metadata><name>" + "x" * (17 << 20) + "</name></metadata>",
    ],
    ids=["attributes", "comment", "text"],
)
def test_a_tag_a_comment_and_the_text_have_bounds(body: str) -> None:
    assert codes(gpx(body)) == ["too-many-elements"]


def test_the_attributes_of_all_elements_have_a_bound(monkeypatch: pytest.MonkeyPatch) -> None:
    data = gpx(f"<rte>{gpx_points('rtept')}</rte>")
    good(data)
    monkeypatch.setattr(xml_tree, "MAX_ATTRIBUTES", 5)
    assert codes(data) == ["too-many-elements"]


def test_text_in_pieces_is_whole() -> None:
    name = "a &amp; b " * 9000
    assert good(gpx(f"<metadata><name>{name}</name></metadata><rte>{gpx_points('rtept')}</rte>")).mission.name == (
        name.replace("&amp;", "&").strip()
    )


def test_files_cut_off_and_files_of_other_kinds(tmp_path: Path) -> None:
    data = collection(line())
    assert codes(data[:-20]) == ["not-json"] and place(data[:-20]) == f"m:{1 + data[:-20].count(NEWLINE)}"
    assert codes(gpx(f"<rte>{gpx_points('rtept')}</rte>")[:-8]) == ["not-xml"]
    assert codes(b"PK\x03\x04rest") == ["archive-damaged"]
    assert codes(b"<html><body/></html>") == ["unknown-xml"]
    assert codes(b"QGC WPL 110\n") == ["unknown-format"]
    with pytest.raises(MissionError, check=coded("mission.unreadable")):
        load_mission(tmp_path / "none.gpx")
    with pytest.raises(MissionError, check=coded("mission.unreadable")):
        load_mission(tmp_path)


# -- invalid parts of GeoJSON ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("data", "code"),
    [
        (collection(line(role="raod")), "unknown-role"),
        (collection(polygon(role="log")), "role-shape"),
        (collection(feature("MultiLineString", [])), "geojson-geometry"),
        (collection(feature("Circle", [])), "geojson-geometry"),
        (collection(feature("LineString", [[1, 2], "x"])), "geojson-position"),
        (collection(feature("LineString", [[1, 2], [1, True]])), "geojson-position"),
        (collection(feature("LineString", 7)), "geojson-list"),
        (b'{"type": "FeatureCollection"}', "geojson-list"),
        (b'{"type": "FeatureCollection", "features": [3]}', "geojson-feature"),
        (collection(line(), feature("Point", [1, 2], role="log", length_m="x")), "property-type"),
        (collection(line(), feature("Point", [1, 2], role="log", key=[1])), "property-type"),
        (collection(line(), timberhand=3), "header"),
        (collection(line(), timberhand={"schema": 2}), "schema"),
        (collection(line(), timberhand={"schema": 1, "options": {"laps": "two"}}), "option"),
        (collection(line(), timberhand={"schema": 1, "options": {"lap": 2}}), "option"),
        (collection(line(), timberhand={"schema": 1, "options": {"laps": 0}}), "option-range"),
        (collection(line(), timberhand={"schema": 1, "options": {"speed_m_s": 30}}), "option-range"),
    ],
)
def test_invalid_parts_of_geojson(data: bytes, code: str) -> None:
    assert codes(data) == [code]


@pytest.mark.parametrize(
    ("properties", "code"),
    [
        ({"length_m": 200.0}, "log-size"),
        ({"length_m": 3.0, "diameter_m": 250.0}, "log-size"),
        ({"length_m": 0.5, "diameter_m": 0.6}, "log-shape"),
        ({"bearing_deg": 400.0}, "bearing-range"),
        ({"bearing_deg": -1.0}, "bearing-range"),
        ({"sigma_m": -1.0}, "sigma-range"),
    ],
)
def test_invalid_logs(properties: dict[str, float], code: str) -> None:
    log = feature("Point", lon_lat([at(0, -9)])[0], role="log", **properties)
    assert codes(collection(line(), log)) == [code]


def test_sorting_needs_a_landing_for_every_assortment() -> None:
    log = feature("Point", lon_lat([at(0, -9)])[0], role="log", assortment="veneer")
    landing = feature("Point", lon_lat([at(0, 9)])[0], role="landing", assortments=["pulpwood"])
    sort = {"timberhand": {"schema": 1, "options": {"sort_by_assortment": True}}}
    sort["timberhand"]["options"]["logs"] = "listed"
    assert codes(collection(line(), log, landing, **sort)) == ["assortment-without-landing"]
    sort["timberhand"]["options"]["assortments"] = ["pulpwood"]
    good(collection(line(), log, landing, **sort))  # the log is left
    assert codes(collection(line(), log, **sort)) == ["sorting-without-landing"]


@pytest.mark.parametrize("name", ["sort_by_assortment", "assortments"])
def test_selecting_needs_logs_with_an_assortment(name: str) -> None:
    landing = feature("Point", lon_lat([at(0, 9)])[0], role="landing")
    log = feature("Point", lon_lat([at(0, -9)])[0], role="log")
    options: dict[str, object] = {name: True if name.startswith("sort") else ["pulpwood"]}
    head = {"timberhand": {"schema": 1, "options": options}}
    searched = collection(line(), log, landing, **head)
    assert codes(searched) == ["assortments-not-listed"] and place(searched) == "m"
    options["logs"] = "listed"
    assert codes(collection(line(), log, landing, **head)) == ["logs-without-assortment"]
    good(collection(line(), landing, **head))  # a harvester's file may add the logs


def test_the_line_of_every_kind_of_problem() -> None:
    """Each problem names the line on which its part of the mission begins."""
    data = collection(line([*ROUTE, at(36, 12)]), polygon())
    path = '"coordinates": [\n'
    start = data.decode().index(path) + len(path)
    wanted = 1 + data.decode()[:start].count("\n") + 3 * 4  # three positions of four lines are before it
    assert codes(data) == ["waypoint-outside-fence"] and place(data) == f"m:{wanted}"
    repeated = gpx(f"<rte>\n{gpx_points('rtept', [*ROUTE, ROUTE[2]])}</rte>")
    assert codes(repeated) == ["duplicate-waypoint"] and place(repeated) == "m:7"
    points = f"<coordinates>\n{kml_coordinates([*ROUTE, ROUTE[2]])}\n</coordinates>"
    body = f"<Placemark><LineString>{points}</LineString></Placemark>"
    assert codes(kml(body)) == ["duplicate-waypoint"] and place(kml(body)) == "m:8"


def test_many_problems_are_counted() -> None:
    away = [at(100 + 3 * i, 0) for i in range(40)]
    error = refused(collection(line(away), polygon()))
    assert len(error.problems) == 10 and 30 in numbers_in(str(error).splitlines()[-1])
