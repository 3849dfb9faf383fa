"""The matrix of truths: every parameter at both of its ends, named combinations, and all drawn at once.

A truth is the machine's nominal file with some numbers changed; nothing else of the plant knows of it.
"""

from __future__ import annotations

import random
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import tomlkit

import sim
from runtime.errors import InputRefused
from sim.ground.terrain import KINDS
from sim.individual import split

NOMINAL: Final = {"palms_471": "nominal.toml", "aoro_fc8": "nominal_aoro_fc8.toml"}
JOINTS: Final = ("slew", "lift", "tilt", "ext", "rot")
DRAWN: Final = "drawn"
"""Prefix of truths with everything drawn: drawn-0, drawn-1, ..."""
UNSEEN: Final = "unseen"
"""Prefix of truths with everything drawn, and a wood for missions: unseen-0, ..."""
MISSION: Final = "mission"
"""Kind of a job that drives a mission, and its outcome."""
WOOD: Final = {"length_m": [1.7, 2.6], "diameter_m": [0.11, 0.32]}
"""Logs of missions, from the thinnest top to the thickest butt that lies in one stand."""


@dataclass(frozen=True, slots=True)
class Parameter:
    """What is changed: places in the truth file ("*" is every key), and by how much at either end.

    ``absolute``: the ends are values, else factors on the nominal ones.  ``each``: a drawn truth draws every place for
    itself.
    """

    title: str
    places: tuple[tuple[str, ...], ...]
    low: float
    high: float
    absolute: bool = False
    each: bool = False


def _valves(*keys: str) -> tuple[tuple[str, ...], ...]:
    return tuple(("functions", joint, "valve", key) for joint in JOINTS for key in keys)


PARAMETERS: Final = {
    "deadband": Parameter(
        "Dead-bands, share of the stroke", _valves("deadband_plus", "deadband_minus"), 0.03, 0.30, True, True
    ),
    "delay": Parameter("Dead times of the valves [s]", _valves("delay_s"), 0.02, 0.25, True, True),
    "gain": Parameter("Full speeds", _valves("full_speed_plus", "full_speed_minus"), 1.0 / 3.0, 3.0, False, True),
    "mass": Parameter("Masses of the links", (("links", "*", "mass_kg"),), 0.75, 1.3),
    "steel": Parameter(
        "Stiffness of the column", (("structure", "flex_pitch_nm_rad"), ("structure", "flex_roll_nm_rad")), 0.6, 1.5
    ),
    "wood": Parameter("Density of the wood", (("wood", "density_kg_m3"),), 0.75, 1.25),
    "bow": Parameter("Bow of the logs", (("wood", "sweep_max"),), 0.3, 2.0),
    "bark": Parameter("Friction of bark on steel", (("contact", "tong_friction"),), 0.7, 1.3),
    "stereo": Parameter("Noise of the stereo cameras", (("cameras", "*", "disparity_sigma_px"),), 0.5, 2.0),
    "oil": Parameter("Bulk modulus of the oil", (("supply", "bulk_modulus_pa"),), 0.7, 1.3),
    "pump": Parameter("Flow of the pump", (("supply", "pump_flow_m3_s"),), 0.8, 1.2),
}
COMBINED: Final[dict[str, tuple[str, tuple[tuple[str, float, bool], ...]]]] = {
    "late-and-wide": (
        "Dead-bands x 1.5 with a delay of 150 ms",
        (("deadband", 1.5, False), ("delay", 0.150, True)),
    ),
}
"""Named combinations: title, and for each parameter the value and whether it is absolute."""


def names(drawn: int) -> list[str]:
    """Name all truths but those of missions: both ends of every parameter, the combinations, and so many drawn ones."""
    ends = [f"{name}-{end}" for name in PARAMETERS for end in ("low", "high")]
    return [*ends, *COMBINED, *(f"{DRAWN}-{i}" for i in range(drawn))]


def title_of(name: str) -> str:
    """Name a truth in words."""
    kind, _, end = name.rpartition("-")
    if kind in PARAMETERS:
        known = PARAMETERS[kind]
        value = known.low if end == "low" else known.high
        return f"{known.title}{'' if known.absolute else ' x'} {value:.3g}"
    if kind == UNSEEN:
        return f"Mission {end}, ground: {ground_of(name)}"
    return COMBINED[name][0] if name in COMBINED else f"Everything drawn, machine {end}"


def is_drawn(name: str) -> bool:
    """Tell whether the truth has everything drawn, for single logs."""
    return name.startswith(f"{DRAWN}-")


def is_mission(name: str) -> bool:
    """Tell whether the truth is that of a mission."""
    return name.startswith(f"{UNSEEN}-")


def ground_of(name: str) -> str:
    """Return the kind of ground of a mission; they alternate."""
    return KINDS[int(name.rpartition("-")[2]) % len(KINDS)]


def nominal_file(profile: str, truth: str) -> Path:
    """Find the file to change: of the choice of ``--truth`` (`sim.individual`), or of the shipped machine ``profile``.

    Raises:
        InputRefused: neither is known.
    """
    own = split(truth)[1]
    if own is not None:
        return own
    if profile not in NOMINAL:
        raise InputRefused(
            "generalization.no-truth",
            f"{profile} has no truth to vary; put NAME.truth.toml beside it, or name a file with --truth",
        )
    return Path(sim.__file__).parent / "truth" / NOMINAL[profile]


def write_truth(nominal: Path, name: str, seed: int, folder: Path) -> tuple[Path, dict[str, Any]]:
    """Write the truth ``name`` as a file; returns it with its content.

    ``nominal``: the file of the machine that is changed; ``seed`` is for drawn ones.

    Raises:
        InputRefused: there is no such truth.
    """
    document = tomlkit.parse(nominal.read_text())
    kind, _, end = name.rpartition("-")
    if kind in (DRAWN, UNSEEN):
        rng = random.Random(f"generalization {seed}")
        for parameter in PARAMETERS.values():
            _draw(document, parameter, rng)
        if kind == UNSEEN:
            document["wood"].update(WOOD)
    elif kind in PARAMETERS:
        known = PARAMETERS[kind]
        _change(document, known, known.low if end == "low" else known.high, known.absolute)
    elif name in COMBINED:
        for parameter_name, value, absolute in COMBINED[name][1]:
            _change(document, PARAMETERS[parameter_name], value, absolute)
    else:
        raise InputRefused(
            "generalization.unknown-truth", f"there is no truth {name!r}; see experiments/generalization"
        )
    path = folder / f"{document['machine']}-{name}.toml"
    path.write_text(tomlkit.dumps(document))
    return path, document.unwrap()


def _found(document: Any, place: tuple[str, ...]) -> Iterator[tuple[Any, str]]:
    """Find the tables and keys of a place that exist; "*" is every key of its table."""
    key, *rest = place
    for k in list(document) if key == "*" else [key]:
        if k not in document:
            continue
        if rest:
            yield from _found(document[k], tuple(rest))
        else:
            yield document, k


def _change(document: Any, parameter: Parameter, value: float, absolute: bool) -> None:
    for location in parameter.places:
        for table, key in _found(document, location):
            table[key] = value if absolute else float(table[key]) * value


def _draw(document: Any, parameter: Parameter, rng: random.Random) -> None:
    def value() -> float:
        return float(parameter.low * (parameter.high / parameter.low) ** rng.random())

    common = value()
    for location in parameter.places:
        for table, key in _found(document, location):
            drawn = value() if parameter.each else common
            table[key] = drawn if parameter.absolute else float(table[key]) * drawn
