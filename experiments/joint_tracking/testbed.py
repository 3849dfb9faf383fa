"""The testbed: joint laws on the physics, without bus and planner.

It has sensors, estimators, pace, laws, valve maps and monitors.  As in the real loop, encoders answer a SYNC half a
period before the tick with rounded counts, noise and their own latency; pressures are rounded to the 0.1 bar of the
bus; the command reaches the valves after the tick.  A reference is a function of its own time.
"""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

from controller.config import Settings
from controller.crane.reference_governor import TimeScaling
from controller.estimation.joint_estimator import JointEstimator
from controller.estimation.joint_monitors import MotionMonitor
from controller.laws.crane import LOADS, CraneLaw
from machine.joints import JOINTS, N_JOINTS
from machine.loading.profile_file import profile_hash
from machine.profile import Profile, joint
from machine.sensing import counts_from_position, position_from_counts
from machine.status.reasons import Reason
from runtime.errors import InputRefused
from sim.world import STEP_NS, World

NAMES: Final = tuple(j.name.lower() for j in JOINTS)
BAR: Final = 1.0e5
STEPS_PER_TICK: Final = 2
"""Physics steps per tick; SYNC is between them."""

Reference = Callable[[float], tuple[Sequence[float], Sequence[float]]]
"""Positions and velocities of every joint at a time [s]."""


@dataclass(slots=True)
class Trace:
    """Samples of every tick, in ``Joint`` order.

    Reference at its own time, true and estimated positions, commanded velocities, spool commands [%], load pressures
    [bar]; the rate of the trajectory, and whether the pump was the limit.
    """

    time_s: list[float] = field(default_factory=list)
    reference: list[list[float]] = field(default_factory=list)
    position: list[list[float]] = field(default_factory=list)
    estimate: list[list[float]] = field(default_factory=list)
    command: list[list[float]] = field(default_factory=list)
    spool_pct: list[list[float]] = field(default_factory=list)
    load_bar: list[list[float]] = field(default_factory=list)
    rate: list[float] = field(default_factory=list)
    limited: list[bool] = field(default_factory=list)
    energy_j: list[float] = field(default_factory=list)
    alarms: list[tuple[float, str, str]] = field(default_factory=list)
    """Time, joint and reason of every alarm of a motion monitor."""


