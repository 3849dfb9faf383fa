"""The report of a run: the forwarded loads with positions and times."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from autonomy.manager.tally import Load, LoadedLog
from autonomy.missions.model import ForwardingMission, Landing, Point
from hil.missions.summary import report_loads
from machine.loading.profile_file import load_profile

PROFILE = load_profile("aoro_fc8")
MISSION = ForwardingMission("Kiruna 7", (), landings=(Landing(Point(63.6, 19.9), "road"),))
BEGUN = datetime(2026, 5, 4, 12, 0, tzinfo=UTC)


def taken(at_s: int, volume_m3: float = 0.1, *product: Any) -> LoadedLog:
    return LoadedLog(Point(63.65, 19.89), at_s * 1_000_000_000, volume_m3, *product)


def test_a_run_writes_a_report_of_its_loads(tmp_path: Path) -> None:
    loads = [
        Load((taken(10), taken(70, 0.2, "pulp", "birch", 31)), 130_000_000_000, 41.7),
        Load((taken(200),), 260_000_000_000, 9.0),
    ]
    path = report_loads(tmp_path, loads, MISSION, PROFILE, BEGUN, 0)
    assert path == tmp_path / "forwarded.fpr"
    text: dict[str, list[str | None]] = {}
    for element in ElementTree.fromstring(path.read_bytes()).iter():
        text.setdefault(element.tag.rpartition("}")[2], []).append(element.text)
    assert text["UnloadingTime"] == ["2026-05-04T12:02:10+00:00", "2026-05-04T12:04:20+00:00"]
    assert text["LoadVolume"] == ["0.1000", "0.2000", "0.1000"]
    assert text["CoordinateDate"][1] == "2026-05-04T12:01:10+00:00"
    assert text["ObjectName"] == ["Kiruna 7"] and text["LocationName"] == ["road"]
    assert text["DistanceFromLastUnloading"] == ["42", "9"] and sorted(text["ProductName"]) == ["pulp", "unknown"]
    assert sorted(text["SpeciesGroupName"]) == ["birch", "unknown"] and "31" in text["ProductKey"]
    assert text["CreationDate"] == ["2026-05-04T12:04:20+00:00"]


def test_a_run_without_forwarded_logs_has_no_report(tmp_path: Path) -> None:
    assert report_loads(tmp_path, [], MISSION, PROFILE, BEGUN, 0) is None
    assert not list(tmp_path.iterdir())
