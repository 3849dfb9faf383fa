"""An emulated operator at the hand levers of the plant: demonstrates motions between bunk and logs.

The controller is in STANDBY, the crane follows the levers.  The operator model tracks a target point that moves along a
quasi-parabola over the stakes (paper B 3.2.5) and deflects each lever in proportion to the desired joint speed.  It
compensates for most of the valve's dead-band, has a reaction time, a limited lever rate and tremor, hesitates, and
pauses between motions.  Learning uses the encoder frames of the bus, as from any recording.  Equal seeds give equal
frames.
"""

from __future__ import annotations

import random
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from autonomy.grasp.grapple_heights import travel_height_m
from autonomy.motion.arm_kinematics import Arm, Pose
from autonomy.motion.demonstration import AXES
from autonomy.perception.log_list import LogObservation
from can_dbc.frame import Frame
from can_dbc.messages.crane import StateReport
from controller.config import Settings
from controller.guard.__main__ import build as build_guard
from controller.guard.__main__ import profile_path
from hil.harness.lockstep import Lockstep, Observer
from hil.harness.operator import Operator
from hil.wire.inprocess import InProcessBus
from machine.geometry.grapple import lowest_tip_below_pin_m
from machine.geometry.kinematics import Unreachable
from machine.loading.profile_file import load_profile, profile_hash
from machine.profile import Profile, joint
from recorder.recorder import Recorder
from runtime.errors import InputRefused
from sim.plant import Plant

START_DELAY_S: Final = 2.0
"""Time for the machine to start before the levers move."""
PERIOD_NS: Final = 20_000_000
SPEED_SHARE: Final = 0.75
"""Joint speed of the operator, as a share of the profile's maximum."""
REACTION_PERIODS: Final = 8
"""Reaction time in periods: the operator sees the joints as they were 0.16 s ago."""
LEVER_RATE_1_S: Final = 3.0
"""Greatest lever rate: full deflection in a third of a second."""
TREMOR_SHARE: Final = 0.02
"""Standard deviation of the tremor, as a share of full deflection."""
DEADBAND_SHARE: Final = 0.9
"""Share of the dead-band for which the operator compensates."""
GAIN_1_S: Final = 1.6
"""Position gain of the operator."""
GOAL_TOLERANCE: Final = 0.03
"""A motion ends when every joint is this close to its goal [rad, m]."""
OVER_LOG_M: Final = 0.10
"""Height of the open jaws' tips over the ground at a target."""
MAX_DURATION_S: Final = 600.0
_POINTS: Final = 81


@dataclass(frozen=True, slots=True)
class DemonstrationMotion:
    """One motion: joints along its path (n, 4) [rad, m], duration [s], and pause before it [s]."""

    joints: np.ndarray
    time_s: float
    pause_s: float


def script(profile: Profile, seed: int, targets: int, standing: Sequence[float]) -> list[DemonstrationMotion]:
    """Plan motions from the present joints ``standing`` (5,) to ``targets`` positions beside the machine, each
    followed by one to the bunk.

    Raises:
        InputRefused: the crane cannot reach such positions.
    """
    rng, arm, bunk, ground = random.Random(seed), Arm(profile), profile.bunk, profile.workspace.ground_z_m
    high = travel_height_m(profile)
    over_bunk = arm.compact_pose_above(
        *bunk.center_m, bunk.floor_z_m + lowest_tip_below_pin_m(profile.grapple.jaws) + 0.3, high
    )
    motions: list[DemonstrationMotion] = []
    start_pose = arm.pose(standing)
    cx, cy = profile.workspace.pick_center_m
    for number in range(targets):
        side = -1.0 if number % 2 and profile.carrier is not None else 1.0
        x, y = cx + rng.uniform(-0.8, 0.8), side * (cy + rng.uniform(-0.8, 0.8))
        try:
            log = arm.compact_pose_above(x, y, ground + profile.grapple.jaws.tip_below_pin_m[0] + OVER_LOG_M, high)
            motions.append(_motion(arm, start_pose, log, high, rng))
            motions.append(_motion(arm, log, over_bunk, high, rng))
            start_pose = over_bunk
        except Unreachable as error:
            raise InputRefused("demonstration.unreachable", f"the crane cannot demonstrate there: {error}") from None
    return motions


def _motion(arm: Arm, start: Pose, goal: Pose, high_m: float, rng: random.Random) -> DemonstrationMotion:
    """Plan a straight line in the plane with a quasi-parabola in height, somewhat higher than the stakes require."""
    share = np.linspace(0.0, 1.0, _POINTS)
    ends = np.array(start), np.array(goal)
    poses = ends[0] + share[:, None] * (ends[1] - ends[0])
    middle = (start.z_m + goal.z_m) / 2
    poses[:, 2] += (max(0.0, high_m - middle) + rng.uniform(0.0, 0.25)) * 4.0 * share * (1.0 - share)
    q = arm.joints(poses)[:, : len(AXES)]
    speed = SPEED_SHARE * arm.speed[: len(AXES)] * rng.uniform(0.85, 1.1)
    time_s = float(np.max(np.sum(np.abs(np.diff(q, axis=0)), axis=0) / speed))
    return DemonstrationMotion(q, 1.3 * time_s + 0.8, rng.uniform(1.2, 2.5))


