"""StanForD 2010 ``fpr``, forwarded production: the report of which logs were brought to which landing.

Written as version 3.6 with the elements in the order of its schema.  The standard counts loads and their parts; here a
part is one log, so that each has its own volume, place and time: ``LoadNumberOfItems`` is 1, and ``LoadingCoordinates``
is where and when the grapple took it.  Volumes are m3 over bark, lengths m; times have a time zone.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Final
from xml.etree.ElementTree import Element, SubElement, indent, tostring

from autonomy.missions.hpr import NAMESPACE
from autonomy.missions.model import Landing, MissionError, Point

VERSION: Final = "3.6"
VERSION_DATE: Final = "2020-02-07"
UNKNOWN: Final = "unknown"
_MAKER: Final = "timberhand"


@dataclass(frozen=True, slots=True)
class ForwardedLog:
    """One forwarded log: where and when it was loaded, its product, and its solid volume over bark [m3]."""

    taken_at: Point
    taken: datetime
    volume_m3: float
    species: str = ""
    assortment: str = ""
    product_key: int | None = None


@dataclass(frozen=True, slots=True)
class ForwardedLoad:
    """Logs unloaded together at one landing; ``driven_m`` since the previous unloading."""

    logs: tuple[ForwardedLog, ...]
    landing: Landing
    unloaded: datetime
    driven_m: float = 0.0


@dataclass(frozen=True, slots=True)
class Forwarder:
    """The forwarding machine: its id and model, and the name of the site."""

    machine_id: str
    model: str
    site: str


def write_fpr(loads: Sequence[ForwardedLoad], forwarder: Forwarder, written: datetime, application: str) -> bytes:
    """Write the report of loads as UTF-8 XML; ``application`` is the program's name and version.

    Raises:
        MissionError: a time without a time zone, an invalid volume, or an empty load.
    """
    _check(loads, written)
    products = _products(loads)
    species = {name: i for i, name in enumerate(sorted({p[0] for p in products}), 1)}
    landings = {landing: i for i, landing in enumerate(dict.fromkeys(load.landing for load in loads), 1)}
    root = Element(
        "ForwardedProduction",
        xmlns=NAMESPACE,
        areaUnit="ha",
        diameterUnit="mm",
        lengthUnit="cm",
        volumeUnit="m3",
        weightUnit="kg",
        version=VERSION,
        versionDate=VERSION_DATE,
        messageType="fpr",
    )
    header = SubElement(root, "ForwardedProductionHeader")
    for name in ("CreationDate", "ModificationDate"):
        _add(header, name, written.isoformat())
    for name in ("ApplicationVersionCreated", "ApplicationVersionModified"):
        _add(header, name, application)
    machine = SubElement(root, "Machine", machineCategory="Forwarder")
    _machine(machine, forwarder, application)
    for name, key in species.items():
        group = SubElement(machine, "SpeciesGroupDefinition")
        _user_id(group, "SpeciesGroupUserID", name)
        _add(group, "SpeciesGroupName", name)
        _add(group, "SpeciesGroupKey", key)
    for (kind, assortment, _), key in products.items():
        product = SubElement(machine, "ProductDefinition")
        _add(product, "ProductKey", key)
        classified = SubElement(product, "ClassifiedProductDefinition")
        _add(classified, "ProductName", assortment)
        _user_id(classified, "ProductUserID", f"{kind}.{assortment}")
        _add(classified, "SpeciesGroupKey", species[kind])
    site = SubElement(machine, "ObjectDefinition")
    _add(site, "ObjectKey", 1)
    _user_id(site, "ObjectUserID", forwarder.site or UNKNOWN)
    _add(site, "ObjectName", forwarder.site or UNKNOWN)
    for landing, key in landings.items():
        location = SubElement(machine, "LocationDefinition")
        _user_id(location, "LocationUserID", landing.name or f"landing {key}")
        _add(location, "LocationName", landing.name or f"landing {key}")
        _coordinates(location, "LocationCoordinates", landing.position, None)
        _add(location, "LocationKey", key)
        _add(location, "ObjectKey", 1)
    for key in products.values():
        delivery = SubElement(machine, "DeliveryDefinition")
        _add(delivery, "DeliveryKey", key)
        _add(delivery, "ProductKey", key)
    part = 0
    for number, load in enumerate(loads, 1):
        element = SubElement(machine, "Load")
        _add(element, "LoadKey", number)
        _add(element, "OperatorKey", 1)
        _add(element, "LoadNumber", number)
        _add(element, "DistanceFromLastUnloading", round(load.driven_m))
        _add(element, "UnloadingTime", load.unloaded.isoformat())
        for log in load.logs:
            part += 1
            _log(element, log, part, products[_product(log)], landings[load.landing])
    indent(root)
    body: bytes = tostring(root, "utf-8")
    return b'<?xml version="1.0" encoding="utf-8"?>\n' + body + b"\n"


def _check(loads: Sequence[ForwardedLoad], written: datetime) -> None:
    for number, load in enumerate(loads, 1):
        if not load.logs:
            raise MissionError("fpr.empty-load", f"load {number} has no logs; only report loads with logs")
        for log in load.logs:
            if not (math.isfinite(log.volume_m3) and log.volume_m3 > 0.0):
                raise MissionError("fpr.volume", f"load {number} has a log with a volume of {log.volume_m3:g} m3")
    times = [written, *(t for load in loads for t in (load.unloaded, *(log.taken for log in load.logs)))]
    if any(t.tzinfo is None for t in times):
        raise MissionError("fpr.no-time-zone", "a time has no time zone; give all times with one, for example UTC")


Product = tuple[str, str, int | None]


def _product(log: ForwardedLog) -> Product:
    return log.species or UNKNOWN, log.assortment or UNKNOWN, log.product_key


def _products(loads: Sequence[ForwardedLoad]) -> dict[Product, int]:
    """Choose the key of every product: the harvester's own if it is still free."""
    product_keys: dict[Product, int] = {}
    kinds = dict.fromkeys(_product(log) for load in loads for log in load.logs)
    for product in sorted(kinds, key=lambda p: (p[2] is None, p[2] or 0, p[:2])):
        key = product[2]
        taken = set(product_keys.values())
        product_keys[product] = key if key is not None and key > 0 and key not in taken else _free(taken)
    return product_keys


