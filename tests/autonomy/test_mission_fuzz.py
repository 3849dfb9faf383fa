"""Random mission files: each one is read or refused with problems, never with a traceback; written files are read
back.
"""

from __future__ import annotations

import json
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from autonomy.missions import geojson
from autonomy.missions.fpr import ForwardedLoad, ForwardedLog, Forwarder, write_fpr
from autonomy.missions.local_frame import LocalFrame
from autonomy.missions.mission_file import read, verify
from autonomy.missions.model import (
    Fence,
    ForwardingMission,
    KnownLog,
    Landing,
    MissionError,
    Options,
    Point,
)
from autonomy.missions.validation import SWAPPED_HINT

EXAMPLES = Path(__file__).parents[2] / "docs" / "examples"
SAMPLES = {path.name: path.read_bytes() for path in sorted(EXAMPLES.iterdir()) if path.is_file()}
SMALL = {name: data for name, data in SAMPLES.items() if len(data) < 40_000}
WORDS = (
    b"NaN",
    b"Infinity",
    b"-1e309",
    b"1e308",
    b"null",
    b"true",
    b"[]",
    b"{}",
    b'"',
    b"\\",
    b"\xff",
    b"\x00",
    b"\n",
    b"</rte>",
    b"<trk>",
    b"&#0;",
    b"&lol;",
    b"<!DOCTYPE x>",
    b"<![CDATA[",
    b'"role":"log",',
    b"999999999999",
    b",",
    b"\xef\xbb\xbf",
    b"<?xml version='1.1'?>",
    b"Stem",
    b'xmlns="urn:x"',
)


def never_a_traceback(data: bytes) -> None:
    """Read and check; a refusal is short, in lines that begin with the file's name."""
    try:
        verify(read(data, "file"), site=(63.657853, 19.895562))
    except MissionError as refused:
        said = str(refused)
        assert said and len(said) < 20_000
        assert all(p.place.startswith("file") and p.code and "\n" not in p.sentence for p in refused.problems)


@given(st.sampled_from([b"", b"{", b"<", b"\xef\xbb\xbf{", b"PK", b"<?xml ", b"\xff\xfe"]), st.binary(max_size=200))
def test_random_bytes(start: bytes, rest: bytes) -> None:
    never_a_traceback(start + rest)


@settings(max_examples=80)
@given(st.data())
def test_mutated_files(data: st.DataObject) -> None:
    text = data.draw(st.sampled_from(sorted(SMALL)).map(SMALL.__getitem__))
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(0, len(text)))
        cut = data.draw(st.integers(0, 40))
        text = text[:at] + data.draw(st.one_of(st.sampled_from(WORDS), st.binary(max_size=4))) + text[at + cut :]
    never_a_traceback(text)


NAMES = st.sampled_from(["log", "fence", "landing", "Point", "Polygon", "LineString"])
NUMBERS = st.one_of(st.integers(-(10**20), 10**20), st.floats(allow_nan=False, allow_infinity=False))
ANYTHING = st.recursive(
    st.one_of(st.none(), st.booleans(), NUMBERS, st.text(max_size=5), NAMES),
    lambda inner: st.one_of(st.lists(inner, max_size=4), st.dictionaries(st.text(max_size=5), inner, max_size=3)),
    max_leaves=8,
)


@settings(max_examples=40)
@given(st.data())
def test_json_files_with_any_value_anywhere(data: st.DataObject) -> None:
    document = json.loads(SAMPLES[data.draw(st.sampled_from(["paper_b.geojson", "route.plan"]))])
    for _ in range(data.draw(st.integers(1, 3))):
        owner, key = data.draw(st.sampled_from(_slots(document)))
        owner[key] = data.draw(ANYTHING)
    never_a_traceback(json.dumps(document).encode())


def _slots(value: Any) -> list[tuple[Any, Any]]:
    """Every place in a document where another value could stand."""
    found: list[tuple[Any, Any]] = []
    steps = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, inner in steps:
        found += [(value, key), *_slots(inner)]
    return found


# -- write, read ------------------------------------------------------------------------------------------------

TEXT = st.text(st.characters(exclude_categories=["Cs"]), max_size=12)
METRES = st.floats(-2000.0, 2000.0)


def maybe(strategy: st.SearchStrategy[Any]) -> st.SearchStrategy[Any]:
    """A value or None."""
    return st.one_of(st.none(), strategy)


@st.composite
def missions(draw: st.DrawFn) -> ForwardingMission:
    """A mission that can be driven, anywhere on Earth, poles and antimeridian included."""
    latitude = draw(st.one_of(st.floats(-90.0, 90.0), st.sampled_from([90.0, -90.0, 0.0])))
    longitude = draw(st.one_of(st.floats(-180.0, 180.0), st.sampled_from([180.0, -180.0])))
    frame = LocalFrame(latitude, longitude)

    def place(east: float, north: float) -> Point:
        at = frame.point(east, north)
        return Point(at.latitude_deg, at.longitude_deg, draw(maybe(st.floats(-50.0, 3000.0))))

    count = draw(st.integers(1, 6))
    way = [place(draw(METRES), 40.0 * i) for i in range(count)]
    fences = []
    if draw(st.booleans()):
        angles = np.linspace(0.0, 2 * np.pi, draw(st.integers(8, 20)), endpoint=False)
        fences = [Fence(tuple(place(4000 * np.cos(a), 4000 * np.sin(a)) for a in angles), False, draw(TEXT))]
        hole = [place(*c) for c in ((3000, 0), (3100, 0), (3100, 90), (3000, 90))]
        fences += [Fence(tuple(hole), True, draw(TEXT))] if draw(st.booleans()) else []
    logs = [
        KnownLog(
            place(draw(METRES), draw(METRES)),
            draw(TEXT),
            draw(maybe(st.floats(0.0, 360.0))),
            draw(maybe(st.floats(2.1, 10.0))),
            draw(maybe(st.floats(0.05, 1.0))),
            draw(TEXT),
            draw(TEXT),
            draw(maybe(st.integers(1, 10**6))),
            draw(maybe(st.floats(0.0, 20.0))),
        )
        for _ in range(draw(st.integers(0, 4)))
    ]
    landings = [
        Landing(
            place(draw(METRES), draw(METRES)),
            draw(TEXT),
            draw(maybe(st.floats(0.0, 360.0))),
            tuple(draw(st.lists(TEXT, max_size=2))),
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
        assortments=tuple(draw(st.lists(TEXT, max_size=2))) if chooses else (),
    )
    return ForwardingMission(draw(TEXT), tuple(way), tuple(fences), tuple(landings), tuple(logs), options)


@settings(max_examples=25)
@given(missions())
def test_a_written_mission_is_read_back(mission: ForwardingMission) -> None:
    data = geojson.write(mission)
    draft = read(data, "m")
    verify(draft)
    assert draft.mission == mission
    assert geojson.write(draft.mission) == data
    plain = json.loads(data)  # RFC 7946: closed rings, outer ones counter-clockwise, longitude first
    for feature in plain["features"]:
        if feature["geometry"]["type"] == "Polygon":
            ring = feature["geometry"]["coordinates"][0]
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
    import xml.etree.ElementTree as ET

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
