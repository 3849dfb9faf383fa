"""StanForD 2010 ``hpr``, a harvester's production: the felled logs become the known logs of a mission.

Read from ``HarvestedProduction`` in the namespace ``urn:skogforsk:stanford2010`` (versions 2 and 3): species groups and
products by key, and per stem its coordinates and its logs.  Lengths are cm, diameters mm, volumes m3.

The file does not say where a log came to lie.  Its best position is where the crane's tip felled the tree; if it only
has the harvester's own position, the log lies within its crane's reach.  ``sigma_m`` tells the two apart.  Logs of one
stem share one position, and their direction is unknown.
"""

from __future__ import annotations

import math
from typing import Final

from autonomy.missions.features import Draft, Key
from autonomy.missions.gpx_kml import decimal
from autonomy.missions.model import MAX_LOGS, ForwardingMission, KnownLog, Point, is_product_key
from autonomy.missions.source import Place, Source
from autonomy.missions.validation import DIAMETERS_M, LENGTHS_M
from autonomy.missions.xml_tree import ANY, Element, tree
from runtime.errors import InputRefused

HPR: Final = "StanForD 2010 hpr"
NAMESPACE: Final = "urn:skogforsk:stanford2010"
TIP_SIGMA_M: Final = 4.0
"""A stem is processed beside its stump: about half its length away [est]."""
MACHINE_SIGMA_M: Final = 7.0
"""A log lies within the 10 m of a harvester's crane from the machine [est]."""

_WANTED: Final = frozenset(
    {
        "Machine",
        "SpeciesGroupDefinition",
        "SpeciesGroupKey",
        "SpeciesGroupName",
        "ProductDefinition",
        "ProductKey",
        "ClassifiedProductDefinition",
        "UnclassifiedProductDefinition",
        "ProductName",
        "Stem",
        "StemKey",
        "StemNumber",
        "StemCoordinates",
        "Coordinates",
        "Latitude",
        "Longitude",
        "SingleTreeProcessedStem",
        "MultiTreeProcessedStem",
        "Log",
        "LogKey",
        "LogVolume",
        "LogMeasurement",
        "LogDiameter",
        "LogLength",
        "ObjectDefinition",
        "ObjectName",
    }
)
_LIMITS: Final = {"Log": (MAX_LOGS, "logs"), "Stem": (MAX_LOGS, "stems"), ANY: (400_000, "elements")}
_UNITS: Final = {"lengthUnit": "cm", "diameterUnit": "mm", "volumeUnit": "m3"}
_MIDDLE: Final = ("Mid ob", "Mid ub")
_ENDS: Final = ("Butt ob", "Top ob")


def read_hpr(data: bytes, name: str) -> Draft:
    """Read the logs of a harvester's production, as a mission without a route.

    Raises:
        MissionError: not an hpr, a coordinate system other than WGS84, other units, or an invalid value.
    """
    root = tree(data, name, _WANTED, _LIMITS, "HarvestedProduction")
    source = Source(name)
    if root.namespace != NAMESPACE:
        sentence = f'the namespace "{root.namespace[:60]}" is not {NAMESPACE}, StanForD 2010'
        raise source.error("hpr.namespace", root.line, sentence)
    if root.attributes.get("messageType", "hpr") != "hpr":
        sentence = f"message type {root.attributes['messageType'][:20]!r}; logs come from an hpr"
        raise source.error("hpr.message-type", root.line, sentence)
    for attribute, unit in _UNITS.items():
        given = root.attributes.get(attribute, unit)
        if given.strip().lower() != unit:
            sentence = f'{attribute} is "{given[:20]}"; StanForD 2010 has {unit}, so export the file anew'
            raise source.error("hpr.unit", root.line, sentence)
    logs: list[KnownLog] = []
    places: dict[Key, Place] = {}
    lost = several = unnamed = cut_offs = 0
    title = ""
    for machine in root.all("Machine"):
        title = title or machine.value("ObjectDefinition", "ObjectName")
        species = {
            s.value("SpeciesGroupKey"): s.value("SpeciesGroupName") for s in machine.all("SpeciesGroupDefinition")
        }
        products = {p.value("ProductKey"): _product_name(p) for p in machine.all("ProductDefinition")}
        for stem in machine.all("Stem"):
            for processed in stem.children:
                log_elements = list(processed.all("Log"))
                at = _position((stem, processed), source) if log_elements else None
                if at is None:
                    lost += len(log_elements)
                    continue
                for element in log_elements:
                    log = _log(element, stem, *at, species, products, source)
                    if log.length_m is not None and (
                        log.length_m < LENGTHS_M[0] or log.length_m <= (log.diameter_m or 0.0) <= DIAMETERS_M[1]
                    ):
                        cut_offs += 1
                        continue
                    several += len(list(element.all("LogMeasurement"))) > 1
                    unnamed += bool(element.value("ProductKey")) and log.product_key is None
                    places[("log", len(logs))] = element.line
                    logs.append(log)
    draft = Draft(ForwardingMission(title, logs=tuple(logs)), source, HPR, places)
    if lost:
        sentence = f"{lost} logs of stems without coordinates are left out; the machine is not told of them"
        draft.warn("hpr.no-coordinates", None, sentence)
    if not logs:
        draft.warn("hpr.no-logs", root.line, "no log is read from this file")
    if several:
        draft.notes.append(
            f"{several} logs were measured more than once; one measurement is read, the harvester's if it is marked"
        )
    if cut_offs:
        draft.notes.append(
            f"{cut_offs} cut-offs shorter than {LENGTHS_M[0]:g} m, or no longer than they are thick, are left out"
        )
    if unnamed:
        draft.notes.append(
            f"{unnamed} logs have a product key that is no integer from 1; the report will not name their product"
        )
    return draft


