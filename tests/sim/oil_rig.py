"""Hydraulic functions on bare inertias: each joint is one mass with a constant load, stepped as in Bullet."""

from __future__ import annotations

import hashlib
import random
import struct
from collections.abc import Mapping

import msgspec

from machine.geometry.carrier import ARMS
from sim.hydraulics.circuit import Hydraulics
from sim.truth.hydraulics import Cylinder, Function
from sim.truth.load import Truth, load_truth

STEP_S = 0.0025
PALMS = load_truth("nominal", 0, "palms_471")
AORO = load_truth("nominal", 0, "aoro_fc8")
replace = msgspec.structs.replace
AORO_HEAVY = {
    "slew": 8000.0,
    "lift": 2.5e4,
    "tilt": 6000.0,
    "ext": 400.0,
    "rot": 15.0,
    "grapple": 17.0,
    "steer": 8000.0,
} | dict.fromkeys(ARMS, 2500.0)
FRICTIONLESS = {"coulomb": 0.0, "stiction": 0.0, "viscous": 0.0}


def even(cylinder: Cylinder, **changes: float) -> Cylinder:
    """The cylinder with its nominal lever arm everywhere."""
    ends = (cylinder.arm_at[0], cylinder.arm_at[-1])
    return replace(cylinder, arm_at=ends, arm=(cylinder.arm_nominal,) * 2, **changes)


class Rig:
    """``loads``: constant torque [Nm, N] of the world on each joint; ``q`` starts in the middle of the lever table."""

    def __init__(
        self,
        truth: Truth,
        inertias: Mapping[str, float],
        loads: Mapping[str, float] | None = None,
        *,
        cylinder: Mapping[str, float] | None = None,
        valve: Mapping[str, float] | None = None,
        supply: Mapping[str, object] | None = None,
        stops: Mapping[str, tuple[float, float]] | None = None,
        q: Mapping[str, float] | None = None,
    ) -> None:
        functions = {
            n: Function(
                even(truth.functions[n].cylinder, **(cylinder or {})),
                replace(truth.functions[n].valve, **(valve or {})),
            )
            for n in inertias
        }
        self.truth = replace(truth, functions=functions, supply=replace(truth.supply, **(supply or {})))
        self.oil = Hydraulics(self.truth, STEP_S)
        self.inertia, self.load = dict(inertias), dict.fromkeys(inertias, 0.0) | dict(loads or {})
        middle = {n: sum(f.cylinder.arm_at) / 2 for n, f in functions.items()}
        self.q, self.qd = middle | dict(q or {}), dict.fromkeys(inertias, 0.0)
        self.stops = dict(stops or {})
        self.torque = dict.fromkeys(inertias, 0.0)
        self.oil.hold([-self.load[n] for n in inertias], list(self.q.values()))

    def step(self, **commands: float) -> None:
        torques = self.oil.step([commands.get(n, 0.0) for n in self.q], list(self.q.values()), list(self.qd.values()))
        self.torque = dict(zip(self.q, torques, strict=True))
        for n, torque in self.torque.items():
            self.qd[n] += STEP_S * (torque + self.load[n]) / self.inertia[n]
            self.q[n] += STEP_S * self.qd[n]
            low, high = self.stops.get(n, (-1e9, 1e9))
            if not low <= self.q[n] <= high:
                self.q[n], self.qd[n] = min(high, max(low, self.q[n])), 0.0

    def run(self, seconds: float, **commands: float) -> None:
        for _ in range(round(seconds / STEP_S)):
            self.step(**commands)


def random_run_hash() -> str:
    """A hash of every torque of a run with random commands."""
    rig, rng, digest = Rig(AORO, AORO_HEAVY, {"lift": -20000.0}), random.Random(1), hashlib.sha256()
    for _ in range(30):
        commands = {n: rng.uniform(-1.0, 1.0) for n in AORO_HEAVY}
        rig.run(0.1, **commands)
        digest.update(struct.pack(f"{len(rig.torque)}d", *rig.torque.values()))
    return digest.hexdigest()
