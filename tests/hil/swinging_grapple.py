"""A forwarder with an inertial sensor on its grapple that stops after an unshaped motion, in lockstep."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from math import hypot
from pathlib import Path

import numpy as np

import machine
from autonomy.motion.arm_kinematics import Arm
from autonomy.motion.setpoint_stream import PERIOD_NS, SetpointStream
from autonomy.motion.trajectory import Trajectory, hold, straight_line
from autonomy.perception.log_list import LogObservation
from can_dbc.messages.crane import GrappleCommand, StateReport
from hil.harness.lockstep import Observer
from machine.geometry.kinematics import pin_position
from machine.loading.profile_file import load_profile, profile_hash
from machine.profile import Profile
from machine.status.modes import Mode
from sim.plant import Plant
from tests.hil.stand_ins import in_lockstep

SHIPPED = Path(machine.__file__).parent / "aoro_fc8.toml"
IMU = """
[imu]
node = 0x23
message = "GrappleImu"
gain = {gain}
pendulum_m = 0.8
pin_speed_m_s = 0.12
dead_zone_rad = 0.014
"""
WAIT_NS, LEASE_NS = 1_000_000_000, 200_000_000


def sensing_profile(folder: Path, gain: float = 0.5) -> Path:
    """The forwarder's profile with a sensor on the grapple."""
    file = folder / f"sensing_{gain}.toml"
    file.write_text(SHIPPED.read_text() + IMU.format(gain=gain))
    return file


@dataclass
class Stop:
    """Planner: waits where the crane stands, then one motion, and stays at its goal for ever."""

    profile: Profile
    goal_m: tuple[float, float, float]
    shaped: bool
    motion: Trajectory | None = None
    begun_ns: int = 0
    due_ns: int = 0
    stands_ns: int = 0
    modes: set[Mode] = field(default_factory=set)

    def __post_init__(self) -> None:
        self.stream = SetpointStream(profile_hash(self.profile), LEASE_NS)
        self.arm = Arm(self.profile)

    def step(self, now_ns: int, report: StateReport | None, logs: tuple[LogObservation, ...]) -> bytes | None:
        if report is not None and report.mode in (Mode.ARMED, Mode.ACTIVE):
            q = (*report.position[:4], 0.0)
            if self.motion is None:
                self.motion, self.begun_ns = hold(q), now_ns
            elif self.motion.duration_s < 0.5 and now_ns - self.begun_ns > WAIT_NS:
                x, y, z = self.goal_m
                start = self.arm.pose(self.motion.goal)
                goal = self.arm.compact_pose_above(x, y, z, z)
                self.motion = straight_line(self.arm, start, goal, shaped=self.shaped)
                self.begun_ns = now_ns
            elif self.motion.duration_s > 0.5 and not self.stands_ns:
                self.stands_ns = now_ns * np.allclose(report.reference, self.motion.goal, atol=1e-6)
            if self.stands_ns:
                self.modes.add(report.mode)
        if self.motion is None or now_ns < self.due_ns:
            return None
        self.due_ns = now_ns + PERIOD_NS
        return self.stream.datagram(now_ns, self.motion, (now_ns - self.begun_ns) * 1e-9, GrappleCommand.NEUTRAL)


@dataclass
class Seen:
    """At every report after the reference stands: time [s], lean [rad], distance of the pin from its goal by
    encoders [m], valve commands [%]; and the modes meanwhile.
    """

    time_s: np.ndarray
    lean_rad: np.ndarray
    off_m: np.ndarray
    valves_pct: np.ndarray
    modes: set[Mode]

    def swing(self, begin_s: float, end_s: float) -> float:
        """Greatest lean between two times [rad]."""
        return float(self.lean_rad[(self.time_s >= begin_s) & (self.time_s < end_s)].max())


def stop_at(
    file: Path,
    goal_m: tuple[float, float, float],
    *,
    truth: str = "nominal",
    seed: int = 1,
    shaped: bool = False,
    seconds: float = 10.0,
    each: Callable[[Plant, float], None] = lambda plant, since_s: None,
) -> Seen:
    """One motion and ``seconds`` at its goal; ``each`` is called at every report with the time since arrival."""
    profile = load_profile(file)
    plant = Plant(profile, seed=seed, truth=truth, logs=0)
    planner = Stop(profile, goal_m, shaped)
    rows: list[tuple[float, float, float, tuple[float, ...]]] = []

    def look(report: StateReport) -> None:
        if planner.stands_ns and planner.motion is not None:
            since_s = (report.stamp_ns - planner.stands_ns) * 1e-9
            each(plant, since_s)
            kin = profile.kinematics
            off = np.subtract(pin_position(kin, report.position), pin_position(kin, planner.motion.goal))
            lean_rad = hypot(*plant.world.lean_rad())
            rows.append((since_s, lean_rad, float(np.linalg.norm(off)), tuple(plant.valve.outputs_pct)))

    system = in_lockstep(file, plant, planner, observer=Observer(None, [look]), max_stops=8)
    try:
        while not rows or rows[-1][0] < seconds:
            system.advance()
            assert system.now_ns < 60e9, "the machine never came to its goal"
    finally:
        plant.close()
    time_s, lean, off, valves = (np.array(column) for column in zip(*rows, strict=True))
    return Seen(time_s, lean, off, valves, planner.modes)
