"""Loads the ground truth about one individual machine.

``load_truth(choice, seed, machine)`` reads the machine's nominal file beside this one (or the file of the choice,
`sim.individual`) and, for ``"sampled"``, draws one individual around it; for ``"wide_valves"`` that individual gets
valves from the whole range of mobile valves, about which its profile knows nothing.  Equal choice, seed and machine
give the same truth.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any, Final

import msgspec

from sim.errors import PlantError
from sim.individual import DRAWN, split
from sim.truth.body import CarrierTruth, Contact, Home, Link, Steel, Structure
from sim.truth.hydraulics import Function, Supply
from sim.truth.sensors import CameraTruth, EncoderTruth, GnssTruth
from sim.truth.variation import Variation, VariationSampler
from sim.truth.wood import Wood

FILES = {"palms_471": "nominal.toml", "aoro_fc8": "nominal_aoro_fc8.toml"}
SHIPPED_SECTIONS: Final = ("home", "steel")
"""A truth file of a shipped machine without them has the shipped ones."""
JOINT_FUNCTIONS: Final = ("slew", "lift", "tilt", "ext", "rot")


class Truth(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Everything about the machine that the plant uses and the controller does not know."""

    machine: str
    home: Home
    steel: Steel
    links: dict[str, Link]
    structure: Structure
    contact: Contact
    supply: Supply
    functions: dict[str, Function]
    encoders: dict[str, EncoderTruth]
    spread: Variation
    wood: Wood
    cameras: dict[str, CameraTruth]
    gnss: GnssTruth | None = None
    carrier: CarrierTruth | None = None


def load_truth(choice: str, seed: int, machine: str) -> Truth:
    """Load the truth of a choice (`sim.individual`) for ``machine``; ``seed`` draws the individual.

    Raises:
        PlantError: the file is missing, incomplete, has unknown keys or describes another machine.
    """
    kind, path = split(choice)
    if path is None and machine not in FILES:
        raise PlantError(
            "truth.unknown-machine",
            f"there is no shipped truth for machine {machine!r}, only for {', '.join(FILES)}; put "
            f"{machine}.truth.toml beside its profile, or name a truth file",
        )
    try:
        content = _shipped(machine) if path is None else msgspec.toml.decode(path.read_bytes())
        truth = msgspec.convert(_with_shipped_sections(content), Truth)
    except (OSError, msgspec.DecodeError) as error:
        raise PlantError(
            "truth.unreadable",
            f"truth file {path or FILES[machine]}: {error}; use nominal, sampled, wide_valves or a complete TOML file",
        ) from None
    if truth.machine != machine:
        raise PlantError(
            "truth.other-machine",
            f"truth file {path} describes machine {truth.machine!r}, not {machine!r}; use the file of {machine!r}",
        )
    if kind not in DRAWN:
        return truth
    one = _sampled(truth, seed)
    return _with_wide_valves(truth, one, seed) if kind == "wide_valves" else one


def _with_shipped_sections(content: dict[str, Any]) -> dict[str, Any]:
    """Complete a file's content; a file about a shipped machine need not repeat what no individual varies."""
    machine = content.get("machine")
    if not isinstance(machine, str) or machine not in FILES:
        return content
    return {name: _shipped(machine)[name] for name in SHIPPED_SECTIONS} | content


@cache
def _shipped(machine: str) -> dict[str, Any]:
    """Read the content of a machine's shipped file; nobody writes to it."""
    content: dict[str, Any] = msgspec.toml.decode(Path(__file__).with_name(FILES[machine]).read_bytes())
    return content


def _sampled(truth: Truth, seed: int) -> Truth:
    """Draw one individual; every part draws from its own stream, so that a new part changes no other."""

    def draw(part: str) -> VariationSampler:
        return VariationSampler(truth.spread, part, seed)

    return msgspec.structs.replace(
        truth,
        links={n: link.sampled(draw(f"link {n}")) for n, link in truth.links.items()},
        structure=truth.structure.sampled(draw("structure")),
        supply=truth.supply.sampled(draw("supply")),
        functions={n: f.sampled(draw(f"function {n}")) for n, f in truth.functions.items()},
        encoders={n: e.sampled(draw(f"encoder {n}")) for n, e in truth.encoders.items()},
        cameras={n: c.sampled(draw(f"camera {n}")) for n, c in truth.cameras.items()},
        gnss=truth.gnss and truth.gnss.sampled(draw("gnss")),
        carrier=truth.carrier and truth.carrier.sampled(draw("carrier")),
    )


def _with_wide_valves(nominal: Truth, truth: Truth, seed: int) -> Truth:
    """Give the same individual other valves on its joints; grapple and carrier keep theirs: nobody maps them."""

    def changed(name: str, function: Function) -> Function:
        if name not in JOINT_FUNCTIONS:
            return function
        draw = VariationSampler(truth.spread, f"wide valve {name}", seed)
        return Function(function.cylinder, function.valve.widely_sampled(draw, nominal.functions[name].valve))

    functions = {name: changed(name, function) for name, function in truth.functions.items()}
    return msgspec.structs.replace(truth, functions=functions)
