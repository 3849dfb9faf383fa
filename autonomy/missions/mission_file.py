"""Mission files in and out: whatever the format, a checked mission or sentences that say what is wrong with the file.

What a file is shows in its content, not in its name: GeoJSON, QGroundControl's ``.plan``, GPX, KML, and StanForD 2010
``hpr`` for logs alone.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from autonomy.missions import geojson, qgc_plan
from autonomy.missions.validation import problems_of
from autonomy.missions.features import Draft, merged
from autonomy.missions.hpr import HPR, read_hpr
from autonomy.missions.gpx_kml import read_gpx, read_kml
from autonomy.missions.model import ForwardingMission, MissionError
from autonomy.missions.source import json_document, read_bytes
from autonomy.missions.xml_tree import root_name, tree

_XML_BEGINS = (b"<", b"\xff\xfe", b"\xfe\xff")


def load_mission(
    path: str | Path,
    *,
    logs: str | Path | None = None,
    route_wanted: bool | None = None,
    site: tuple[float, float] | None = None,
) -> Draft:
    """The checked mission of a file, and what was left out of it.

    ``logs``: a second file whose logs are added, for example a harvester's hpr.  ``route_wanted``: None asks for one
    unless the file is a harvester's.  ``site``: see ``autonomy.missions.validation.problems_of``.

    Raises:
        MissionError: every problem is one sentence with the file, the line where there is one, and a hint.
    """
    draft = read(read_bytes(path), str(path))
    route_wanted = draft.format != HPR if route_wanted is None else route_wanted
    verify(draft, route_wanted=route_wanted, site=site)
    if logs is None:
        return draft
    harvest = read(read_bytes(logs), str(logs))
    verify(harvest, route_wanted=False, site=site)
    both = merged(draft, harvest)
    for key, sentence in problems_of(both.mission, route_wanted, site):
        raise MissionError(f"{logs}: {sentence} (of {path} and {logs} together)" if key else f"{path}: {sentence}")
    return both


def read(data: bytes, name: str) -> Draft:
    """What the bytes of a mission file say, not yet checked; ``name`` is what to call the file in an error."""
    start = data.removeprefix(b"\xef\xbb\xbf").lstrip(b" \t\r\n")[:4]
    if not start:
        raise MissionError(f"{name}: is empty")
    if start.startswith(b"PK"):
        raise MissionError(f"{name}: is a zip file; unpack it and read the .kml inside")
    if start.startswith(_XML_BEGINS):
        return _read_xml(data, name)
    if start.startswith(b"{") and not start.startswith(b"{\0"):
        return _read_json(data, name)
    raise MissionError(f"{name}: is neither JSON nor XML; missions are GeoJSON, QGroundControl .plan, GPX, KML or hpr")


def _read_json(data: bytes, name: str) -> Draft:
    document, source = json_document(data, name)
    if not isinstance(document, dict):  # pragma: no cover - an object begins with a brace
        raise source.error(None, "is no JSON object")
    found: dict[str, Any] = document
    return qgc_plan.read(found, source) if found.get("fileType") == "Plan" else geojson.read(found, source)


def _read_xml(data: bytes, name: str) -> Draft:
    root = root_name(data) or tree(data, name, frozenset(), {}).name  # which says what is wrong with it
    if root == "gpx":
        return read_gpx(data, name)
    if root == "kml":
        return read_kml(data, name)
    if root == "HarvestedProduction":
        return read_hpr(data, name)
    raise MissionError(f"{name}: holds <{root[:40]}>, which is no mission; missions in XML are GPX, KML or hpr")


def verify(draft: Draft, *, route_wanted: bool = True, site: tuple[float, float] | None = None) -> None:
    """Raises MissionError with the lines of everything that keeps a draft from being driven."""
    found = problems_of(draft.mission, route_wanted, site)
    if found:
        raise draft.source.errors((None if key is None else draft.places.get(key), text) for key, text in found)


def save_mission(path: str | Path, mission: ForwardingMission) -> None:
    """Write a mission as GeoJSON.

    Raises:
        MissionError: the file cannot be written.
    """
    try:
        Path(path).write_bytes(geojson.write(mission))
    except (OSError, ValueError) as error:
        raise MissionError(f"{path}: cannot be written: {getattr(error, 'strerror', None) or error}") from None