def _product_name(product: Element) -> str:
    return product.value("ClassifiedProductDefinition", "ProductName") or product.value(
        "UnclassifiedProductDefinition", "ProductName"
    )


def _position(owners: tuple[Element, ...], source: Source) -> tuple[Point, float] | None:
    """Find where a stem was felled and the position's sigma [m], or None; some makers write it at the processing."""
    best: tuple[Point, float] | None = None
    for given in (given for owner in owners for given in owner.all("StemCoordinates", "Coordinates")):
        system = given.attributes.get("coordinateReferenceSystem", "WGS84")
        if system.replace(" ", "").upper() != "WGS84":
            sentence = f'coordinates are in "{system[:40]}"; a mission is in WGS84'
            raise source.error("mission.datum", given.line, sentence)
        latitude, longitude = given.first("Latitude"), given.first("Longitude")
        if latitude is None or longitude is None:
            continue
        at = Point(_angle(latitude, "north", "south", source), _angle(longitude, "east", "west", source))
        if not at.latitude_deg and not at.longitude_deg:
            continue  # the receiver had no fix
        tip = given.attributes.get("receiverPosition", "").startswith("Crane tip")
        if tip or best is None:
            best = at, TIP_SIGMA_M if tip else MACHINE_SIGMA_M
    return best


def _angle(element: Element, positive: str, negative: str, source: Source) -> float:
    value = _number(element, source)
    name = f"{element.name.lower()}Category"
    category = element.attributes.get(name, positive)
    if category.lower() not in (positive, positive[0], negative, negative[0]):
        sentence = f'{name} is "{category[:40]}"; it is {positive.title()} or {negative.title()}'
        raise source.error("hpr.category", element.line, sentence)
    if value < 0.0 and name in element.attributes:
        sentence = f'{element.name} is {element.text.strip()} and {name} "{category}"; only one may tell the half'
        raise source.error("hpr.category", element.line, sentence)
    return value if category.lower().startswith(positive[0]) else -value


def _log(
    log: Element,
    stem: Element,
    at: Point,
    sigma_m: float,
    species: dict[str, str],
    products: dict[str, str],
    source: Source,
) -> KnownLog:
    key = log.first("ProductKey")
    measurement = _measurement(log)
    length = None if measurement is None else measurement.first("LogLength")
    product = None if key is None or not key.text.strip() else _number(key, source)
    return KnownLog(
        at,
        f"{stem.value('StemKey') or stem.value('StemNumber')}/{log.value('LogKey')}",
        None,
        None if length is None else _number(length, source) / 100.0,
        _diameter_m(log, measurement, length, source),
        species.get(stem.value("SpeciesGroupKey"), "") or species.get(_species_key(stem), ""),
        "" if key is None else products.get(key.text.strip(), ""),
        int(product) if product is not None and is_product_key(product) else None,
        sigma_m,
    )


def _species_key(stem: Element) -> str:
    """Read the key of the species: trees processed together carry their species themselves."""
    return next((child.value("SpeciesGroupKey") for child in stem.children if child.first("SpeciesGroupKey")), "")


def _measurement(log: Element) -> Element | None:
    """Choose the harvester's own measurement of a log, else the first: values of two measurements are never mixed."""
    measured = list(log.all("LogMeasurement"))
    own = (m for m in measured if m.attributes.get("logMeasurementCategory") == "Machine")
    return next(own, measured[0] if measured else None)


def _diameter_m(log: Element, measurement: Element | None, length: Element | None, source: Source) -> float | None:
    """Return the diameter at the middle over bark, else the mean of both ends, else that from the volume."""
    given = {
        d.attributes.get("logDiameterCategory", ""): d
        for d in (() if measurement is None else measurement.all("LogDiameter"))
    }
    for name in _MIDDLE:
        if name in given:
            return _number(given[name], source) / 1000.0
    ends = [_number(given[name], source) / 1000.0 for name in _ENDS if name in given]
    if len(ends) == len(_ENDS):
        return sum(ends) / len(ends)
    volumes = {v.attributes.get("logVolumeCategory", ""): v for v in log.all("LogVolume")}
    solid = volumes.get("m3sob") or volumes.get("m3sub")
    if solid is not None and length is not None:
        volume, length_m = _number(solid, source), _number(length, source) / 100.0
        if volume > 0.0 and length_m > 0.0:
            return math.sqrt(4.0 * volume / (math.pi * length_m))
    return ends[0] if ends else None


def _number(element: Element, source: Source) -> float:
    try:
        value = decimal(element.text, element.name)
    except InputRefused as error:
        raise source.error(error.code, element.line, str(error)) from None
    if not math.isfinite(value):
        sentence = f"{element.name} is {element.text.strip()}, which is not finite"
        raise source.error("mission.number", element.line, sentence)
    return value
