"""Mission files: reads any supported format into a validated mission, or reports every problem with its line.

The format is detected from the content, not from the name: GeoJSON, QGroundControl ``.plan``, GPX, KML, and StanForD
2010 ``hpr`` for logs only; each also in a zip or gzip file (``.kmz``, ``.hprz``).
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from autonomy.missions import geojson, qgc_plan
from autonomy.missions.features import Draft, merged
from autonomy.missions.gpx_kml import read_gpx, read_kml
from autonomy.missions.hpr import HPR, read_hpr
from autonomy.missions.model import ForwardingMission, MissionError
from autonomy.missions.source import json_document, read_bytes, unpacked, utf_8
from autonomy.missions.validation import problems_of
from autonomy.missions.xml_tree import root_name, tree

_XML_BEGINS = (b"<", b"\xff\xfe", b"\xfe\xff")


def load_mission(
    path: str | Path,
    *,
    logs: str | Path | None = None,
    route_wanted: bool | None = None,
    site: tuple[float, float] | None = None,
) -> Draft:
    """Load the validated mission of a file, and notes on what was ignored.

    ``logs`` is a second file whose logs are added, for example a harvester's hpr.  ``route_wanted`` None requires a
    route unless the file is an hpr.  ``site``: see ``autonomy.missions.validation.problems_of``.

    Raises:
        MissionError: ``problems`` has every problem with the file, its line if known, and a hint.
    """
    draft = read(read_bytes(path), str(path))
    route_wanted = draft.format != HPR if route_wanted is None else route_wanted
    verify(draft, route_wanted=route_wanted, site=site)
    if logs is None:
        return draft
    harvest = read(read_bytes(logs), str(logs))
    verify(harvest, route_wanted=False, site=site)
    both = merged(draft, harvest)
    for key, code, sentence in problems_of(both.mission, route_wanted, site):
        raise MissionError(
            code, f"{sentence} (of {path} and {logs} together)" if key else sentence, str(logs if key else path)
        )
    return both


def read(data: bytes, name: str) -> Draft:
    """Read the mission in the bytes of a file, not yet validated; ``name`` is the file's name in errors."""
    data, name, notes = unpacked(data, name)
    draft = _read_unpacked(utf_8(data, name), name)
    draft.notes += notes
    return draft


def _read_unpacked(data: bytes, name: str) -> Draft:
    start = data.removeprefix(b"\xef\xbb\xbf").lstrip(b" \t\r\n")[:4]
    if not start:
        raise MissionError("mission.empty-file", "is empty", name)
    if start.startswith(_XML_BEGINS):
        return _read_xml(data, name)
    if start.startswith((b"{", b"[")):
        return _read_json(data, name)
    raise MissionError(
        "mission.unknown-format",
        "is neither JSON nor XML; missions are GeoJSON, QGroundControl .plan, GPX, KML or hpr",
        name,
    )


def _read_json(data: bytes, name: str) -> Draft:
    document, source = json_document(data, name)
    if not isinstance(document, dict):
        sentence = "is a JSON list; a mission is one object, such as a GeoJSON FeatureCollection"
        raise source.error("mission.no-object", None, sentence)
    members: dict[str, Any] = document
    return qgc_plan.read(members, source) if members.get("fileType") == "Plan" else geojson.read(members, source)


def _read_xml(data: bytes, name: str) -> Draft:
    root = root_name(data) or tree(data, name, frozenset(), {}).name  # tree raises the precise error
    if root == "gpx":
        return read_gpx(data, name)
    if root == "kml":
        return read_kml(data, name)
    if root == "HarvestedProduction":
        return read_hpr(data, name)
    if b"HarvestedProduction" in data:
        return read_hpr(data, name)
    raise MissionError(
        "mission.unknown-xml",
        f"contains <{root[:40]}>, which is not a mission; missions in XML are GPX, KML or hpr",
        name,
    )


def verify(draft: Draft, *, route_wanted: bool = True, site: tuple[float, float] | None = None) -> None:
    """Validate a draft.

    Raises:
        MissionError: every problem, with its line in the file.
    """
    problems = problems_of(draft.mission, route_wanted, site)
    if problems:
        raise draft.source.errors(
            (None if f.key is None else draft.places.get(f.key), f.code, f.sentence) for f in problems
        )


def save_mission(path: str | Path, mission: ForwardingMission) -> None:
    """Write a mission as GeoJSON.

    Raises:
        MissionError: the file cannot be written.
    """
    save_bytes(path, geojson.write(mission))


def save_bytes(path: str | Path, data: bytes) -> None:
    """Write a mission's file.

    Raises:
        MissionError: the file cannot be written.
    """
    try:
        Path(path).write_bytes(data)
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise MissionError("mission.not-written", f"cannot be written: {reason}", str(path)) from None
