"""The truth about one individual machine, hidden from everything outside ``sim``.

``load_truth(name, seed)`` reads ``nominal.toml`` beside this file (or any TOML path) and, for ``"sampled"``, draws
one individual around it.  Same name and seed, same truth.  A missing or unknown key raises ``msgspec`` errors that
name the key.
"""

from __future__ import annotations

import random
from pathlib import Path

import msgspec


class Link(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Mass [kg], centre of mass in the link frame [m], principal inertia about it [kg m^2]."""

    mass_kg: float
    com_m: tuple[float, float, float]
    inertia_kg_m2: tuple[float, float, float]


class Structure(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Damping of the two passive joints above the rotator."""

    hanger_damping_nm_s_rad: float
    fork_damping_nm_s_rad: float


class Contact(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Friction (product rule of the two bodies), rolling resistance and the density of the logs."""

    log_friction: float
    ground_friction: float
    tong_friction: float
    bunk_friction: float
    log_rolling_m: float
    log_density_kg_m3: float
    log_density_spread: float


class Supply(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Load-sensing pump, tank and oil."""

    pump_flow_m3_s: float
    pressure_margin_pa: float
    relief_pa: float
    tank_pa: float
    bulk_modulus_pa: float
    leakage_m3_s_pa: float


class Cylinder(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Piston areas [m^2] (slew: m^3/rad), lever arm dx/dq [m/rad] over the joint position, friction [N, N s/m]."""

    area_a: float
    area_b: float
    dead_volume_m3: float
    arm_at: tuple[float, ...]
    arm: tuple[float, ...]
    arm_nominal: float
    coulomb: float
    coulomb_speed: float
    viscous: float
    relaxation_1_s: float


class ValveTruth(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Dead time, second-order spool, dead-band of either side (fraction), joint speed at full spool."""

    delay_s: float
    spool_rad_s: float
    spool_zeta: float
    deadband_plus: float
    deadband_minus: float
    full_speed_plus: float
    full_speed_minus: float


class Motors(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Torque limits of rotator and tongs; the chamber pressure that stands for the full tong torque."""

    rotator_torque_nm: float
    tong_torque_nm: float
    tong_pressure_pa: float
    tong_sync_1_s: float


class EncoderTruth(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Errors of one encoder in the joint's unit: offset, eccentricity (once per turn), noise; latency."""

    offset: float
    eccentricity: float
    phase_rad: float
    noise: float
    latency_s: float


class Spread(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One-sigma relative spreads of a sampled individual; encoder offsets absolute."""

    mass: float
    deadband: float
    delay: float
    gain: float
    friction: float
    pump: float
    bulk: float
    offset_rad: float


class Truth(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Everything the plant knows and the controller does not."""

    schema: int
    links: dict[str, Link]
    structure: Structure
    contact: Contact
    supply: Supply
    cylinders: dict[str, Cylinder]
    valves: dict[str, ValveTruth]
    motors: Motors
    encoders: dict[str, EncoderTruth]
    spread: Spread


def load_truth(name: str, seed: int) -> Truth:
    """``"nominal"``, ``"sampled"`` (an individual drawn from ``seed``) or the path of a truth file.

    Raises:
        ValueError: one sentence that names the file and what is wrong.
    """
    path = Path(__file__).with_name("nominal.toml") if name in ("nominal", "sampled") else Path(name)
    try:
        truth = msgspec.toml.decode(path.read_bytes(), type=Truth)
    except (OSError, msgspec.DecodeError) as error:
        raise ValueError(f"truth file {path}: {error}; use nominal, sampled or a complete TOML file") from None
    return _sample(truth, random.Random(f"truth {seed}")) if name == "sampled" else truth


def _sample(truth: Truth, rng: random.Random) -> Truth:
    """One individual: every spread is a normal draw cut at two sigma."""

    def factor(sigma: float) -> float:
        return 1.0 + max(-2.0 * sigma, min(2.0 * sigma, rng.gauss(0.0, sigma)))

    s, replace = truth.spread, msgspec.structs.replace
    links = {}
    for name, link in truth.links.items():
        scale = factor(s.mass)
        inertia = tuple(scale * i for i in link.inertia_kg_m2)
        links[name] = replace(link, mass_kg=scale * link.mass_kg, inertia_kg_m2=inertia)
    cylinders = {
        name: replace(c, coulomb=c.coulomb * factor(s.friction), viscous=c.viscous * factor(s.friction))
        for name, c in truth.cylinders.items()
    }
    valves = {
        name: replace(
            v,
            delay_s=v.delay_s * factor(s.delay),
            deadband_plus=v.deadband_plus * factor(s.deadband),
            deadband_minus=v.deadband_minus * factor(s.deadband),
            full_speed_plus=v.full_speed_plus * factor(s.gain),
            full_speed_minus=v.full_speed_minus * factor(s.gain),
        )
        for name, v in truth.valves.items()
    }
    encoders = {
        name: replace(e, offset=e.offset + (factor(s.offset_rad) - 1.0), phase_rad=rng.uniform(0.0, 6.28))
        for name, e in truth.encoders.items()
    }
    supply = replace(
        truth.supply,
        pump_flow_m3_s=truth.supply.pump_flow_m3_s * factor(s.pump),
        bulk_modulus_pa=truth.supply.bulk_modulus_pa * factor(s.bulk),
    )
    return replace(truth, links=links, cylinders=cylinders, valves=valves, encoders=encoders, supply=supply)
