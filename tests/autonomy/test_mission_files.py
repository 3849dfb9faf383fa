"""Mission files that are refused, and what a mission lacks of its file: a note, or a warning if the drive changes."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest

from autonomy.missions import gpx_kml, xml_tree
from autonomy.missions.features import Draft
from autonomy.missions.local_frame import LocalFrame
from autonomy.missions.mission_file import load_mission
from autonomy.missions.model import MissionError, Point
from autonomy.missions.validation import SWAPPED_HINT
from tests.autonomy.mission_checks import assert_route, codes, good, peak_bytes, place, refused
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


def spot(role: str, north_m: float, **properties: Any) -> dict[str, Any]:
    return feature("Point", lon_lat([at(0, north_m)])[0], role=role, **properties)


def log(**properties: float) -> bytes:
    return collection(line(), spot("log", -9, **properties))


def headed(*features: dict[str, Any], **options: object) -> bytes:
    return collection(line(), *features, timberhand={"schema": 1, "options": options})


def block(north_m: float) -> dict[str, Any]:
    """A square of 4 m that is kept out."""
    return polygon([at(-2, north_m - 2), at(2, north_m - 2), at(2, north_m + 2), at(-2, north_m + 2)], role="keep-out")


def route(old: str = "", new: str = "") -> bytes:
    """A GPX route with one change."""
    return gpx(f"<rte>{gpx_points('rtept')}</rte>").decode().replace(old, new, 1).encode()


def crs(kind: str, **properties: object) -> bytes:
    return collection(line(), crs={"type": kind, "properties": properties})


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
    "cut off XML": (route()[:-8], "not-xml"),
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


TWICE = [*ROUTE, ROUTE[2]]
KML_TWICE = f"<Placemark><LineString><coordinates>\n{kml_coordinates(TWICE)}\n</coordinates></LineString></Placemark>"
OUTSIDE = collection(line([*ROUTE, at(36, 12)]), polygon())
PLACED = {
    "NaN in a GPX": (route("</rte>", '<rtept lat="NaN" lon="19.8"/></rte>'), "non-finite-coordinate", 6),
    "a blank before the XML": (route("<?xml", "\n <?xml"), "xml-start", 2),
    "an unknown prefix": (route("<rte>", "<rte><a:x/>"), "xml-prefix", 3),
    "an entity of HTML": (route("<rte>", "<rte><name>Ca&ntilde;on</name>"), "xml-entity", 3),
    "a bare ampersand": (route("<rte>", "<rte><name>a & b</name>"), "not-xml", 3),
    "a number as name": (collection(line(), timberhand={"schema": 1, "options": {}, "name": 5}), "header", 6),
    "another datum": (crs("name", name="urn:ogc:def:crs:EPSG::3006"), "datum", 3),
    "the fourth position of a line": (OUTSIDE, "waypoint-outside-fence", 22),
    "a waypoint twice in a GPX": (gpx(f"<rte>\n{gpx_points('rtept', TWICE)}</rte>"), "duplicate-waypoint", 7),
    "a waypoint twice in a KML": (kml(KML_TWICE), "duplicate-waypoint", 8),
}


@pytest.mark.parametrize(("data", "code", "number"), PLACED.values(), ids=PLACED)
def test_a_problem_names_the_line_on_which_its_part_begins(data: bytes, code: str, number: int) -> None:
    assert codes(data) == [code] and place(data) == f"m:{number}"


TOLD = {
    "one swapped waypoint": (collection(line([ROUTE[0], SWAPPED_ROUTE[1], ROUTE[2]])), "swapped-axes", {2}),
    "a waypoint outside of the fence": (OUTSIDE, "waypoint-outside-fence", {4, 6.0}),
    "a landing outside": (
        collection(line(), polygon(), spot("landing", 31)),
        "landing-outside-fence",
        {6.0},
    ),
    "a leg through a keep-out": (collection(line(), polygon(), block(-12)), "leg-leaves-fence", {2.0}),
    "the closing leg of laps": (headed(polygon(), block(0), laps=2), "leg-leaves-fence", {3, 1}),
    "a waypoint twice": (collection(line([ROUTE[0], ROUTE[1], ROUTE[1], ROUTE[2]])), "duplicate-waypoint", {3}),
}


@pytest.mark.parametrize(("data", "code", "numbers"), TOLD.values(), ids=TOLD)
def test_a_problem_is_told_with_its_numbers(data: bytes, code: str, numbers: set[float]) -> None:
    (problem,) = refused(data).problems
    assert problem.code == f"mission.{code}" and numbers <= set(numbers_in(problem.sentence))


def test_a_lap_may_be_closed_and_only_laps_have_a_closing_leg() -> None:
    good(collection(line([*ROUTE, ROUTE[0]])))
    good(collection(line(), polygon(), block(0)))


# -- numbers, counts, sizes
@pytest.mark.parametrize("word", ["NaN", "Infinity", "-Infinity"])
def test_nan_and_infinity_in_json(word: str) -> None:
    text = collection(line()).decode().replace(str(lon_lat(ROUTE)[1][1]), word)
    number = 1 + text[: text.index(word)].count("\n")
    assert codes(text.encode()) == ["json-number"] and place(text.encode()) == f"m:{number}"


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
    (code,), most = peak_bytes(data)
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
    for data in (collection(line()), route()):
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
    data = route()
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
    log, landing = spot("log", -9, assortment="veneer"), spot("landing", 9, assortments=["pulpwood"])
    sort = {"sort_by_assortment": True, "logs": "listed"}
    assert codes(headed(log, landing, **sort)) == ["assortment-without-landing"]
    sort["assortments"] = ["pulpwood"]
    good(headed(log, landing, **sort))  # the log is left
    assert codes(headed(log, **sort)) == ["sorting-without-landing"]


@pytest.mark.parametrize("option", [{"sort_by_assortment": True}, {"assortments": ["pulpwood"]}], ids=str)
def test_selecting_needs_logs_with_an_assortment(option: dict[str, object]) -> None:
    log, landing = spot("log", -9), spot("landing", 9)
    searched = headed(log, landing, **option)
    assert codes(searched) == ["assortments-not-listed"] and place(searched) == "m"
    assert codes(headed(log, landing, **option, logs="listed")) == ["logs-without-assortment"]
    good(headed(landing, **option, logs="listed"))  # a harvester's file may add the logs


def test_many_problems_are_counted() -> None:
    away = [at(100 + 3 * i, 0) for i in range(40)]
    error = refused(collection(line(away), polygon()))
    assert len(error.problems) == 10 and 30 in numbers_in(str(error).splitlines()[-1])


# -- swapped axes
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


# -- other systems
@pytest.mark.parametrize("name", ["urn:ogc:def:crs:OGC:1.3:CRS84", "EPSG:4326", "urn:ogc:def:crs:EPSG::4326"])
def test_the_names_of_wgs84(name: str) -> None:
    good(crs("name", name=name))


def test_the_number_of_a_datum() -> None:
    good(crs("EPSG", code=4326))
    assert codes(crs("EPSG", code=3006)) == ["datum"]


@pytest.mark.parametrize(
    ("latitude", "longitude"),
    [(65.0, 180.0), (65.0, -180.0), (65.0, 179.9999), (65.0, -179.9999), (90.0, 0.0), (-90.0, 0.0), (89.9999, 0.0)],
)
def test_a_site_on_the_antimeridian_or_at_a_pole_is_a_site_like_any_other(latitude: float, longitude: float) -> None:
    site = LocalFrame(latitude, longitude)
    ring = [site.point(*c) for c in ((-40, -40), (40, -40), (40, 40), (-40, 40))]
    way = [site.point(-20, -5), site.point(20, -5), site.point(20, 30)]
    draft = good(collection(line(way), polygon(ring)))
    assert len({math.copysign(1, p.longitude_deg) for p in draft.mission.waypoints}) == 2  # it lies on both sides
    assert codes(collection(line([*way, site.point(45, 0)]), polygon(ring)))[0] == "waypoint-outside-fence"


@pytest.mark.parametrize("role", [{}, {"role": None}, {"role": ""}], ids=["none", "null", "empty"])
def test_a_point_beside_a_route_is_a_note(role: dict[str, str | None]) -> None:
    draft = good(collection(line(**role), feature("Point", lon_lat(ROUTE)[0], **role)))
    assert [numbers_in(note) for note in draft.notes] == [[1]]


# -- notes and warnings
def warned(draft: Draft) -> list[str]:
    """The codes of the warnings of a file."""
    return [problem.code for problem in draft.warnings]


def track(parts: list[list[Point]]) -> bytes:
    """A GPX track of segments."""
    return gpx("<trk>" + "".join(f"<trkseg>{gpx_points('trkpt', part)}</trkseg>" for part in parts) + "</trk>")


# -- GPX
def test_a_gap_between_the_segments_of_a_track() -> None:
    draft = good(track([ROUTE[:1], ROUTE[1:2], ROUTE[2:]]))
    assert_route(draft.mission)
    (gap,) = draft.warnings
    assert gap.code == "mission.track-gap" and gap.place == "m:4"  # the widest one ends here
    assert numbers_in(gap.sentence)[:2] == [3, 36]


def test_segments_that_go_on_where_the_one_before_ended() -> None:
    draft = good(track([ROUTE[:2], [at(18, -9), *ROUTE[2:]]]))
    assert warned(draft) == [] and len(draft.mission.waypoints) == 4


def test_an_empty_route_does_not_hide_the_track() -> None:
    draft = good(gpx(f"<rte/><trk><trkseg>{gpx_points('trkpt')}</trkseg></trk>"))
    assert_route(draft.mission)
    assert len(draft.notes) == 1
    assert codes(gpx("<rte/><trk><trkseg/></trk>")) == ["no-waypoints"]


def test_a_route_of_one_point_does_not_hide_the_track() -> None:
    start, way = f"<rte>{gpx_points('rtept', ROUTE[:1])}</rte>", f"<trk><trkseg>{gpx_points('trkpt')}</trkseg></trk>"
    draft = good(gpx(start + way))
    assert_route(draft.mission)
    assert len(draft.notes) == 1
    assert len(good(gpx(start)).mission.waypoints) == 1
    assert len(good(gpx(start + way.replace(gpx_points("trkpt"), gpx_points("trkpt", ROUTE[:1])))).notes) == 1


def test_a_route_of_one_point_is_the_route_and_waypoints_beside_it_are_not() -> None:
    draft = good(gpx(gpx_points("wpt", ROUTE[1:]) + f"<rte>{gpx_points('rtept', ROUTE[:1])}</rte>"))
    assert len(draft.mission.waypoints) == 1 and numbers_in(draft.notes[0]) == [len(ROUTE) - 1]


def test_points_between_those_of_a_route_are_a_warning() -> None:
    """Garmin's programs write the way along roads into extensions, and only its corners as route points."""
    between = '<extensions><g:RoutePointExtension xmlns:g="u"><g:rpt lat="1" lon="2"/><g:rpt lat="1" lon="2"/>'
    between += "</g:RoutePointExtension></extensions>"
    data = gpx(f"<rte>{gpx_points('rtept').replace('/>', f'>{between}</rtept>', 1)}</rte>")
    draft = good(data)
    assert_route(draft.mission)
    assert warned(draft) == ["gpx.points-between"] and numbers_in(draft.warnings[0].sentence) == [2]


