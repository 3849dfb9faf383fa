"""Mission files that are too large, cut off, of another kind, or have invalid values or wrong coordinates."""

from __future__ import annotations

import math
import tracemalloc
from pathlib import Path

import pytest

from autonomy.missions import gpx_kml, xml_tree
from autonomy.missions.local_frame import LocalFrame
from autonomy.missions.mission_file import load_mission
from autonomy.missions.model import MissionError, Point
from autonomy.missions.validation import SWAPPED_HINT
from tests.autonomy.mission_checks import assert_route, codes, good, place, refused
from tests.autonomy.mission_texts import (
    FENCE,
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


SWAPPED_ROUTE = [Point(p.longitude_deg, p.latitude_deg) for p in ROUTE]
NOTCH = [at(-30, -25), at(30, -25), at(30, 25), at(5, 25), at(0, -20), at(-5, 25), at(-30, 25)]
CIRCLE = [Point(63.66 + 1e-4 * math.sin(0.00314 * i), 19.9 + 1e-4 * math.cos(0.00314 * i)) for i in range(2001)]


def fenced(*corners: Point) -> bytes:
    return collection(line(), polygon(list(corners)))


def log(**properties: float) -> bytes:
    return collection(line(), feature("Point", lon_lat([at(0, -9)])[0], role="log", **properties))


def headed(**options: object) -> bytes:
    return collection(line(), timberhand={"schema": 1, "options": options})


REFUSED = {
    # numbers
    "too large for a float": (b'{"type": "Point", "coordinates": [1e999, 2]}', "json-number"),
    "an integer of 31 digits": (b'{"type": "Point", "coordinates": [%d, 2]}' % 10**30, "projected-coordinates"),
    "401 digits in a GPX": (gpx(f'<rte><rtept lat="{10**400}" lon="2"/></rte>'), "non-finite-coordinate"),
    "a number as text": (b'{"type": "Point", "coordinates": ["%d", 2]}' % 10**400, "geojson-position"),
    "infinity in a KML": (
        kml("<Placemark><LineString><coordinates>1,2 inf,3</coordinates></LineString></Placemark>"),
        "non-finite-coordinate",
    ),
    "a blank after a comma in a KML": (
        kml("<Placemark><LineString><coordinates>1, 2, 0 3, 4, 0</coordinates></LineString></Placemark>"),
        "kml.position",
    ),
    "a decimal comma": (gpx('<rte><rtept lat="63,65" lon="19.8"/></rte>'), "decimal-comma"),
    "a word": (gpx('<rte><rtept lat="north" lon="19.8"/></rte>'), "number"),
    "no longitude": (gpx('<rte><rtept lat="63.1"/></rte>'), "gpx.missing-coordinate"),
    # counts
    "waypoints": (
        collection(feature("LineString", [[19.0 + 1e-6 * i, 63.0] for i in range(2001)])),
        "too-many-waypoints",
    ),
    "positions": (b'{"type":"LineString","coordinates":[' + b"1," * 200_000 + b"1]}", "too-many-positions"),
    "corners": (fenced(*CIRCLE), "too-many-corners"),
    "depth of JSON": (b'{"a":' + b"[" * 100_000, "nesting"),
    "depth of XML": (b"<kml>" + b"<Folder>" * 100_000, "nesting"),
    # files of other kinds
    "nothing": (b"", "empty-file"),
    "blanks": (b"\xef\xbb\xbf \n", "empty-file"),
    "cut off XML": (gpx(f"<rte>{gpx_points('rtept')}</rte>")[:-8], "not-xml"),
    "a zip file's head": (b"PK\x03\x04rest", "archive-damaged"),
    "a web page": (b"<html><body/></html>", "unknown-xml"),
    "an old plan": (b"QGC WPL 110\n", "unknown-format"),
    "a list": (b"[[19.9, 63.6], [19.9, 63.7]]", "no-object"),
    "no features": (collection(), "no-waypoints"),
    "an empty line": (collection(feature("LineString", [])), "no-waypoints"),
    "an empty route": (gpx("<rte/>"), "no-waypoints"),
    "a plan without items": (b'{"fileType": "Plan"}', "plan.items"),
    # GeoJSON
    "a misspelt role": (collection(line(role="raod")), "unknown-role"),
    "an area as log": (collection(polygon(role="log")), "role-shape"),
    "several lines": (collection(feature("MultiLineString", [])), "geojson-geometry"),
    "another shape": (collection(feature("Circle", [])), "geojson-geometry"),
    "a text as position": (collection(feature("LineString", [[1, 2], "x"])), "geojson-position"),
    "a truth as coordinate": (collection(feature("LineString", [[1, 2], [1, True]])), "geojson-position"),
    "a number as line": (collection(feature("LineString", 7)), "geojson-list"),
    "a collection of nothing": (b'{"type": "FeatureCollection"}', "geojson-list"),
    "a number as feature": (b'{"type": "FeatureCollection", "features": [3]}', "geojson-feature"),
    "a length in words": (log(length_m="x"), "property-type"),
    "a list as key": (log(key=[1]), "property-type"),
    "a number as header": (collection(line(), timberhand=3), "header"),
    "another schema": (collection(line(), timberhand={"schema": 2}), "schema"),
    "laps in words": (headed(laps="two"), "option"),
    "a misspelt option": (headed(lap=2), "option"),
    "no laps": (headed(laps=0), "option-range"),
    "too fast": (headed(speed_m_s=30), "option-range"),
    "two routes": (collection(line(), line()), "second-route"),
    "a waypoint beside": (
        collection(line(), feature("Point", [19.9, 63.66], role="waypoint")),
        "waypoint-beside-route",
    ),
    # logs
    "too long": (log(length_m=200.0), "log-size"),
    "too thick": (log(length_m=3.0, diameter_m=250.0), "log-size"),
    "thicker than long": (log(length_m=0.5, diameter_m=0.6), "log-shape"),
    "beyond north": (log(bearing_deg=400.0), "bearing-range"),
    "before north": (log(bearing_deg=-1.0), "bearing-range"),
    "less than certain": (log(sigma_m=-1.0), "sigma-range"),
    # coordinates
    "beyond the pole": (
        collection(line([Point(144.0, -37.0), Point(144.001, -37.0)])),
        "swapped-axes swapped-axes",
    ),
    "a swapped route": (collection(line(SWAPPED_ROUTE), polygon()), "swapped-axes swapped-axes swapped-axes"),
    "metres of a projection": (
        collection(feature("LineString", [[743000.0, 7065000.0], [743040.0, 7065000.0]])),
        "projected-coordinates projected-coordinates",
    ),
    "far apart": (collection(line([at(0, 0), at(0, 21_000)])), "too-far-apart"),
    "latitude": (collection(feature("Point", [100.0, 95.0])), "latitude-range"),
    "longitude": (collection(feature("Point", [200.0, 45.0])), "longitude-range"),
    # fences
    "a leg through a notch": (collection(line([at(-20, 10), at(20, 10)]), polygon(NOTCH)), "leg-leaves-fence"),
    "a bow": (fenced(FENCE[0], FENCE[2], FENCE[1], FENCE[3]), "fence-crosses-itself"),
    "a spike": (fenced(*FENCE[:2], at(60, -25), FENCE[1], *FENCE[2:]), "fence-crosses-itself"),
    "on one line": (fenced(at(0, 0), at(30, 0), at(10, 0)), "fence-crosses-itself"),
    "half a square metre": (fenced(at(0, 0), at(1, 0), at(1, 1)), "fence-area"),
    "two corners": (fenced(at(0, 0), at(1, 0)), "fence-corners"),
    "a corner twice": (fenced(FENCE[0], FENCE[1], FENCE[1], FENCE[2]), "duplicate-corner"),
}


@pytest.mark.parametrize(("data", "found"), REFUSED.values(), ids=REFUSED)
def test_an_invalid_file_is_refused_by_its_codes(data: bytes, found: str) -> None:
    assert codes(data) == found.split()


# -- numbers, counts, sizes
@pytest.mark.parametrize("word", ["NaN", "Infinity", "-Infinity"])
def test_nan_and_infinity_in_json(word: str) -> None:
    text = collection(line()).decode().replace(str(lon_lat(ROUTE)[1][1]), word)
    number = 1 + text[: text.index(word)].count("\n")
    assert codes(text.encode()) == ["json-number"] and place(text.encode()) == f"m:{number}"


def test_nan_and_infinity_in_xml() -> None:
    nan = gpx(f'<rte>{gpx_points("rtept")}<rtept lat="NaN" lon="19.8"/></rte>')
    assert codes(nan) == ["non-finite-coordinate"] and place(nan) == "m:6"


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


def test_huge_files(tmp_path: Path) -> None:
    assert codes(b'{"a": "' + b"x" * (17 << 20) + b'"}') == ["too-large"]
    with (tmp_path / "huge.gpx").open("wb") as file:
        file.truncate(65 << 20)
    with pytest.raises(MissionError, check=coded("mission.too-large")):
        load_mission(tmp_path / "huge.gpx")


# -- text
def test_the_place_in_a_file_that_is_nested_as_deep_as_it_may_be() -> None:
    for depth in range(800, 1000):  # at some depth the reader of the file passes and that of its lines does not
        data = b'{"a":%s%s, "type": "FeatureCollection", "features": [3]}' % (b"[" * depth, b"]" * depth)
        error = refused(data)
        assert error.code in ("mission.geojson-feature", "mission.nesting")
        assert error.problems[0].place in ("m", "m:1")


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


def test_files_cut_off_and_files_that_are_none(tmp_path: Path) -> None:
    data = collection(line())
    assert codes(data[:-20]) == ["not-json"] and place(data[:-20]) == f"m:{1 + data[:-20].count(NEWLINE)}"
    with pytest.raises(MissionError, check=coded("mission.unreadable")):
        load_mission(tmp_path / "none.gpx")
    with pytest.raises(MissionError, check=coded("mission.unreadable")):
        load_mission(tmp_path)


# -- invalid parts of GeoJSON
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


def test_the_name_of_a_mission_is_a_text() -> None:
    data = collection(line(), timberhand={"schema": 1, "options": {}, "name": 5})
    assert (codes(data), place(data)) == (["header"], "m:6")


def test_many_problems_are_counted() -> None:
    away = [at(100 + 3 * i, 0) for i in range(40)]
    error = refused(collection(line(away), polygon()))
    assert len(error.problems) == 10 and 30 in numbers_in(str(error).splitlines()[-1])


# -- swapped axes
def test_one_swapped_waypoint() -> None:
    (problem,) = refused(collection(line([ROUTE[0], SWAPPED_ROUTE[1], ROUTE[2]]))).problems
    assert problem.code == "mission.swapped-axes" and 2 in numbers_in(problem.sentence)


def test_swapped_near_the_diagonal_shows_at_the_fence() -> None:
    """Where latitude and longitude are nearly equal, swapping moves a place by metres only."""
    near = LocalFrame(45.001, 45.0)
    corners = [near.point(*c) for c in ((-40, -40), (40, -40), (40, 40), (-40, 40))]
    way = [near.point(-10, 0), near.point(10, 0)]
    swapped = [Point(p.longitude_deg, p.latitude_deg) for p in way]
    error = refused(collection(line(swapped), polygon(corners)))
    assert error.code == "mission.waypoint-outside-fence" and SWAPPED_HINT in str(error)
    assert good(collection(line(way), polygon(corners)))


def test_a_mission_swapped_as_a_whole_shows_at_the_machines_site() -> None:
    data = collection(line(SWAPPED_ROUTE), polygon([Point(p.longitude_deg, p.latitude_deg) for p in FENCE]))
    assert codes(data, site=(63.657853, 19.895562)) == ["swapped-axes"]
    good(data)  # the file alone is consistent


# -- the fence
def test_waypoint_outside_of_the_fence() -> None:
    (problem,) = refused(collection(line([*ROUTE, at(36, 12)]), polygon())).problems
    assert problem.code == "mission.waypoint-outside-fence"
    assert {4, 6.0} <= set(numbers_in(problem.sentence))


def test_leg_through_a_keep_out() -> None:
    keep_out = polygon([at(-2, -14), at(2, -14), at(2, -10), at(-2, -10)], role="keep-out")
    error = refused(collection(line(), polygon(), keep_out))
    assert error.code == "mission.leg-leaves-fence" and 2.0 in numbers_in(str(error))


def test_the_closing_leg_of_laps_counts() -> None:
    keep_out = polygon([at(-2, -2), at(2, -2), at(2, 2), at(-2, 2)], role="keep-out")
    laps = {"timberhand": {"schema": 1, "options": {"laps": 2}}}
    error = refused(collection(line(), polygon(), keep_out, **laps))
    assert error.code == "mission.leg-leaves-fence" and {3, 1} <= set(numbers_in(str(error)))
    good(collection(line(), polygon(), keep_out))


def test_landing_outside_of_the_fence() -> None:
    landing = feature("Point", lon_lat([at(0, 31)])[0], role="landing")
    error = refused(collection(line(), polygon(), landing))
    assert error.code == "mission.landing-outside-fence" and 6.0 in numbers_in(str(error))


# -- other systems
def test_wrong_datum() -> None:
    crs = {"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::3006"}}
    (problem,) = refused(collection(line(), crs=crs)).problems
    assert (problem.code, problem.place) == ("mission.datum", "m:3")
    for name in ("urn:ogc:def:crs:OGC:1.3:CRS84", "EPSG:4326", "urn:ogc:def:crs:EPSG::4326"):
        good(collection(line(), crs={"type": "name", "properties": {"name": name}}))
    good(collection(line(), crs={"type": "EPSG", "properties": {"code": 4326}}))
    assert codes(collection(line(), crs={"type": "EPSG", "properties": {"code": 3006}})) == ["datum"]


