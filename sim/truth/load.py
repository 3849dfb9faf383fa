"""Loads the ground truth about one individual machine.

``load_truth(name, seed, machine)`` reads the machine's nominal file beside this one (or any TOML path) and, for
``"sampled"``, draws one individual around it.  Equal name, seed and machine give the same truth.
"""

from __future__ import annotations

from pathlib import Path

import msgspec

from sim.errors import PlantError
from sim.truth.body import Contact, Link, Structure
from sim.truth.carrier import CarrierTruth
from sim.truth.encoders import EncoderTruth
from sim.truth.hydraulics import Function, Supply
from sim.truth.sensors import CameraTruth, GnssTruth
from sim.truth.variation import Variation, VariationSampler
from sim.truth.wood import Wood

FILES = {"palms_471": "nominal.toml", "aoro_fc8": "nominal_aoro_fc8.toml"}


class Truth(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Everything about the machine that the plant uses and the controller does not know."""

    machine: str
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


def load_truth(name: str, seed: int, machine: str) -> Truth:
    """``"nominal"``, ``"sampled"`` (an individual drawn from ``seed``) or the path of a truth file, for ``machine``.

    Raises:
        PlantError: the file is missing, incomplete, has unknown keys or describes another machine.
    """
    if name in ("nominal", "sampled"):
        if machine not in FILES:
            raise PlantError(
                "truth.unknown-machine",
                f"there is no truth for machine {machine!r}; use {', '.join(FILES)} or the path of a truth file",
            )
        path = Path(__file__).with_name(FILES[machine])
    else:
        path = Path(name)
    try:
        truth = msgspec.toml.decode(path.read_bytes(), type=Truth)
    except (OSError, msgspec.DecodeError) as error:
        raise PlantError(
            "truth.unreadable", f"truth file {path}: {error}; use nominal, sampled or a complete TOML file"
        ) from None
    if truth.machine != machine:
        raise PlantError(
            "truth.other-machine",
            f"truth file {path} describes machine {truth.machine!r}, not {machine!r}; use the file of {machine!r}",
        )
    return _sampled(truth, seed) if name == "sampled" else truth


def _sampled(truth: Truth, seed: int) -> Truth:
    """One individual; every part draws from its own stream, so that a new part changes no other."""

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