class LeverOperator:
    """Moves the levers; the planner of a lockstep run that never sends a setpoint."""

    def __init__(self, profile: Profile, plant: Plant, shown: list[DemonstrationMotion], seed: int) -> None:
        self._plant, self._left, self._count = plant, deque(shown), len(shown)
        self._rng = random.Random(seed + 1)
        self._specs = [joint(profile, j) for j in AXES]
        self._seen: deque[np.ndarray] = deque(maxlen=REACTION_PERIODS)
        self._levers = np.zeros(len(AXES))
        self._tremor = np.zeros(len(AXES))
        self._now: DemonstrationMotion | None = None
        self._clock_s = 0.0
        self._next_ns = 0
        self._hesitates = (0.0, 0.0)
        self.done = False

    @property
    def shown(self) -> int:
        """The number of motions begun."""
        return self._count - len(self._left)

    def step(self, now_ns: int, report: StateReport | None, logs: tuple[LogObservation, ...] | None) -> bytes | None:
        """Read the joints and move the levers every 20 ms; send nothing."""
        if now_ns < self._next_ns or now_ns < START_DELAY_S * 1e9:
            return None
        self._next_ns = now_ns + PERIOD_NS
        self._seen.append(np.array(self._plant.joint_positions()[: len(AXES)]))
        self._proceed(PERIOD_NS * 1e-9)
        return None

    def _proceed(self, dt_s: float) -> None:
        measured_position = self._seen[0]
        if self._now is None:
            if not self._left:
                self.done = True
                return
            self._now = self._left.popleft()
            self._clock_s = -self._now.pause_s
            middle = self._rng.uniform(0.3, 0.7) * self._now.time_s
            self._hesitates = (middle, self._rng.choice((0.0, 0.0, 0.35)))
        previous_target = self._target(self._clock_s)
        at, wait_s = self._hesitates
        self._clock_s += dt_s
        if wait_s > 0.0 and self._clock_s >= at:
            self._hesitates = (at, wait_s - dt_s)
            self._clock_s -= dt_s
        target_position = self._target(self._clock_s)
        moving = self._clock_s > 0.0
        speed = (
            (target_position - previous_target) / dt_s + GAIN_1_S * (target_position - measured_position)
            if moving
            else np.zeros(len(AXES))
        )
        close = np.abs(target_position - measured_position) < GOAL_TOLERANCE
        over = self._clock_s > self._now.time_s
        if over:
            speed = np.where(close, 0.0, speed)
        self._move_levers(speed, dt_s)
        if (over and bool(np.all(close))) or self._clock_s > self._now.time_s + 6.0:
            self._now = None

    def _target(self, clock_s: float) -> np.ndarray:
        """Compute the target point (4,) [rad, m]: along the path, faster in the middle."""
        assert self._now is not None
        tau = min(max(clock_s / self._now.time_s, 0.0), 1.0)
        share = tau * tau * (3.0 - 2.0 * tau)
        grid = np.linspace(0.0, 1.0, _POINTS)
        return np.array([np.interp(share, grid, column) for column in self._now.joints.T])

    def _move_levers(self, speed: np.ndarray, dt_s: float) -> None:
        for i, (axis, spec) in enumerate(zip(AXES, self._specs, strict=True)):
            v, valve = float(speed[i]), spec.valve
            full = valve.full_speed_plus if v >= 0.0 else valve.full_speed_minus
            dead = DEADBAND_SHARE * (valve.deadband_plus_pct if v >= 0.0 else valve.deadband_minus_pct) / 100.0
            share = min(abs(v) / full, 1.0) ** (1.0 / valve.exponent)
            goal = valve.sign * (dead + (1.0 - dead) * share) * (1.0 if v > 0.0 else -1.0) if abs(v) > 1e-3 else 0.0
            most = LEVER_RATE_1_S * dt_s
            self._levers[i] += min(max(goal - self._levers[i], -most), most)
            self._tremor[i] += 0.3 * (self._rng.gauss(0.0, TREMOR_SHARE) - self._tremor[i])
            held = self._levers[i] + (self._tremor[i] if self._levers[i] else 0.0)
            self._plant.lever(axis.name.lower(), min(max(held, -1.0), 1.0))


class _PassiveOperator(Operator):
    """Never arms the machine: the levers move it."""

    def step(self, report: StateReport) -> bytes | None:
        return None


def demonstrate(
    name: str,
    seed: int = 1,
    targets: int = 6,
    truth: str = "nominal",
    recorder: Recorder | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> list[Frame]:
    """Demonstrate the script of a machine on its plant; return the frames of the crane bus.

    Raises:
        InputRefused: the script cannot be made.
        ValueError: the scene cannot be made.
    """
    profile = load_profile(name)
    plant = Plant(profile, seed, truth, logs=0)
    try:
        shown = script(profile, seed, targets, plant.joint_positions())
        lever_operator = LeverOperator(profile, plant, shown, seed)
        settings = Settings(profile, profile_hash(profile), profile.rate_hz)
        operator = _PassiveOperator(profile_hash(profile), lambda action, report: None)
        guard = build_guard(profile_path(name))
        system = Lockstep(settings, guard, plant, lever_operator, operator, Observer(recorder, []))
        bus = InProcessBus(system.core, "learner")
        frames: list[Frame] = []
        slices = 0
        end_ns = system.now_ns + int(MAX_DURATION_S * 1e9)
        while not lever_operator.done and system.now_ns < end_ns:
            system.advance()
            bus.drain(frames)
            slices += 1
            if slices % 800 == 0:
                progress(lever_operator.shown, len(shown))
        return frames
    finally:
        plant.close()
