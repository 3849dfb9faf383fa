"""StanForD 2010: logs from a harvester's hpr, and the structure of the fpr against its schema."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from dataclasses import replace
from datetime import UTC, datetime, timedelta, timezone
from pathlib import Path

import pytest

from autonomy.missions import geojson
from autonomy.missions.fpr import ForwardedLoad, ForwardedLog, Forwarder, write_fpr
from autonomy.missions.hpr import MACHINE_SIGMA_M, TIP_SIGMA_M
from autonomy.missions.mission_file import load_mission, read, verify
from autonomy.missions.model import Landing, MissionError, Point, Problem
from tests.autonomy.mission_checks import refused
from tests.autonomy.mission_texts import SITE, at
from tests.codes import coded, numbers_in

EXAMPLE = Path(__file__).parents[2] / "docs" / "examples" / "harvest.hpr"
TEXT = EXAMPLE.read_text(encoding="utf-8")
LOGS = load_mission(EXAMPLE).mission.logs
NS = {"s": "urn:skogforsk:stanford2010"}


def problem(text: str) -> Problem:
    """The first problem of an hpr that is refused."""
    return refused(text.encode(), "h", route_wanted=False).problems[0]


# -- hpr
def test_logs_of_a_harvesters_production() -> None:
    assert [log.key for log in LOGS] == ["4001/1", "4001/2", "4002/1", "4002/2", "4003/1", "4004/1", "4004/2"]
    assert [(log.species, log.assortment, log.product_key) for log in LOGS[1:3]] == [
        ("birch", "pulpwood", 31),
        ("pine", "saw logs", 11),
    ]
    assert (LOGS[0].length_m, LOGS[0].diameter_m) == (pytest.approx(3.0), pytest.approx(0.210))
    assert all(log.bearing_deg is None for log in LOGS)


def test_the_crane_tips_position_is_better_than_the_harvesters() -> None:
    places = SITE.points_enu([log.position for log in LOGS])
    assert places[0, :2] == pytest.approx((-10.0, -9.0), abs=0.02) and LOGS[0].sigma_m == TIP_SIGMA_M
    assert places[-1, :2] == pytest.approx((0.0, -12.0), abs=0.02) and LOGS[-1].sigma_m == MACHINE_SIGMA_M


@pytest.mark.parametrize(("south", "west"), [("South", "West"), ("south", "WEST"), ("S", "W")])
def test_south_and_west(south: str, west: str) -> None:
    turned = TEXT.replace('"North"', f'"{south}"').replace('"East"', f'"{west}"')
    at_first = read(turned.encode(), "h").mission.logs[0].position
    assert (at_first.latitude_deg, at_first.longitude_deg) == (
        pytest.approx(-63.65777, abs=1e-3),
        pytest.approx(-19.8954, abs=1e-3),
    )


def test_a_sign_beside_the_half_of_the_globe() -> None:
    signed = TEXT.replace('"North">', '"South">-')
    assert problem(signed).code == "hpr.category"
    at_first = read(signed.replace(' latitudeCategory="South"', "").encode(), "h").mission.logs[0].position
    assert at_first.latitude_deg == pytest.approx(-63.65777, abs=1e-3)


def test_diameters_of_harvesters_with_fewer_measurements() -> None:
    ends = TEXT.replace('"Mid ob">210', '"Butt ob">230')
    assert read(ends.encode(), "h").mission.logs[0].diameter_m == pytest.approx(0.5 * (0.230 + 0.190))
    lines = [line for line in TEXT.splitlines() if "LogDiameter" not in line]
    by_volume = read("\n".join(lines).encode(), "h").mission.logs[0]
    assert by_volume.diameter_m == pytest.approx(0.210, rel=1e-3)  # the sample's volumes are cylinders


START = TEXT.index("<StemCoordinates", TEXT.index("<StemKey>4004"))
END = TEXT.index("</StemCoordinates>", START) + len("</StemCoordinates>")


@pytest.mark.parametrize(
    ("text", "logs", "warned"),
    [
        (TEXT[:START] + TEXT[END:], 5, {"hpr.no-coordinates": [2]}),
        (
            re.sub(r"(<L(?:at|ong)itude[^>]*>)[\d.]+", r"\g<1>0.0", TEXT),
            0,
            {"hpr.no-coordinates": [7], "hpr.no-logs": []},
        ),
        (TEXT.replace("ProcessedStem>", "Stem>"), 0, {"hpr.no-logs": []}),
    ],
    ids=["a stem without coordinates", "no fix", "no logs"],
)
def test_logs_that_have_no_place_are_counted(text: str, logs: int, warned: dict[str, list[float]]) -> None:
    draft = read(text.encode(), "h")
    assert len(draft.mission.logs) == logs and draft.notes == []
    assert {p.code: numbers_in(p.sentence) for p in draft.warnings} == warned


def test_a_position_in_the_processing_of_a_stem() -> None:
    given, inner = TEXT[START:END].replace("StemCoordinates", "Coordinates"), "<SingleTreeProcessedStem>"
    moved = TEXT[:START] + TEXT[END:].replace(inner, inner + given, 1)
    draft = read(moved.encode(), "h")
    assert draft.mission.logs == LOGS and draft.warnings == []


def test_two_measurements_of_a_log_are_not_mixed() -> None:
    other = (
        '<LogMeasurement logMeasurementCategory="Other"><LogDiameter logDiameterCategory="Mid ob">999</LogDiameter>'
        "<LogLength>999</LogLength></LogMeasurement>"
    )
    draft = read(TEXT.replace("<LogMeasurement", other + "<LogMeasurement", 1).encode(), "h")
    again = read(TEXT.replace("</LogMeasurement>", "</LogMeasurement>" + other, 1).encode(), "h")
    assert draft.mission.logs == again.mission.logs == LOGS
    assert [numbers_in(note) for note in draft.notes] == [[1]]


@pytest.mark.parametrize(("length_cm", "thick_mm"), [("0", "210"), ("12", "210"), ("35", "350"), ("35", "400")])
def test_a_cut_off_or_one_that_is_as_thick_as_long_is_left_out(length_cm: str, thick_mm: str) -> None:
    text = TEXT.replace("<LogLength>300<", f"<LogLength>{length_cm}<", 1)
    draft = read(re.sub(r'("Mid ob">)\d+', rf"\g<1>{thick_mm}", text, count=1).encode(), "h")
    verify(draft, route_wanted=False)
    assert len(draft.mission.logs) == len(LOGS) - 1 and numbers_in(draft.notes[0])[0] == 1
    assert [place for place in draft.places if place[0] == "log"] == [("log", i) for i in range(len(LOGS) - 1)]


@pytest.mark.parametrize("key", ["0", "-1", "31.5", "99999999999"])
def test_a_product_key_that_no_mission_holds_is_left_out(key: str) -> None:
    draft = read(TEXT.replace("<ProductKey>31<", f"<ProductKey>{key}<").encode(), "h")
    assert [log.product_key for log in draft.mission.logs[:3]] == [None, None, 11]
    assert [log.assortment for log in draft.mission.logs] == [log.assortment for log in LOGS]
    assert [numbers_in(note)[0] for note in draft.notes] == [sum(log.product_key == 31 for log in LOGS)]
    assert read(geojson.write(draft.mission), "m").mission == draft.mission


def test_an_hpr_in_an_envelope() -> None:
    body = TEXT[TEXT.index("<HarvestedProduction ") :]
    draft = read(f"<Envelope><Head/>{body}</Envelope>".encode(), "h")
    assert draft.mission.logs == LOGS
    assert problem(f"<Envelope>{body}{body}</Envelope>").code == "mission.envelope"


@pytest.mark.parametrize(
    ("old", "new", "code"),
    [
        ("urn:skogforsk:stanford2010", "urn:else", "hpr.namespace"),
        ('messageType="hpr"', 'messageType="pri"', "hpr.message-type"),
        ('"WGS84"', '"RT90"', "mission.datum"),
        ('lengthUnit="cm"', 'lengthUnit="mm"', "hpr.unit"),
        ('diameterUnit="mm"', 'diameterUnit="inch"', "hpr.unit"),
        ('"North"', '"Upwards"', "hpr.category"),
        ('"East"', '""', "hpr.category"),
        ("<LogLength>300", "<LogLength>3x0", "mission.number"),
        ("<LogLength>300", "<LogLength>inf", "mission.number"),
        ("<LogLength>300", "<LogLength>30000", "mission.log-size"),
        ("</Machine>", "</Machin>", "mission.not-xml"),
    ],
)
def test_invalid_hpr_files(old: str, new: str, code: str) -> None:
    found = problem(TEXT.replace(old, new))
    assert found.code == code and found.place.startswith("h:")


def test_the_line_of_a_bad_log() -> None:
    bad = TEXT.replace("<LogLength>430", "<LogLength>x", 1)
    assert problem(bad).place == f"h:{1 + bad[: bad.index('<LogLength>x')].count(chr(10))}"


def test_an_hpr_alone_is_no_route() -> None:
    with pytest.raises(MissionError, check=coded("mission.no-waypoints")):
        load_mission(EXAMPLE, route_wanted=True)
    both = load_mission(EXAMPLE.with_name("route.gpx"), logs=EXAMPLE)
    assert (len(both.mission.waypoints), len(both.mission.logs)) == (3, 7)


def test_logs_of_another_site_are_refused(tmp_path: Path) -> None:
    (tmp_path / "far.hpr").write_text(TEXT.replace(">63.", ">33."))
    with pytest.raises(MissionError, check=coded("mission.too-far-apart")):
        load_mission(EXAMPLE.with_name("route.gpx"), logs=tmp_path / "far.hpr")


# -- fpr
NOON = datetime(2026, 6, 1, 12, 0, tzinfo=timezone(timedelta(hours=2)))
ROAD, YARD = Landing(at(22, 17), "Road side"), Landing(at(-22, 17), "Yard")
BIRCH = ForwardedLog(at(-10, -9), NOON, 0.0982, "birch", "pulpwood", 31)
PINE = ForwardedLog(Point(-33.5, -70.25, 512.4), NOON + timedelta(seconds=30), 0.2111, "pine", "saw logs", 11)
STRAY = ForwardedLog(at(3, 4), NOON, 0.05)
LOADS = (
    ForwardedLoad((BIRCH, replace(BIRCH, volume_m3=0.1), PINE), ROAD, NOON + timedelta(minutes=20), 640.4),
    ForwardedLoad((STRAY,), YARD, NOON + timedelta(minutes=50)),
)
WHO = Forwarder("AORO-1", "FC8", "Hörnefors <12> & co")

ORDER = {
    "Machine": "MachineKey MachineUserID MachineApplicationVersion MachineBaseManufacturer MachineBaseModel "
    "BaseMachineManufacturerID OperatorDefinition SpeciesGroupDefinition ProductDefinition ObjectDefinition "
    "LocationDefinition DeliveryDefinition Load",
    "Load": "LoadKey OperatorKey LoadNumber DistanceFromLastUnloading UnloadingTime PartialLoad",
    "PartialLoad": "PartialLoadKey DeliveryKey LocationKey LoadNumberOfItems LoadVolume LoadingCoordinates",
    "LoadingCoordinates": "Latitude Longitude Altitude CoordinateDate",
    "LocationDefinition": "LocationUserID LocationName LocationCoordinates LocationKey ObjectKey",
    "ProductDefinition": "ProductKey ClassifiedProductDefinition",
    "DeliveryDefinition": "DeliveryKey ProductKey",
}
"""The sequences of the schema (version 3.6), as far as we write them."""


def report(loads: tuple[ForwardedLoad, ...] = LOADS) -> ET.Element:
    """The report, read by another parser than wrote it."""
    return ET.fromstring(write_fpr(loads, WHO, NOON + timedelta(hours=1), "timberhand 0.1.0"))


def texts(root: ET.Element, path: str) -> list[str]:
    return [element.text or "" for element in root.findall(path, NS)]


def test_the_elements_come_in_the_order_of_the_schema() -> None:
    root = report()
    assert root.tag == "{urn:skogforsk:stanford2010}ForwardedProduction"
    assert (root.get("messageType"), root.get("version"), root.get("volumeUnit")) == ("fpr", "3.6", "m3")
    for name, order in ORDER.items():
        found = root.findall(f".//s:{name}", NS)
        assert found
        for element in found:
            places = [order.split().index(child.tag.partition("}")[2]) for child in element]
            assert places == sorted(places), name


def test_every_log_has_its_place_time_product_and_volume() -> None:
    root = report()
    parts = root.findall(".//s:PartialLoad", NS)
    deliveries = {
        d.findtext("s:DeliveryKey", "", NS): d.findtext("s:ProductKey", "", NS)
        for d in root.findall(".//s:DeliveryDefinition", NS)
    }
    assert [deliveries[p.findtext("s:DeliveryKey", "", NS)] for p in parts] == ["31", "31", "11", "1"]
    assert [float(p.findtext("s:LoadVolume", "", NS)) for p in parts] == [0.0982, 0.1, 0.2111, 0.05]
    assert {p.findtext("s:LoadNumberOfItems", "", NS) for p in parts} == {"1"}
    assert [datetime.fromisoformat(t) for t in texts(root, ".//s:CoordinateDate")][2] == PINE.taken
    pine = parts[2].find("s:LoadingCoordinates", NS)
    latitude, longitude = pine.find("s:Latitude", NS), pine.find("s:Longitude", NS)
    assert (latitude.get("latitudeCategory"), float(latitude.text or "")) == ("South", 33.5)
    assert (longitude.get("longitudeCategory"), float(longitude.text or "")) == ("West", 70.25)


def test_every_key_that_is_used_is_defined_once() -> None:
    root = report()
    for used, defined in (
        (".//s:PartialLoad/s:LocationKey", ".//s:LocationDefinition/s:LocationKey"),
        (".//s:PartialLoad/s:DeliveryKey", ".//s:DeliveryDefinition/s:DeliveryKey"),
        (".//s:DeliveryDefinition/s:ProductKey", ".//s:ProductDefinition/s:ProductKey"),
        (".//s:ClassifiedProductDefinition/s:SpeciesGroupKey", ".//s:SpeciesGroupDefinition/s:SpeciesGroupKey"),
        (".//s:LocationDefinition/s:ObjectKey", ".//s:ObjectDefinition/s:ObjectKey"),
        (".//s:Load/s:OperatorKey", ".//s:OperatorDefinition/s:OperatorKey"),
    ):
        keys = texts(root, defined)
        assert len(set(keys)) == len(keys) and set(texts(root, used)) <= set(keys)
    assert len(set(texts(root, ".//s:PartialLoadKey"))) == 4


def test_two_assortments_with_one_key_get_separate_keys() -> None:
    logs = (BIRCH, replace(BIRCH, assortment="fuel"), replace(BIRCH, assortment="veneer", product_key=1), STRAY)
    root = report((ForwardedLoad(logs, ROAD, NOON),))
    assert sorted(texts(root, ".//s:ProductDefinition/s:ProductKey"), key=int) == ["1", "2", "3", "31"]


def test_names_may_contain_any_character() -> None:
    assert texts(report(), ".//s:ObjectName") == ["Hörnefors <12> & co"]
    odd = replace(WHO, site="a\x00b\ud800\U0001f332")
    root = ET.fromstring(write_fpr(LOADS, odd, NOON, "x"))
    assert texts(root, ".//s:ObjectName") == ["ab\U0001f332"]


def test_invalid_loads_are_refused() -> None:
    assert report(()).find(".//s:Load", NS) is None
    for load, code in (
        (ForwardedLoad((), ROAD, NOON), "fpr.empty-load"),
        (ForwardedLoad((replace(BIRCH, volume_m3=float("nan")),), ROAD, NOON), "fpr.volume"),
        (ForwardedLoad((BIRCH,), ROAD, NOON.replace(tzinfo=None)), "fpr.no-time-zone"),
    ):
        with pytest.raises(MissionError, check=coded(code)):
            write_fpr((load,), WHO, datetime(2026, 6, 1, tzinfo=UTC), "x")


def test_an_fpr_is_not_a_mission() -> None:
    with pytest.raises(MissionError, check=coded("mission.unknown-xml")):
        read(write_fpr(LOADS, WHO, NOON, "x"), "f")
