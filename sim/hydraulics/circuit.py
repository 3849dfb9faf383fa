"""Load-sensing hydraulics of all functions: compressible chambers drive the joints by torque.

docs/reference/plant-model.md section 2, docs/reference/machines.md section 3: valves with dead time, second-order
spool, hysteresis and dead-band; pressure-compensated metering in and out, so a lowered load moves at valve speed and a
neutral valve holds it; one pump, whose flow the valve block shares; chambers never below zero; Stribeck friction;
damping orifices that pass only oscillating pressure; a locked grapple; float valves of the swing arms.  Units: SI.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from sim.errors import PlantError
from sim.hydraulics import layout
from sim.hydraulics.kernel import STEADY_S, advance
from sim.truth.load import Truth

SUBSTEP_COUNT: Final = 4
REST_PA: Final = 1.0e6  # in the unloaded chamber at the start
AXLES: Final = {"front": "arm_fl", "rear": "arm_rl"}  # the right arm follows its left one


class Hydraulics:
    """All functions of a machine on its pump; ``names`` is the order of all sequences."""

    def __init__(self, truth: Truth, step_s: float, substeps: int = SUBSTEP_COUNT) -> None:
        self.names: Final = tuple(truth.functions)
        n = len(self.names)
        self._bulk_pa = truth.supply.bulk_modulus_pa
        self._step_s, self._substeps = step_s, substeps
        self._pump = layout.pump(truth.supply)
        self._constants, self._tables = layout.functions(truth, step_s)
        self._states = np.zeros(n, layout.STATE)
        self._balance = np.zeros(1, layout.BALANCE)
        self._lines = np.zeros((n, int(self._constants["delay_steps"].max())))
        self._commands, self._q, self._qd, self._torques = (np.zeros(n) for _ in range(4))
        self._floating: str | None = None
        self.burst: set[tuple[str, str]] = set()
        """Hoses that have burst, as function and chamber ("a" or "b"): no pressure there, the oil runs out."""
        # Without a check valve the port is always open.
        self._states["poppet"] = self._constants["check_ratio"] == 0.0
        self.supply_pa = self._balance["supply"][0] = truth.supply.pressure_margin_pa

    def hold(self, torques: Sequence[float], q: Sequence[float]) -> None:
        """Start at rest at ``q`` with the pressures that balance ``torques`` [Nm, N] (+ in the joint's direction)."""
        s, c = self._states, self._constants
        at = np.asarray(q, float)
        for i, (arm, travel) in enumerate(self._tables):
            grid = c["lever_low"][i] + c["lever_step"][i] * np.arange(layout.LEVER_POINT_COUNT)
            s["arm"][i], s["travel"][i] = np.interp(at[i], grid, arm), np.interp(at[i], grid, travel)
        force = np.asarray(torques, float) / s["arm"]
        s["pressure_a"] = REST_PA * c["area_b"] / c["area_a"] + np.maximum(0.0, force / c["area_a"])
        s["pressure_b"] = REST_PA + np.maximum(0.0, -force / c["area_b"])
        s["hose_a"], s["hose_b"] = s["pressure_a"], s["pressure_b"]
        s["q"], s["qd"], s["torque"], s["driven"] = at, 0.0, torques, torques

    def step(self, commands: Sequence[float], q: Sequence[float], qd: Sequence[float]) -> list[float]:
        """Compute mean joint torques [Nm, N] of one physics step; commands -1..1, ``q``, ``qd`` of the joints now."""
        self._commands[:], self._q[:], self._qd[:] = commands, q, qd
        for name, chamber in self.burst:
            at = self.names.index(name)
            self._states[f"pressure_{chamber}"][at] = self._states[f"hose_{chamber}"][at] = 0.0
        floating = -1 if self._floating is None else self.names.index(AXLES[self._floating])
        self.supply_pa = advance(
            *(self._constants, self._states, self._tables, self._lines, self._pump, self._balance, floating),
            *(self._commands, self._q, self._qd, self._step_s, self._substeps, self._torques),
        )
        return self._torques.tolist()

    @property
    def pressures_pa(self) -> dict[str, tuple[float, float]]:
        """Chambers A and B of every function; A pushes in the direction of a positive command."""
        s = self._states
        pairs = zip(s["pressure_a"].tolist(), s["pressure_b"].tolist(), strict=True)
        return dict(zip(self.names, pairs, strict=True))

    @property
    def spools(self) -> dict[str, float]:
        """Spool positions, -1..1 of the stroke."""
        return dict(zip(self.names, self._states["spool"].tolist(), strict=True))

    @property
    def flow_limited(self) -> bool:
        """Whether the functions demand more flow than the pump delivers."""
        return bool(self._balance["limited"][0])

    @property
    def energy_j(self) -> float:
        """Energy from the pump (and, slightly, from the tank) since the start."""
        return float(self._balance["energy_in"][0])

    @property
    def energy_out_j(self) -> float:
        """Work done on the joints since the start, less the drives' friction; driving loads count negative."""
        return float(self._balance["energy_out"][0])

    @property
    def loss_j(self) -> float:
        """Energy lost as heat in edges, valves, leaks and seals since the start; never decreases."""
        return float(self._balance["loss"][0])

    @property
    def stored_j(self) -> float:
        """Energy in the compressed oil of chambers and hoses now."""
        s, c = self._states, self._constants
        volume_a = c["dead_volume"] + c["swept_a"] * s["travel"]
        volume_b = c["dead_volume"] + c["swept_b"] * (c["stroke"] - s["travel"])
        hose = c["relaxation"] * STEADY_S
        total = volume_a * (s["pressure_a"] ** 2 + hose * s["hose_a"] ** 2)
        total += volume_b * (s["pressure_b"] ** 2 + hose * s["hose_b"] ** 2)
        return float(total.sum() / (2.0 * self._bulk_pa))

    @property
    def relief_pa(self) -> float:
        """Relief pressure of the pump; a low value makes the supply break down."""
        return float(self._pump["relief"][0])

    @relief_pa.setter
    def relief_pa(self, value: float) -> None:
        self._pump["relief"][0] = value

    @property
    def peak_pa(self) -> float:
        """Highest chamber pressure since the start."""
        return float(self._balance["peak"][0])

    def _float(self, axle: str, value: bool) -> None:
        if value and AXLES[axle] not in self.names:
            raise PlantError(
                "hydraulics.no-swing-arms",
                f"float valve of the {axle} axle: this machine has no swing arms; leave the valve closed",
            )
        if value and self._floating not in (None, axle):
            raise PlantError(
                "hydraulics.other-axle-floats",
                f"float valve of the {axle} axle: the {self._floating} axle already floats; close its valve first",
            )
        if value:
            self._floating = axle
        elif self._floating == axle:
            self._floating = None

    @property
    def float_front(self) -> bool:
        """Whether the front arms are cross-connected left to right; never both axles
        (docs/reference/machines.md section 7.3).
        """
        return self._floating == "front"

    @float_front.setter
    def float_front(self, value: bool) -> None:
        self._float("front", value)

    @property
    def float_rear(self) -> bool:
        """Whether the rear arms are cross-connected left to right."""
        return self._floating == "rear"

    @float_rear.setter
    def float_rear(self, value: bool) -> None:
        self._float("rear", value)