# -- KML
def gx_track(points: list[Point] = ROUTE) -> str:
    """A track as Google Earth writes it, without the placemark."""
    coords = "".join(f"<gx:coord>{p.longitude_deg!r} {p.latitude_deg!r} 180</gx:coord>" for p in points)
    return (
        f'<gx:Track xmlns:gx="http://www.google.com/kml/ext/2.2"><when>2024-05-01T08:00:00Z</when>{coords}</gx:Track>'
    )


def test_a_gx_track_is_the_route_and_a_point_beside_it_is_none() -> None:
    start = f"<Placemark><Point><coordinates>{kml_coordinates(ROUTE[:1])}</coordinates></Point></Placemark>"
    draft = good(kml(f"{start}<Placemark>{gx_track()}</Placemark>"))
    assert_route(draft.mission)
    assert len(draft.notes) == 1 and warned(draft) == []


def test_a_gx_multi_track_with_a_gap_and_a_fix_that_was_lost() -> None:
    both = gx_track(ROUTE[:2]).replace("</gx:Track>", "<gx:coord/></gx:Track>") + gx_track(ROUTE[2:])
    multi = f'<gx:MultiTrack xmlns:gx="http://www.google.com/kml/ext/2.2">{both}</gx:MultiTrack>'
    draft = good(kml(f"<Placemark>{multi}</Placemark>"))
    assert_route(draft.mission)
    assert warned(draft) == ["mission.track-gap"] and numbers_in(draft.warnings[0].sentence)[:2] == [2, 24]


