"""What a mission file holds and the mission does not: a note if it is not used, a warning if the drive changes."""

from __future__ import annotations

from typing import Any

import pytest

from autonomy.missions.features import Draft
from autonomy.missions.model import Point
from tests.autonomy.mission_checks import assert_route, codes, good
from tests.autonomy.mission_texts import (
    FENCE,
    ROUTE,
    at,
    collection,
    gpx,
    gpx_points,
    item,
    kml,
    kml_coordinates,
    line,
    plan,
    polygon,
)
from tests.codes import numbers_in


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
def speed(value: float, kind: int = 1) -> dict[str, Any]:
    """A DO_CHANGE_SPEED."""
    return {"type": "SimpleItem", "command": 178, "frame": 2, "params": [kind, value, -1, 0, 0, 0, 0]}


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
        ([{"type": "SimpleItem", "command": 177, "frame": 2, "params": [1, 3, 0, 0, 0, 0, 0]}], 1, 0),  # a jump
        ([{"type": "SimpleItem", "command": 112, "frame": 2, "params": [9, 0, 0, 0, 0, 0, 0]}], 1, 0),  # a delay
        ([{"type": "SimpleItem", "command": 206, "frame": 2, "params": [9, 0, 0, 0, 0, 0, 0]}], 0, 1),  # a camera
        ([{"type": "ComplexItem", "complexItemType": "survey"}], 1, 0),
        (
            [{"type": "SimpleItem", "command": 5001, "frame": 3, "params": [4, 0, 0, 0, 1, 2, 0]}],
            1,
            0,
        ),  # a fence's corner
        ([WAIT], 1, 0),
        ([A | {"autoContinue": False}], 1, 0),
        ([{"type": "SimpleItem", "command": "x" * 999}, {"type": "SimpleItem", "command": None}], 0, 2),
    ],
)
def test_items_that_are_no_waypoints(extra: list[dict[str, Any]], warned: int, noted: int) -> None:
    draft = good(plan([*extra, *([] if extra[:1] and extra[0].get("command") == 16 else [A]), B, C]))
    assert [problem.code for problem in draft.warnings] == ["plan.not-driven"] * warned and len(draft.notes) == noted
    assert len(draft.mission.waypoints) == 3
