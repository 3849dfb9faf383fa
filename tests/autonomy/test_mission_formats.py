"""The content of every mission file format, plain and packed; and any mission that is written is read back."""

from __future__ import annotations

import gzip
import io
import json
import math
import xml.etree.ElementTree as ET
import zipfile
import zlib
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from autonomy.missions import geojson, source
from autonomy.missions.export import FORMATS, export
from autonomy.missions.fpr import ForwardedLoad, ForwardedLog, Forwarder, write_fpr
from autonomy.missions.local_frame import LocalFrame
from autonomy.missions.mission_file import load_mission, read, save_mission, verify
from autonomy.missions.model import Fence, ForwardingMission, KnownLog, Landing, MissionError, Options, Point
from autonomy.missions.validation import SWAPPED_HINT
from tests.autonomy.mission_checks import EXAMPLES, assert_route, codes, good, peak_bytes, place
from tests.autonomy.mission_texts import (
    FENCE,
    ROUTE,
    SITE,
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
)
from tests.codes import coded, numbers_in

TRACK = "".join(f"<trkseg>{gpx_points('trkpt', part)}</trkseg>" for part in (ROUTE[:2], ROUTE[2:]))
MEETING = "".join(f"<trkseg>{gpx_points('trkpt', part)}</trkseg>" for part in (ROUTE[:2], ROUTE[1:]))
TRACKS = "".join(
    f"<Track>{''.join(f'<coord>{p.longitude_deg!r} {p.latitude_deg!r} 0</coord>' for p in part)}</Track>"
    for part in (ROUTE[:2], ROUTE[1:])
)
PLACES = "".join(
    f"<Placemark><Point><coordinates>{kml_coordinates([p])}</coordinates></Point></Placemark>" for p in ROUTE
)
WAY = f"<Placemark><LineString><coordinates>{kml_coordinates()}</coordinates></LineString></Placemark>"
KML = kml(WAY)
RING = f"<LinearRing><coordinates>{kml_coordinates([*FENCE, FENCE[0]])}</coordinates></LinearRing>"
EMPTY_HOLE = "<innerBoundaryIs><LinearRing><coordinates/></LinearRing></innerBoundaryIs>"
GPX = gpx(f"<rte>{gpx_points('rtept')}</rte>")
SAME = {
    "line": collection(line()),
    "points": collection(*(feature("Point", p) for p in lon_lat(ROUTE))),
    "multipoint": collection(feature("MultiPoint", lon_lat(ROUTE), role="waypoint")),
    "bare geometry": b'{"type": "LineString", "coordinates": %s}' % str(lon_lat(ROUTE)).encode(),
    "plan": plan([item(p) for p in ROUTE]),
    "gpx route": GPX,
    "gpx track": gpx(f"<trk>{TRACK}</trk>"),
    "gpx segments that meet": gpx(f"<trk>{MEETING}</trk>"),
    "kml segments that meet": kml(f"<Placemark><MultiTrack>{TRACKS}</MultiTrack></Placemark>"),
    "gpx waypoints": gpx(gpx_points("wpt")),
    "kml line": KML,
    "kml points": kml(f"<Folder>{PLACES}</Folder>"),
}


@pytest.mark.parametrize("data", SAME.values(), ids=SAME)
def test_every_format_gives_the_same_route(data: bytes) -> None:
    mission = good(data).mission
    assert_route(mission)
    assert all(p.altitude_m is None for p in mission.waypoints)


def test_paper_bs_mission_is_the_field_of_fig_12() -> None:
    mission = load_mission(EXAMPLES / "paper_b.geojson", site=(63.657853, 19.895562)).mission
    corners = SITE.points_enu(mission.waypoints)
    assert corners[:, :2] == pytest.approx(np.array([(-20, -15), (20, -15), (20, 15), (-20, 15)]), abs=1e-3)
    assert len(mission.logs) * mission.options.laps == 24
    assert {(log.length_m, log.diameter_m, log.species) for log in mission.logs} == {(2.0, 0.25, "birch")}
    beside = SITE.points_enu([log.position for log in mission.logs])
    assert abs(beside[:, 0]).max() < 20.0 - 6.3  # on the straight part of the long sides
    assert (abs(abs(beside[:, 1]) - 15.0) > 1.8).all() and (abs(abs(beside[:, 1]) - 15.0) < 4.0).all()


