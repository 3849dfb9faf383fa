"""Missions written for other programs are read back as they were, less what the format is said to leave out."""

from __future__ import annotations

import math

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from autonomy.missions.export import FORMATS, export
from autonomy.missions.mission_file import load_mission, read
from autonomy.missions.model import Fence, ForwardingMission, KnownLog, Landing, MissionError, Options, Point
from tests.autonomy.mission_checks import EXAMPLES
from tests.autonomy.mission_texts import at
from tests.codes import coded

METRES = st.floats(-900.0, 900.0)
PLACES = st.builds(at, METRES, METRES)
WORDS = st.text(st.characters(max_codepoint=0x2FFF, exclude_categories=("C", "Z"), exclude_characters=","), max_size=6)
BEARINGS = st.none() | st.floats(0.0, 360.0)
LANDINGS = st.builds(Landing, PLACES, WORDS, BEARINGS, st.lists(WORDS.filter(bool), max_size=2).map(tuple))
LOGS = st.builds(
    KnownLog,
    PLACES,
    WORDS,
    BEARINGS,
    st.none() | st.floats(0.5, 9.0),
    st.none() | st.floats(0.05, 0.4),
    WORDS,
    WORDS,
    st.none() | st.integers(1, 99),
    st.none() | st.floats(0.0, 9.0),
)


@st.composite
def fences(draw: st.DrawFn) -> Fence:
    """Corners on a circle, counter-clockwise."""
    east, north, radius = draw(METRES), draw(METRES), draw(st.floats(2.0, 200.0))
    turns = [math.tau * i / 5 for i in range(draw(st.integers(3, 5)))]
    corners = tuple(at(east + radius * math.cos(t), north + radius * math.sin(t)) for t in turns)
    return Fence(corners, draw(st.booleans()), draw(WORDS))


MISSIONS = st.builds(
    ForwardingMission,
    WORDS,
    st.lists(PLACES, max_size=6).map(tuple),
    st.lists(fences(), max_size=3).map(tuple),
    st.lists(LANDINGS, max_size=3).map(tuple),
    st.lists(LOGS, max_size=3).map(tuple),
    st.builds(Options, st.integers(1, 9), st.none() | st.floats(0.1, 3.0), logs=st.sampled_from(["search", "listed"])),
)


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
def test_a_written_mission_is_read_back(kind: str) -> None:
    @settings(max_examples=60, deadline=None)
    @given(MISSIONS)
    def holds(mission: ForwardingMission) -> None:
        data, left_out = export(mission, kind)
        assert bool(left_out) <= (kind != "geojson")
        assert read(data, "m").mission == without(mission, left_out)

    holds()


@pytest.mark.parametrize("kind", FORMATS)
def test_the_paper_s_mission_in_every_format(kind: str, tmp_path) -> None:
    mission = load_mission(EXAMPLES / "paper_b.geojson").mission
    path = tmp_path / f"m.{kind}"
    path.write_bytes(export(mission, kind).data)
    assert load_mission(path).mission.waypoints == mission.waypoints


def test_characters_that_xml_cannot_hold_are_blanks() -> None:
    mission = ForwardingMission("a\x00b\x1b<&>", (Point(60.0, 1e-7), Point(60.0, 2e-4)))
    for kind in ("gpx", "kml"):
        found = read(export(mission, kind).data, "m").mission
        assert (found.name, found.waypoints) == ("a b <&>", mission.waypoints)


def test_an_unknown_format_is_refused() -> None:
    with pytest.raises(MissionError, check=coded("mission.export-format")):
        export(ForwardingMission(), "dxf")
