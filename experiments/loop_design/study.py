"""Margins of every joint's loop over all machines of the truth's spread, in several poses and with several loads.

The controller knows only the profile; the true dead time and gain lie anywhere in the spread.  Cases: near, working and
far reach; empty grapple and rated load; both directions; valve slightly and widely open.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, replace
from itertools import product
from typing import Any, Final, Protocol

import control
import numpy as np

from controller.config import Settings
from controller.laws.feedback import LAWS
from experiments.common.worlds import home_at, profile_named, trial_world
from experiments.loop_design.loop import FREQUENCY_RAD_S, Array, LawResponse, Margins, Spool, margins, open_loop
from experiments.loop_design.mechanics import Mechanics, mechanics
from machine.geometry.kinematics import max_reach_m
from machine.loading.profile_file import profile_hash
from machine.profile import JointSpec, Profile
from runtime.errors import InputRefused

MIN_PHASE_DEG: Final = 40.0
MIN_GAIN_DB: Final = 6.0
REACH_SHARES: Final = {"near": 0.45, "working": 0.65, "far": 0.85}
HEIGHT_M: Final = 1.0
RATED_KG: Final = {"palms_471": 120.0, "aoro_fc8": 200.0}
ANY_KG: Final = 100.0
OPENINGS: Final = (0.1, 0.4)
AMPLITUDES: Final = (0.1, 0.3, 1.0)
DELAYS: Final = 5
GAINS: Final = 3


class AnyCase(Protocol):
    """A case of a study: the machine and its operating point, with its description as text."""

    @property
    def delay_s(self) -> float:
        """Dead time of the valve [s]."""

    @property
    def gain(self) -> float:
        """Gain of the valve over the profile's."""


@dataclass(frozen=True, slots=True)
class Case:
    """One machine in one pose."""

    pose: str
    load_kg: float
    direction: int
    opening: float
    delay_s: float
    gain: float
    amplitude: float

    def __str__(self) -> str:
        return (
            f"{self.pose}, {self.load_kg:.0f} kg, {'+' if self.direction > 0 else '-'}, valve {self.opening:.0%} open, "
            f"delay {1e3 * self.delay_s:.0f} ms, gain x{self.gain:.2f}"
        )


@dataclass(frozen=True, slots=True)
class CaseSet:
    """The cases of a study: mechanics of every joint with an encoder in each pose, and the machines."""

    places: dict[str, list[tuple[Case, Mechanics]]]
    """Mechanics per joint; the cases are those of the nominal machine."""
    valves: dict[str, Spool]
    """The nominal true valve of each joint."""
    delays_s: tuple[float, ...]
    gains: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class JointStudy:
    """One joint: margins of every case, and the loops of the nominal and the worst case."""

    name: str
    spec: JointSpec
    nominal: Margins
    nominal_loop: Array
    cases: tuple[AnyCase, ...]
    margins: tuple[Margins, ...]
    worst_loop: Array
    """Loop of the case with the least gain margin."""

    @property
    def phase_deg(self) -> float:
        """Least phase margin [deg]."""
        return min(m.phase_deg for m in self.margins)

    @property
    def gain_db(self) -> float:
        """Least gain margin [dB]."""
        return min(m.gain_db for m in self.margins)

    @property
    def worst(self) -> AnyCase:
        """The case with the least gain margin."""
        return self.cases[min(range(len(self.cases)), key=lambda i: self.margins[i].gain_db)]

    @property
    def bandwidth_hz(self) -> float:
        """Where the nominal closed loop's response first falls below -3 dB."""
        closed = np.abs(self.nominal_loop / (1.0 + self.nominal_loop))
        return float(FREQUENCY_RAD_S[np.argmax(closed < math.sqrt(0.5))] / (2.0 * math.pi))

    def document(self) -> dict[str, Any]:
        """Return the numbers for the page; python-control computes the margins of the worst loop again."""
        frd = control.FrequencyResponseData(self.worst_loop, FREQUENCY_RAD_S)
        gain, phase, *_ = control.stability_margins(frd)
        return {
            "law": self.spec.law.kind,
            "kp_1_s": self.spec.law.kp_1_s,
            "phase_margin_deg": self.phase_deg,
            "gain_margin_db": self.gain_db,
            "bandwidth_hz": self.bandwidth_hz,
            "nominal": asdict(self.nominal),
            "worst": str(self.worst),
            "worst_by_python_control": {"phase_deg": float(phase), "gain_db": 20.0 * math.log10(float(gain))},
            "machines": len(self.cases),
            "holds": self.holds,
        }

    @property
    def holds(self) -> bool:
        """Whether all margins meet their limits."""
        return self.phase_deg >= MIN_PHASE_DEG and self.gain_db >= MIN_GAIN_DB