@pytest.mark.parametrize("name", ["route.plan", "route.gpx", "site.kml"])
def test_the_shipped_examples_hold_the_same_route(name: str) -> None:
    corners = SITE.points_enu(load_mission(EXAMPLES / name).mission.waypoints)
    assert corners[:, :2] == pytest.approx(np.array([(-18, -12), (18, -12), (18, 12)]), abs=2e-3)


def test_a_plan_has_speed_and_fences_and_notes_on_ignored_items() -> None:
    circle = {"circle": {"center": [SITE.latitude_deg, SITE.longitude_deg], "radius": 4.0}, "inclusion": False}
    ring = {"inclusion": True, "polygon": [[p.latitude_deg, p.longitude_deg] for p in FENCE]}
    speed = {"type": "SimpleItem", "command": 178, "params": [1, 0.5, -1, 0, 0, 0, 0]}
    items = [speed, item(ROUTE[0], 22), *map(item, ROUTE), {"type": "ComplexItem", "complexItemType": "survey"}]
    draft = good(plan(items, polygons=[ring], circles=[circle]))
    assert draft.mission.options == Options(speed_m_s=0.5)
    assert [fence.keep_out for fence in draft.mission.fences] == [False, True]
    away = [math.hypot(*e) for e in SITE.points_enu(draft.mission.fences[1].corners)[:, :2]]
    assert min(away) * math.cos(math.pi / 48) == pytest.approx(4.0)  # the polygon goes round the circle
    assert [note.split()[:3] for note in draft.notes] == [["1", "×", "command"]]
    assert [problem.code for problem in draft.warnings] == ["plan.not-driven"]  # the survey


def test_a_hole_keeps_out_and_rings_run_counter_clockwise() -> None:
    hole = [at(-3, -3), at(-3, 3), at(3, 3), at(3, -3)]
    turned = [FENCE[0], *reversed(FENCE[1:])]
    rings = [lon_lat([*ring, ring[0]]) for ring in (turned, hole)]
    mission = good(collection(line(), feature("Polygon", rings))).mission
    assert [fence.keep_out for fence in mission.fences] == [False, True]
    assert [p.longitude_deg for p in mission.fences[0].corners] == [p.longitude_deg for p in FENCE]


def test_a_fence_stays_where_a_hole_of_it_is_empty() -> None:
    drawn = collection(line(), feature("Polygon", [lon_lat([*FENCE, FENCE[0]]), []]))
    outer = f"<outerBoundaryIs>{RING}</outerBoundaryIs>"
    for data in (drawn, kml(f"{WAY}<Placemark><Polygon>{outer}{EMPTY_HOLE}</Polygon></Placemark>")):
        assert [(len(fence.corners), fence.keep_out) for fence in good(data).mission.fences] == [(4, False)]


def test_empty_features_are_counted_in_one_note() -> None:
    nothing = {"type": "Feature", "properties": {}, "geometry": None}
    drawn = collection(line(), *[nothing] * 40, *[feature("Polygon", [])] * 30)
    assert [numbers_in(note) for note in good(drawn).notes] == [[40], [30]]
    point = "<Placemark><Point><coordinates/></Point></Placemark>"
    assert [numbers_in(note) for note in good(kml(WAY + 20 * point)).notes] == [[20]]


def test_a_hole_in_nothing_is_no_fence() -> None:
    hole = f"<innerBoundaryIs>{RING}</innerBoundaryIs>"
    draft = good(kml(f"{WAY}<Placemark><Polygon>{hole}</Polygon></Placemark>"))
    assert draft.mission.fences == () and len(draft.notes) == 1


def test_a_log_may_be_drawn_by_its_ends() -> None:
    log = good(collection(line(), line([at(4, 3), at(4, 7)], role="log", diameter_m=0.2))).mission.logs[0]
    assert (log.bearing_deg, log.length_m) == (pytest.approx(0.0, abs=1e-3), pytest.approx(4.0, abs=1e-6))
    assert SITE.points_enu([log.position])[0][:2] == pytest.approx((4.0, 5.0), abs=1e-4)