@pytest.mark.parametrize("longitude", [180.0, -180.0, 179.9999, -179.9999])
def test_antimeridian(longitude: float) -> None:
    """A site on the 180th meridian is a site like any other."""
    site = LocalFrame(65.0, longitude)
    ring = [site.point(*c) for c in ((-40, -40), (40, -40), (40, 40), (-40, 40))]
    way = [site.point(-20, 0), site.point(20, 0), site.point(20, 30)]
    draft = good(collection(line(way), polygon(ring)))
    assert len({math.copysign(1, p.longitude_deg) for p in draft.mission.waypoints}) == 2  # it lies on both sides
    assert codes(collection(line([*way, site.point(45, 0)]), polygon(ring)))[0] == "waypoint-outside-fence"


@pytest.mark.parametrize("latitude", [90.0, -90.0, 89.9999])
def test_poles(latitude: float) -> None:
    site = LocalFrame(latitude, 0.0)
    ring = [site.point(*c) for c in ((-40, -40), (40, -40), (40, 40), (-40, 40))]
    way = [site.point(-20, -5), site.point(20, -5), site.point(20, 30)]
    good(collection(line(way), polygon(ring)))
    assert codes(collection(line([*way, site.point(45, 0)]), polygon(ring)))[0] == "waypoint-outside-fence"


# -- waypoints
def test_duplicated_waypoints() -> None:
    (problem,) = refused(collection(line([ROUTE[0], ROUTE[1], ROUTE[1], ROUTE[2]]))).problems
    assert problem.code == "mission.duplicate-waypoint" and 3 in numbers_in(problem.sentence)
    good(collection(line([*ROUTE, ROUTE[0]])))  # a closed lap has none


@pytest.mark.parametrize("role", [{}, {"role": None}, {"role": ""}], ids=["none", "null", "empty"])
def test_a_point_beside_a_route_is_a_note(role: dict[str, str | None]) -> None:
    draft = good(collection(line(**role), feature("Point", lon_lat(ROUTE)[0], **role)))
    assert [numbers_in(note) for note in draft.notes] == [[1]]
