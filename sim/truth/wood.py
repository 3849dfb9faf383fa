"""The wood of a site: sizes, shapes and densities from which its logs are drawn."""

from __future__ import annotations

import msgspec


class Wood(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Length and mid diameter [m], diameter lost per metre (least, greatest); greatest sagitta of the bow over the
    length; density [kg/m^3] and its relative spread (one sigma).  Each log is drawn by ``sim.scenes.arrangements``.
    """

    length_m: tuple[float, float]
    diameter_m: tuple[float, float]
    taper_m_m: tuple[float, float]
    sweep_max: float
    density_kg_m3: float
    density_spread: float