def test_invalid_gx_tracks() -> None:
    assert codes(kml(f"<Placemark>{gx_track().replace(' 180', ' 180 0', 1)}</Placemark>")) == ["kml.position"]
    assert codes(kml(f"<Placemark>{gx_track().replace(' 180', 'x 180', 1)}</Placemark>")) == ["number"]


def test_parts_of_kml_that_are_not_read() -> None:
    way = f"<Placemark><LineString><coordinates>{kml_coordinates()}</coordinates></LineString></Placemark>"
    draft = good(kml(f"{way}<GroundOverlay/><GroundOverlay/><Folder><NetworkLink/></Folder>"))
    assert [numbers_in(note) for note in draft.notes] == [[2]]
    assert warned(draft) == ["kml.network-link"]


# -- fences
def test_several_keep_in_fences_are_said_to_be_alternatives() -> None:
    inner = [at(-25, -20), at(25, -20), at(25, 20), at(-25, 20)]
    draft = good(collection(line(), polygon(FENCE), polygon(inner)))
    assert [numbers_in(note) for note in draft.notes] == [[2]]
    assert (
        good(collection(line(), polygon(FENCE), polygon([at(0, 0), at(3, 0), at(3, 3)], role="keep-out"))).notes == []
    )


# -- QGroundControl plans: speeds, frames, fences
def simple(command: int, params: list[float], frame: int = 2) -> dict[str, Any]:
    return {"type": "SimpleItem", "command": command, "frame": frame, "params": params}