def test_kml_data_and_gpx_types_give_the_role_of_a_point() -> None:
    values = {"role": "landing", "assortments": "a, b"}
    pairs = "".join(f'<Data name="{key}"><value>{value}</value></Data>' for key, value in values.items())
    data = f"<ExtendedData>{pairs}</ExtendedData>"
    point = f"<Point><coordinates>{kml_coordinates([at(20, 15)])}</coordinates></Point>"
    mission = good(kml(f"<Placemark><name>Road</name>{data}{point}</Placemark>{WAY}")).mission
    assert (mission.landings[0].name, mission.landings[0].assortments) == ("Road", ("a", "b"))
    wpt = f'<wpt lat="{at(4, 3).latitude_deg}" lon="{at(4, 3).longitude_deg}"><name>7</name><type>log</type></wpt>'
    mission = good(gpx(f"{wpt}<rte>{gpx_points('rtept')}</rte>")).mission
    assert [log.key for log in mission.logs] == ["7"]


def test_a_saved_mission_is_read_back(tmp_path: Path) -> None:
    mission = load_mission(EXAMPLES / "site.kml", logs=EXAMPLES / "harvest.hpr").mission
    save_mission(tmp_path / "m.geojson", mission)
    assert load_mission(tmp_path / "m.geojson").mission == mission
    with pytest.raises(MissionError, check=coded("mission.not-written")):
        save_mission(tmp_path / "none" / "m.geojson", mission)


def test_what_is_added_from_a_file_of_logs(tmp_path: Path) -> None:
    way, added = tmp_path / "way.geojson", tmp_path / "logs.geojson"
    way.write_bytes(collection(line()))
    spot, landing = lon_lat([at(4, 3), at(8, 3)])
    for features, logs, warned, notes in (
        ([feature("Point", spot)], 0, ["mission.no-logs-added"], 0),
        ([feature("Point", spot, role="log")], 1, [], 0),
        ([feature("Point", spot, role="log"), feature("Point", landing, role="landing")], 1, [], 1),
    ):
        added.write_bytes(collection(*features))
        draft = load_mission(way, logs=added)
        assert len(draft.mission.logs) == logs and draft.mission.landings == ()
        assert ([problem.code for problem in draft.warnings], len(draft.notes)) == (warned, notes)


def test_altitude_present_and_absent() -> None:
    heights = [[*p, 12.5] for p in lon_lat(ROUTE)]
    mission = good(collection(feature("LineString", heights))).mission
    assert [p.altitude_m for p in mission.waypoints] == [12.5] * 3
    mixed = [heights[0], heights[1][:2], [*heights[2][:2], None]]
    mission = good(collection(feature("LineString", mixed))).mission
    assert [p.altitude_m for p in mission.waypoints] == [12.5, None, None]
    assert codes(collection(feature("LineString", [[*p, 1e5] for p in lon_lat(ROUTE)]))) == ["height-range"] * 3


# -- zip and gzip files
HPR = (EXAMPLES / "harvest.hpr").read_bytes()
BOMB = 1 << 27


def zipped(files: dict[str, bytes], method: int = zipfile.ZIP_DEFLATED) -> bytes:
    made = io.BytesIO()
    with zipfile.ZipFile(made, "w", method) as archive:
        for name, data in files.items():
            archive.writestr(name, data)
    return made.getvalue()


@pytest.mark.parametrize("method", [zipfile.ZIP_DEFLATED, zipfile.ZIP_STORED])
def test_a_zip_file_with_one_mission(method: int) -> None:
    plain, packed = read(HPR, "m"), read(zipped({"harvest.hpr": HPR}, method), "m")
    assert packed.mission == plain.mission and packed.notes == plain.notes and packed.format == plain.format


def test_a_kmz_with_pictures_and_linked_files() -> None:
    beside = {"files/": b"", "files/icon.png": b"\x89PNG", "__MACOSX/._doc.kml": b"x"}
    draft = good(zipped(beside | {"files/more.kml": KML, "doc.kml": KML}))
    assert_route(draft.mission)
    assert len(draft.notes) == 1 and draft.notes[0].startswith("2 ")