def case_set(source: str, truth: str = "nominal") -> CaseSet:
    """Linearize the machine ``source`` (a shipped profile or a file) in all poses.

    Raises:
        ValueError: the truth cannot be used with this profile.
    """
    profile = profile_named(source)
    load_kg = RATED_KG.get(profile.name, ANY_KG)
    cases_by_joint: dict[str, list[tuple[Case, Mechanics]]] = {}
    for pose, share in REACH_SHARES.items():
        home = home_at(source, share * max_reach_m(profile), HEIGHT_M)
        with trial_world(source, truth, 0, home=home) as world:
            spread = world.truth.spread
            valves = {
                n: Spool(f.valve.delay_s, 1.0, f.valve.spool_rad_s, f.valve.spool_zeta)
                for n, f in world.truth.functions.items()
            }
            for name, kg, direction, opening in product(profile.joints, (0.0, load_kg), (1, -1), OPENINGS):
                if profile.joints[name].encoder is not None:
                    case = Case(pose, kg, direction, opening, valves[name].delay_s, 1.0, 1.0)
                    cases_by_joint.setdefault(name, []).append((case, mechanics(world, name, kg, direction, opening)))
    delays = np.linspace(spread.delay_min_s, spread.delay_max_s, DELAYS)
    gains = np.linspace(1.0 - spread.gain, 1.0 + spread.gain, GAINS)
    return CaseSet(cases_by_joint, valves, tuple(delays.tolist()), tuple(gains.tolist()))


def study(profile: Profile, work: CaseSet) -> list[JointStudy]:
    """Study every joint with an encoder, with the gains of the profile.

    Raises:
        InputRefused: a joint has a law of another package, whose response nobody knows here.
    """
    foreign = sorted({spec.law.kind for name, spec in profile.joints.items() if name in work.places} - LAWS.keys())
    if foreign:
        raise InputRefused(
            "loop-design.foreign-law",
            f"the response of the law {foreign[0]!r} is not known, only those of {', '.join(LAWS)}; try it in lockstep",
        )
    return [_joint(profile, name, work) for name in work.places]


def _joint(profile: Profile, name: str, work: CaseSet) -> JointStudy:
    settings = Settings(profile, profile_hash(profile), profile.rate_hz)
    period_s, lead_s = settings.period_ns * 1e-9, settings.sync_lead_ns * 1e-9
    spec, valve, s = profile.joints[name], work.valves[name], 1j * FREQUENCY_RAD_S

    def loop(case: Case, made: Mechanics) -> Array:
        law = LawResponse(spec, period_s, lead_s, case.amplitude)
        spool = replace(valve, delay_s=case.delay_s, gain=case.gain)
        return open_loop(s, spec, law, made, spool, period_s)

    amplitudes = AMPLITUDES if spec.law.kind == "super_twisting" else (1.0,)
    every = [
        (replace(case, delay_s=delay, gain=gain, amplitude=amplitude), made)
        for (case, made), delay, gain, amplitude in product(work.places[name], work.delays_s, work.gains, amplitudes)
    ]
    case_margins = [margins(FREQUENCY_RAD_S, loop(*each)) for each in every]
    worst = min(range(len(every)), key=lambda i: case_margins[i].gain_db)
    middle = next(each for each in work.places[name] if each[0].pose == "working")
    nominal = loop(*middle)
    cases = tuple(case for case, _ in every)
    at = margins(FREQUENCY_RAD_S, nominal)
    return JointStudy(name, spec, at, nominal, cases, tuple(case_margins), loop(*every[worst]))