def _free(taken: set[int]) -> int:
    return next(i for i in range(1, len(taken) + 2) if i not in taken)


def _machine(machine: Element, forwarder: Forwarder, application: str) -> None:
    _add(machine, "MachineKey", hashlib.md5(forwarder.machine_id.encode(), usedforsecurity=False).hexdigest())
    _user_id(machine, "MachineUserID", forwarder.machine_id)
    _add(machine, "MachineApplicationVersion", application)
    _add(machine, "MachineBaseManufacturer", _MAKER)
    _add(machine, "MachineBaseModel", forwarder.model)
    _add(machine, "BaseMachineManufacturerID", forwarder.machine_id)
    operator = SubElement(machine, "OperatorDefinition")
    _add(operator, "OperatorKey", 1)
    _user_id(operator, "OperatorUserID", _MAKER)


def _log(load: Element, log: ForwardedLog, part: int, product: int, landing: int) -> None:
    partial = SubElement(load, "PartialLoad")
    _add(partial, "PartialLoadKey", part)
    _add(partial, "DeliveryKey", product)
    _add(partial, "LocationKey", landing)
    _add(partial, "LoadNumberOfItems", 1)
    volume = _add(partial, "LoadVolume", f"{log.volume_m3:.4f}")
    volume.set("loadVolumeCategory", "Volume, m3sob")
    _coordinates(partial, "LoadingCoordinates", log.taken_at, log.taken)


def _coordinates(parent: Element, name: str, at: Point, when: datetime | None) -> None:
    """Add a position; the schema requires a height, so an unknown one is written as 0."""
    element = SubElement(parent, name, coordinateReferenceSystem="WGS84")
    latitude = _add(element, "Latitude", f"{abs(at.latitude_deg):.8f}")
    latitude.set("latitudeCategory", "South" if at.latitude_deg < 0.0 else "North")
    longitude = _add(element, "Longitude", f"{abs(at.longitude_deg):.8f}")
    longitude.set("longitudeCategory", "West" if at.longitude_deg < 0.0 else "East")
    _add(element, "Altitude", f"{at.altitude_m or 0.0:.1f}")
    if when is not None:
        _add(element, "CoordinateDate", when.isoformat())


def _user_id(parent: Element, name: str, text: str) -> None:
    _add(parent, name, text).set("agency", "Other")


def _add(parent: Element, name: str, value: object) -> Element:
    element = SubElement(parent, name)
    element.text = "".join(_legal(str(value)))
    return element


def _legal(text: str) -> Iterator[str]:
    """Yield the characters allowed in XML; a control character in a name would make the report invalid."""
    return (c for c in text if c in "\t\n\r" or " " <= c < "\ud800" or "\ue000" <= c < "\ufffe" or c > "\uffff")