@pytest.mark.parametrize("data", [collection(line()), GPX, KML, collection(line()).decode().encode("utf-16")])
def test_gzip(data: bytes) -> None:
    assert_route(good(gzip.compress(data)).mission)
    half = len(data) // 2
    assert_route(good(gzip.compress(data[:half]) + gzip.compress(data[half:]) + bytes(512)).mission)


def test_the_place_of_a_problem_names_the_file_inside() -> None:
    wrong = GPX.replace(b'lat="', b'lat="x', 1)
    assert codes(zipped({"a\nb.gpx": wrong})) == ["number"] and place(zipped({"a\nb.gpx": wrong})) == "m/a b.gpx:3"
    assert place(gzip.compress(wrong)) == "m:3"


ARCHIVES = {
    "no file": zipped({}),
    "no mission": zipped({"readme.txt": b"x"}),
    "two missions": zipped({"a.hpr": HPR, "b.hpr": HPR}),
    "another method": zipped({"a.hpr": HPR}, zipfile.ZIP_LZMA),
    "a zip in a zip": zipped({"a.kml": zipped({"doc.kml": KML})}, zipfile.ZIP_STORED),
    "a gzip in a zip": zipped({"a.kml": gzip.compress(KML)}),
    "encrypted": zipped({"a.hpr": HPR}).replace(b"\x14\x00\x00\x00\x08\x00", b"\x14\x00\x01\x00\x08\x00"),
    "many files": zipped(
        {f"{i}.txt": b"" for i in range(source.MAX_PACKED + 1)} | {"doc.kml": KML}, zipfile.ZIP_STORED
    ),
    "a rest after it": gzip.compress(HPR) + b"rest",
    "a gzip in a gzip": gzip.compress(gzip.compress(HPR)),
    "a gzip of every byte": b"".join(gzip.compress(bytes((c,))) for c in GPX),
}
DAMAGED = {
    "a zip's first letters": b"PK",
    "a zip cut off": zipped({"a.hpr": HPR})[:-30],
    "another letter inside": zipped({"a.hpr": HPR}, zipfile.ZIP_STORED).replace(b"Latitude", b"Latitudo", 1),
    "a gzip cut off": gzip.compress(HPR)[:-9],
    "another length": gzip.compress(HPR)[:-1] + b"\1",
    "a gzip's first bytes": b"\x1f\x8b",
}


@pytest.mark.parametrize("data", ARCHIVES.values(), ids=ARCHIVES)
def test_whole_archives_that_are_refused(data: bytes) -> None:
    assert codes(data) == ["archive"]


@pytest.mark.parametrize("data", DAMAGED.values(), ids=DAMAGED)
def test_damaged_archives_are_said_to_be_damaged(data: bytes) -> None:
    assert codes(data) == ["archive-damaged"]


@pytest.mark.parametrize("kind", ["zip", "gzip", "lie"])
def test_a_bomb_costs_no_more_than_the_largest_mission(kind: str) -> None:
    if kind == "gzip":
        packer = zlib.compressobj(9, wbits=31)
        data = b"".join(packer.compress(bytes(1 << 20)) for _ in range(BOMB >> 20)) + packer.flush()
    else:
        data = zipped({"doc.kml": bytes(BOMB)})
    if kind == "lie":  # of its size, in the entry and in the directory
        for at in (22, data.rindex(b"PK\x01\x02") + 24):
            assert data[at : at + 4] == BOMB.to_bytes(4, "little")
            data = data[:at] + (1000).to_bytes(4, "little") + data[at + 4 :]
    (code,), peak = peak_bytes(data)
    assert code == ("archive-damaged" if kind == "lie" else "too-large") and peak < 2.5 * source.MAX_XML_BYTES


# -- any mission, and any report
TEXT = st.text(st.characters(exclude_categories=["Cs"]), max_size=12)
METRES = st.floats(-2000.0, 2000.0)


def maybe(strategy: st.SearchStrategy[Any]) -> st.SearchStrategy[Any]:
    """A value or None."""
    return st.one_of(st.none(), strategy)


