"""What a mission file holds and the mission does not: a note if it is not used, a warning if the drive changes."""

from __future__ import annotations

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
    kml,
    kml_coordinates,
    line,
    polygon,
)
from tests.codes import numbers_in


def warned(draft: Draft) -> list[str]:
    """The codes of the warnings of a file."""
    return [problem.code for problem in draft.warnings]


def track(parts: list[list[Point]]) -> bytes:
    """A GPX track of segments."""
    return gpx("<trk>" + "".join(f"<trkseg>{gpx_points('trkpt', part)}</trkseg>" for part in parts) + "</trk>")


# -- GPX --------------------------------------------------------------------------------------------------------


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


def test_points_between_those_of_a_route_are_a_warning() -> None:
    """Garmin's programs write the way along roads into extensions, and only its corners as route points."""
    between = '<extensions><g:RoutePointExtension xmlns:g="u"><g:rpt lat="1" lon="2"/><g:rpt lat="1" lon="2"/>'
    between += "</g:RoutePointExtension></extensions>"
    data = gpx(f"<rte>{gpx_points('rtept').replace('/>', f'>{between}</rtept>', 1)}</rte>")
    draft = good(data)
    assert_route(draft.mission)
    assert warned(draft) == ["gpx.points-between"] and numbers_in(draft.warnings[0].sentence) == [2]


# -- KML --------------------------------------------------------------------------------------------------------


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


# -- fences -----------------------------------------------------------------------------------------------------


def test_several_keep_in_fences_are_said_to_be_alternatives() -> None:
    inner = [at(-25, -20), at(25, -20), at(25, 20), at(-25, 20)]
    draft = good(collection(line(), polygon(FENCE), polygon(inner)))
    assert [numbers_in(note) for note in draft.notes] == [[2]]
    assert (
        good(collection(line(), polygon(FENCE), polygon([at(0, 0), at(3, 0), at(3, 3)], role="keep-out"))).notes == []
    )
