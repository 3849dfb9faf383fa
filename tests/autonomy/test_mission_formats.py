"""The content of every mission file format."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from autonomy.missions.mission_file import load_mission, save_mission
from autonomy.missions.model import MissionError, Options
from tests.autonomy.mission_checks import EXAMPLES, assert_route, codes, good
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
from tests.codes import coded


@pytest.mark.parametrize(
    "data",
    [
        collection(line()),
        collection(*(feature("Point", p) for p in lon_lat(ROUTE))),
        collection(feature("MultiPoint", lon_lat(ROUTE), role="waypoint")),
        b'{"type": "LineString", "coordinates": %s}' % str(lon_lat(ROUTE)).encode(),
        plan([item(p) for p in ROUTE]),
        gpx(f"<rte>{gpx_points('rtept')}</rte>"),
        gpx(
            "<trk>"
            + "".join(f"<trkseg>{gpx_points('trkpt', part)}</trkseg>" for part in (ROUTE[:2], ROUTE[2:]))
            + "</trk>"
        ),
        gpx(gpx_points("wpt")),
        kml(f"<Placemark><LineString><coordinates>{kml_coordinates()}</coordinates></LineString></Placemark>"),
        kml(
            "<Folder>"
            + "".join(
                f"<Placemark><Point><coordinates>{kml_coordinates([p])}</coordinates></Point></Placemark>"
                for p in ROUTE
            )
            + "</Folder>"
        ),
    ],
    ids=[
        "line",
        "points",
        "multipoint",
        "bare geometry",
        "plan",
        "gpx route",
        "gpx track",
        "gpx waypoints",
        "kml line",
        "kml points",
    ],
)
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


def test_a_log_may_be_drawn_by_its_ends() -> None:
    log = good(collection(line(), line([at(4, 3), at(4, 7)], role="log", diameter_m=0.2))).mission.logs[0]
    assert (log.bearing_deg, log.length_m) == (pytest.approx(0.0, abs=1e-3), pytest.approx(4.0, abs=1e-6))
    assert SITE.points_enu([log.position])[0][:2] == pytest.approx((4.0, 5.0), abs=1e-4)


def test_kml_data_and_gpx_types_give_the_role_of_a_point() -> None:
    values = {"role": "landing", "assortments": "a, b"}
    data = "".join(f'<Data name="{key}"><value>{value}</value></Data>' for key, value in values.items())
    data = f"<ExtendedData>{data}</ExtendedData>"
    point = f"<Point><coordinates>{kml_coordinates([at(20, 15)])}</coordinates></Point>"
    way = f"<LineString><coordinates>{kml_coordinates()}</coordinates></LineString>"
    mission = good(kml(f"<Placemark><name>Road</name>{data}{point}</Placemark><Placemark>{way}</Placemark>")).mission
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


def test_altitude_present_and_absent() -> None:
    heights = [[*p, 12.5] for p in lon_lat(ROUTE)]
    mission = good(collection(feature("LineString", heights))).mission
    assert [p.altitude_m for p in mission.waypoints] == [12.5] * 3
    mixed = [heights[0], heights[1][:2], [*heights[2][:2], None]]
    assert [p.altitude_m for p in good(collection(feature("LineString", mixed))).mission.waypoints] == [
        12.5,
        None,
        None,
    ]
    assert codes(collection(feature("LineString", [[*p, 1e5] for p in lon_lat(ROUTE)]))) == ["height-range"] * 3
