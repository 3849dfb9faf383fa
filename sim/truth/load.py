"""The truth about one individual machine, hidden from everything outside ``sim``.

``load_truth(name, seed, machine)`` reads the machine's nominal file beside this one (or any TOML path) and, for
``"sampled"``, draws one individual around it.  Same name, seed and machine, same truth.  A missing or unknown key
raises ``ValueError`` that names the file and the key.
"""

from __future__ import annotations

from pathlib import Path

import msgspec

from sim.truth.body import Contact, Link, Structure
from sim.truth.carrier import CarrierTruth
from sim.truth.encoders import EncoderTruth
from sim.truth.hydraulics import Function, Supply
from sim.truth.sensors import CameraTruth, GnssTruth
from sim.truth.variation import Variation, VariationSampler
from sim.truth.wood import Wood

FILES = {"palms_471": "nominal.toml", "aoro_fc8": "nominal_aoro_fc8.toml"}


class Truth(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Everything the plant knows and the controller does not."""

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
        ValueError: one sentence that names the file and what is wrong.
    """
    if name in ("nominal", "sampled"):
        if machine not in FILES:
            raise ValueError(f"no truth for machine {machine!r}; use {', '.join(FILES)} or the path of a truth file")
        path = Path(__file__).with_name(FILES[machine])
    else:
        path = Path(name)
    try:
        truth = msgspec.toml.decode(path.read_bytes(), type=Truth)
    except (OSError, msgspec.DecodeError) as error:
        raise ValueError(f"truth file {path}: {error}; use nominal, sampled or a complete TOML file") from None
    if truth.machine != machine:
        raise ValueError(f"truth file {path} is of machine {truth.machine!r}, not of {machine!r}; use the right file")
    return _sampled(truth, seed) if name == "sampled" else truth


def _sampled(truth: Truth, seed: int) -> Truth:
    """One individual; every part draws by its own name, so that a new part changes no other."""

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