def speed(value: float, kind: int = 1) -> dict[str, Any]:
    """A DO_CHANGE_SPEED."""
    return simple(178, [kind, value, -1, 0, 0, 0, 0])


A, B, C = map(item, ROUTE)
SEVERAL, KIND = "plan.several-speeds", "plan.speed-type"


@pytest.mark.parametrize(
    ("items", "speed_m_s", "warned"),
    [
        ([A, B, C], None, []),
        ([speed(0.5), A, B, C], 0.5, []),
        ([A, speed(0.5), B, C], 0.5, []),
        ([speed(-1), A, B, C], None, []),
        ([speed(0.5), A, B, speed(-1), C], 0.5, []),
        ([speed(2.0), A, speed(0.5), B, C], 0.5, []),
        ([speed(0.9), A, B, speed(0.3), C], 0.3, [SEVERAL]),
        ([A, B, speed(0.3), C], 0.3, [SEVERAL]),
        ([speed(0.5), A, B, speed(-2), C], 0.5, [SEVERAL]),
        ([speed(0.5), A, B, C, speed(0.1)], 0.5, []),
        ([speed(0.5, 0), A, B, C], None, [KIND]),
        ([speed(0.5) | {"params": [1, 0.5, -1, 1, 0, 0, 0]}, A, B, C], None, [KIND]),  # relative to the speed before
        ([speed(0.5) | {"params": [1, None, -1, 0, 0, 0, 0]}, A, B, C], None, [KIND]),
        ([speed(0.5) | {"params": [1, "0.5"]}, A, B, C], None, [KIND]),
        ([speed(0.5) | {"params": [1]}, A, B, C], None, [KIND]),
        ([{"type": "SimpleItem", "command": 178}, A, B, C], None, [KIND]),
    ],
)
def test_speeds(items: list[dict[str, Any]], speed_m_s: float | None, warned: list[str]) -> None:
    draft = good(plan(items))
    assert draft.mission.options.speed_m_s == speed_m_s
    assert [problem.code for problem in draft.warnings] == warned