HEIGHTS = maybe(st.floats(-50.0, 3000.0))
FRAMES = st.builds(
    LocalFrame,
    st.floats(-90.0, 90.0) | st.sampled_from([90.0, -90.0, 0.0]),
    st.floats(-180.0, 180.0) | st.sampled_from([180.0, -180.0]),
)


@st.composite
def missions(
    draw: st.DrawFn, text=TEXT, kinds=TEXT, heights=HEIGHTS, frames=FRAMES, least: int = 1
) -> ForwardingMission:
    """A mission that can be driven, anywhere on Earth, poles and antimeridian included."""
    frame = draw(frames)

    def place(east: float, north: float) -> Point:
        at = frame.point(east, north)
        return Point(at.latitude_deg, at.longitude_deg, draw(heights))

    count = draw(st.integers(least, 6))
    way = [place(draw(METRES), 40.0 * i) for i in range(count)]
    fences = []
    if draw(st.booleans()):
        angles = np.linspace(0.0, 2 * np.pi, draw(st.integers(8, 20)), endpoint=False)
        fences = [Fence(tuple(place(4000 * np.cos(a), 4000 * np.sin(a)) for a in angles), False, draw(text))]
        hole = [place(*c) for c in ((3000, 0), (3100, 0), (3100, 90), (3000, 90))]
        fences += [Fence(tuple(hole), True, draw(text))] if draw(st.booleans()) else []
    logs = [
        KnownLog(
            place(draw(METRES), draw(METRES)),
            draw(text),
            draw(maybe(st.floats(0.0, 360.0))),
            draw(maybe(st.floats(2.1, 10.0))),
            draw(maybe(st.floats(0.05, 1.0))),
            draw(text),
            draw(text),
            draw(maybe(st.integers(1, 10**6))),
            draw(maybe(st.floats(0.0, 20.0))),
        )
        for _ in range(draw(st.integers(0, 4)))
    ]
    landings = [
        Landing(
            place(draw(METRES), draw(METRES)),
            draw(text),
            draw(maybe(st.floats(0.0, 360.0))),
            tuple(draw(st.lists(kinds, max_size=2))),
        )
        for _ in range(draw(st.integers(0, 2)))
    ]
    source = draw(st.sampled_from(["search", "listed"]))
    chooses = source == "listed" and (not logs or any(log.assortment for log in logs))
    options = Options(
        laps=draw(st.integers(1, 3)) if count > 1 else 1,
        speed_m_s=draw(maybe(st.floats(0.1, 2.0))),
        logs=source,
        logs_wanted=draw(maybe(st.integers(1, 100))),
        assortments=tuple(draw(st.lists(kinds, max_size=2))) if chooses else (),
    )
    return ForwardingMission(draw(text), tuple(way), tuple(fences), tuple(landings), tuple(logs), options)


@settings(max_examples=25)
@given(missions())
def test_a_written_mission_is_read_back(mission: ForwardingMission) -> None:
    data = geojson.write(mission)
    draft = read(data, "m")
    verify(draft)
    assert draft.mission == mission
    assert geojson.write(draft.mission) == data
    plain = json.loads(data)  # RFC 7946: closed rings, outer ones counter-clockwise, longitude first
    for written in plain["features"]:
        if written["geometry"]["type"] == "Polygon":
            ring = written["geometry"]["coordinates"][0]
            assert ring[0] == ring[-1] and len(ring) >= 4


@settings(max_examples=30)
@given(missions())
def test_swapping_all_axes_but_the_fences_never_passes(mission: ForwardingMission) -> None:
    """Read with its axes exchanged, a route leaves its fence unless the site lies on the diagonal of the map."""
    first = mission.waypoints[0]
    if (
        not mission.fences
        or abs(first.latitude_deg - first.longitude_deg) < 0.2
        or abs(abs(first.latitude_deg) - 90) < 1
    ):
        return
    swapped = [Point(p.longitude_deg, p.latitude_deg) for p in mission.waypoints]
    changed = ForwardingMission(mission.name, tuple(swapped), mission.fences)
    try:
        verify(read(geojson.write(changed), "m"))
    except MissionError as refused:
        swapped_codes = {"mission.swapped-axes", "mission.longitude-range"}
        assert refused.code in swapped_codes or SWAPPED_HINT in str(refused)
    else:
        raise AssertionError("a swapped route went through")