class JointTestbed:
    """One machine with one law; ``profile`` is the controller's, ``world`` the ground truth."""

    def __init__(self, profile: Profile, world: World, seed: int) -> None:
        settings = Settings(profile, profile_hash(profile), profile.rate_hz)
        if settings.period_ns != STEPS_PER_TICK * STEP_NS:
            raise InputRefused(
                "experiment.control-rate",
                f"{profile.name}: this experiment needs a profile with 200 Hz, not {profile.rate_hz} Hz",
            )
        self._period_ns, self._lead_ns = settings.period_ns, settings.sync_lead_ns
        period_s = self._period_ns * 1e-9
        self.world, self.profile = world, profile
        self._specs = [joint(profile, j) for j in JOINTS]
        self._encoders = [world.truth.encoders.get(name) for name in NAMES]
        self._functions = [world.functions.index(name) for name in NAMES]
        self._rng = random.Random(f"joint-tracking {seed}")
        self.estimators = [JointEstimator(spec, period_s) for spec in self._specs]
        self.law = CraneLaw(profile, period_s)
        self._pace = TimeScaling(profile)
        self._monitors = [MotionMonitor(spec, period_s) for spec in self._specs]
        self._ahead = [0.0] * N_JOINTS
        self._spools = [0.0] * N_JOINTS
        self._loads = [math.nan] * N_JOINTS
        self._now_ns = 0
        self._before = [world.q[name] for name in NAMES]
        for _ in range(100):
            self._measure()

    def positions(self) -> list[float]:
        """Return joint positions as the controller estimates them; true positions of joints without an encoder."""
        return [e.position if e.known else self.world.q[name] for e, name in zip(self.estimators, NAMES, strict=True)]

    def run(self, reference: Reference, seconds: float, on_tick: Callable[[float], None] | None = None) -> Trace:
        """Follow a reference from its time 0; ``on_tick`` is called with the time before every tick."""
        trace, begin_ns = Trace(), self._now_ns
        energy_j = self.world.hydraulics.energy_j
        for _ in range(round(seconds * 1e9 / self._period_ns)):
            elapsed_s = (self._now_ns - begin_ns) * 1e-9
            if on_tick is not None:
                on_tick(elapsed_s)
            self._measure()
            self._tick(reference, elapsed_s, trace)
            trace.energy_j.append(self.world.hydraulics.energy_j - energy_j)
        return trace

    def _step(self) -> None:
        commands = [0.0] * len(self.world.functions)
        for i, spool in zip(self._functions, self._spools, strict=True):
            commands[i] = spool / 100.0
        self._before = [self.world.q[name] for name in NAMES]
        self.world.step(commands)

    def _measure(self) -> None:
        """Advance the physics by one period and sample the sensors."""
        self._step()
        stamp_ns = self._now_ns + self._period_ns - self._lead_ns
        counts: list[int | None] = []
        for spec, truth, position in zip(self._specs, self._encoders, self._before, strict=True):
            if spec.encoder is None or truth is None:
                counts.append(None)
                continue
            counts.append(counts_from_position(spec.encoder, position + self._rng.gauss(0.0, truth.noise)))
        pressures = self.world.hydraulics.pressures_pa
        for j, name in enumerate(NAMES):
            if LOADS[j] is not None:
                push, against = (round(10.0 * pa / BAR) / 10.0 for pa in pressures[name])
                self._loads[j] = self.law.load_pressure_bar(j, push, against)
        self._step()
        self._now_ns += self._period_ns
        for spec, estimator, count in zip(self._specs, self.estimators, counts, strict=True):
            estimator.predict(self._now_ns)
            if spec.encoder is not None and count is not None:
                estimator.update(position_from_counts(spec.encoder, count), stamp_ns)

    def _tick(self, reference: Reference, elapsed_s: float, trace: Trace) -> None:
        pace, law = self._pace, self.law
        pace.step(self._ahead, law.valves, 1.0, self._period_ns)
        own_s = elapsed_s - pace.behind_ns * 1e-9
        q, v = reference(own_s)
        for j, made in enumerate(law.laws):
            self._ahead[j] = reference(own_s + pace.rate * made.lead_ns * 1e-9)[1][j]
        rate = pace.rate
        ahead, velocity = [rate * x for x in self._ahead], [rate * x for x in v]
        law.step(q, velocity, ahead, self.estimators, self._loads, 1.0, self._period_ns * 1e-9)
        for j, (monitor, estimator) in enumerate(zip(self._monitors, self.estimators, strict=True)):
            reason = monitor.step(law.commands[j], estimator.velocity) if estimator.known else Reason.NONE
            if reason is not Reason.NONE:
                trace.alarms.append((elapsed_s, NAMES[j], reason.name))
        self._spools = [valve.spool_pct(c) for valve, c in zip(law.valves, law.commands, strict=True)]
        trace.time_s.append(elapsed_s)
        trace.reference.append(list(q))
        trace.position.append([self.world.q[name] for name in NAMES])
        trace.estimate.append([e.position for e in self.estimators])
        trace.command.append(list(law.commands))
        trace.spool_pct.append(list(self._spools))
        trace.load_bar.append(list(self._loads))
        trace.rate.append(rate)
        trace.limited.append(self.world.hydraulics.flow_limited)


def controller_profile(
    profile: Profile, truth: Any, kind: str, calibration: Calibration | None, damped: bool
) -> Profile:
    """Make the profile with another law, with or without pressure damping, and with calibrated or shipped valves;
    ``truth`` is that of the calibration.
    """
    import msgspec

    joints: dict[str, Any] = {}
    for name, spec in profile.joints.items():
        damping = spec.law.damping_per_bar if damped else 0.0
        law = msgspec.structs.replace(spec.law, kind=kind, damping_per_bar=damping)
        valve = spec.valve if calibration is None else calibration.valve(spec.valve, truth.functions[name].valve)
        joints[name] = msgspec.structs.replace(spec, law=law, valve=valve)
    return msgspec.structs.replace(profile, joints=joints)


class Calibration:
    """The result of a calibration: the true valve with errors of its accuracy."""

    DEADBAND_PCT: Final = 0.4
    HYSTERESIS_PCT: Final = 0.2
    SPEED: Final = 0.02
    DELAY_S: Final = 0.006

    def __init__(self, seed: int) -> None:
        self._rng = random.Random(f"calibration {seed}")

    def valve(self, valve_spec: Any, true: Any) -> Any:
        """Draw the valve map with errors of the standard deviations above."""
        import msgspec

        off = self._rng.gauss
        return msgspec.structs.replace(
            valve_spec,
            deadband_plus_pct=100.0 * true.deadband_plus + off(0.0, self.DEADBAND_PCT),
            deadband_minus_pct=100.0 * true.deadband_minus + off(0.0, self.DEADBAND_PCT),
            full_speed_plus=true.full_speed_plus * (1.0 + off(0.0, self.SPEED)),
            full_speed_minus=true.full_speed_minus * (1.0 + off(0.0, self.SPEED)),
            delay_s=max(0.0, true.delay_s + off(0.0, self.DELAY_S)),
            exponent=true.exponent,
            hysteresis_pct=max(0.0, 100.0 * true.hysteresis + off(0.0, self.HYSTERESIS_PCT)),
        )