def test_a_speed_that_is_none_is_refused() -> None:
    assert codes(plan([speed(0.0), A, B, C])) == ["option-range"]


@pytest.mark.parametrize(("frame", "refused"), [(0, False), (3, False), (1, True), (2, True), (8, True), ("x", True)])
def test_the_frame_of_a_waypoint(frame: object, refused: bool) -> None:
    data = plan([A, B | {"frame": frame}, C])
    if refused:
        assert codes(data) == ["plan.frame"]
    else:
        good(data)


@pytest.mark.parametrize(("firmware", "warned"), [(3, ["plan.several-fences"]), (12, [])])
def test_several_keep_in_fences(firmware: int, warned: list[str]) -> None:
    inner = [at(-25, -20), at(25, -20), at(25, 20), at(-25, 20)]
    rings = [[[p.latitude_deg, p.longitude_deg] for p in ring] for ring in (FENCE, inner)]
    polygons = [{"inclusion": True, "polygon": ring} for ring in rings]
    data = plan([A, B, C], polygons=polygons).replace(b'"items"', b'"firmwareType": %d, "items"' % firmware, 1)
    draft = good(data)
    assert [problem.code for problem in draft.warnings] == warned and len(draft.notes) == 1


@pytest.mark.parametrize("inclusion", ["false", "true", None, 2, []])
def test_a_fence_that_does_not_say_its_side_is_refused(inclusion: object) -> None:
    ring = [[p.latitude_deg, p.longitude_deg] for p in FENCE]
    assert codes(plan([A, B, C], polygons=[{"inclusion": inclusion, "polygon": ring}])) == ["plan.geofence"]


def test_a_part_of_the_fence_that_is_not_read_is_a_warning() -> None:
    data = plan([A, B, C], circle={"center": [0, 0], "radius": 9}, future=[1], empty=[], breachReturn=[1, 2, 3])
    assert [problem.code for problem in good(data).warnings] == ["plan.geofence-part"] * 2


WAIT = A | {"params": [5, *A["params"][1:]]}


@pytest.mark.parametrize(
    ("extra", "warned", "noted"),
    [
        ([], 0, 0),
        ([item(ROUTE[0], 22)], 0, 1),  # a take-off
        ([item(at(0, 0), 19)], 1, 0),  # a loiter
        ([item(at(0, 0), 19), item(at(1, 0), 19), item(at(1, 0), 20)], 2, 0),  # and the way home
        ([simple(177, [1, 3, 0, 0, 0, 0, 0])], 1, 0),  # a jump
        ([simple(112, [9, 0, 0, 0, 0, 0, 0])], 1, 0),  # a delay
        ([simple(206, [9, 0, 0, 0, 0, 0, 0])], 0, 1),  # a camera
        ([{"type": "ComplexItem", "complexItemType": "survey"}], 1, 0),
        ([simple(5001, [4, 0, 0, 0, 1, 2, 0], 3)], 1, 0),  # a fence's corner
        ([WAIT], 1, 0),
        ([A | {"autoContinue": False}], 1, 0),
        ([{"type": "SimpleItem", "command": "x" * 999}, {"type": "SimpleItem", "command": None}], 0, 2),
    ],
)
def test_items_that_are_no_waypoints(extra: list[dict[str, Any]], warned: int, noted: int) -> None:
    draft = good(plan([*extra, *([] if extra[:1] and extra[0].get("command") == 16 else [A]), B, C]))
    assert [problem.code for problem in draft.warnings] == ["plan.not-driven"] * warned and len(draft.notes) == noted
    assert len(draft.mission.waypoints) == 3