@settings(max_examples=40)
@given(st.lists(st.tuples(TEXT, TEXT, maybe(st.integers(-3, 40)), st.floats(0.001, 5.0)), min_size=1, max_size=6), TEXT)
def test_any_names_make_a_well_formed_report(kinds: list[tuple[str, str, int | None, float]], name: str) -> None:
    now = datetime(2026, 6, 1, tzinfo=UTC)
    logs = tuple(ForwardedLog(Point(63.0, 19.0), now, volume, s, a, key) for s, a, key, volume in kinds)
    data = write_fpr(
        (ForwardedLoad(logs, Landing(Point(63.0, 19.0), name), now),), Forwarder("id", "m", name), now, "x"
    )
    root = ET.fromstring(data)
    volumes = [float(e.text or "") for e in root.iter("{urn:skogforsk:stanford2010}LoadVolume")]
    assert np.allclose(volumes, [k[3] for k in kinds], atol=5e-5)
    keys = [e.text for e in root.findall(".//{*}ProductDefinition/{*}ProductKey")]
    assert len(set(keys)) == len(keys) and all(int(k or 0) > 0 for k in keys)


WORDS = st.text(st.characters(max_codepoint=0x2FFF, exclude_categories=("C", "Z")), max_size=6)
"""What every format holds."""


def without(mission: ForwardingMission, left_out: tuple[str, ...]) -> ForwardingMission:
    """The mission less what is left out."""
    empty, change = ForwardingMission(), msgspec.structs.replace
    for what in left_out:
        if what in ("name", "fences", "landings", "logs"):
            mission = change(mission, **{what: getattr(empty, what)})
        elif what == "names of fences":
            mission = change(mission, fences=tuple(change(f, name="") for f in mission.fences))
        elif what.startswith("bearings"):
            mission = change(mission, landings=tuple(Landing(x.position, x.name) for x in mission.landings))
        elif what.startswith("sizes"):
            mission = change(mission, logs=tuple(KnownLog(log.position, log.key) for log in mission.logs))
        elif what.startswith("option "):
            name = what.removeprefix("option ")
            mission = change(mission, options=change(mission.options, **{name: getattr(Options(), name)}))
    return mission


@pytest.mark.parametrize("kind", FORMATS)
def test_an_exported_mission_is_read_back_less_what_is_said_to_be_left_out(kind: str) -> None:
    @settings(max_examples=60, deadline=None)
    @given(missions(WORDS, WORDS.filter(bool), st.none(), st.just(SITE), least=0))
    @example(ForwardingMission("one place", (ROUTE[0],)))
    def holds(mission: ForwardingMission) -> None:
        data, left_out = export(mission, kind)
        assert bool(left_out) <= (kind != "geojson")
        assert read(data, "m").mission == without(mission, left_out)

    holds()


@pytest.mark.parametrize("kinds", [("Pine log, 2nd class",), ("Pine log, 2nd class", "spruce"), ("a", "b")])
def test_kml_keeps_the_assortments_of_a_landing_apart(kinds: tuple[str, ...]) -> None:
    mission = ForwardingMission("m", tuple(ROUTE), landings=(Landing(at(20, 15), "Road", assortments=kinds),))
    assert read(export(mission, "kml").data, "m").mission.landings == mission.landings


def test_characters_that_xml_cannot_hold_are_blanks() -> None:
    mission = ForwardingMission("a\x00b\x1b<&>", (Point(60.0, 1e-7), Point(60.0, 2e-4)))
    for kind in ("gpx", "kml"):
        found = read(export(mission, kind).data, "m").mission
        assert (found.name, found.waypoints) == ("a b <&>", mission.waypoints)


def test_an_unknown_format_is_refused() -> None:
    with pytest.raises(MissionError, check=coded("mission.export-format")):
        export(ForwardingMission(), "dxf")
