"""True angle of a rotator without an encoder when a planner commands quarter turns, with any profile of its machine.

Controller, guard, bus and plant are those of every lockstep run; the turns go through the control laws, as a planner's
do. The plant is built from the profile as shipped: a calibration changes the controller's profile, not the machine.
"""

from __future__ import annotations

from math import pi
from pathlib import Path
from typing import Final

from autonomy.motion.arm import Arm
from autonomy.motion.setpoint_stream import SetpointStream
from autonomy.motion.trajectory import Trajectory, hold, joint_motion
from autonomy.perception.log_list.observation import LogObservation
from can_dbc.messages.crane import GrappleCommand, OperatorAction, StateReport
from controller.config import Settings
from controller.guard.__main__ import build as build_guard
from experiments.common.errors import ExperimentError
from experiments.common.pool import Job
from experiments.common.worlds import profile_named
from hil.harness.lockstep import START_NS, Lockstep, Observer
from hil.harness.operator import Operator
from machine.joints import JOINTS, Joint
from machine.loading.profile_file import load_profile, profile_hash
from machine.profile import Profile
from machine.status.modes import Mode
from sim.plant import Plant

QUARTER_RAD: Final = pi / 2
TURNS_RAD: Final = (QUARTER_RAD, 0.0, -QUARTER_RAD, 0.0)
"""End angles of the turns in order: two to either side."""
REST_NS: Final = 1_500_000_000
LEASE_NS: Final = 200_000_000
LONGEST_S: Final = 60.0


class _Turner:
    """A planner that only turns the rotator; ``turned_rad`` are the true angles of the completed turns."""

    def __init__(self, profile: Profile, plant: Plant) -> None:
        self.turned_rad: list[float] = []
        self._arm, self._plant = Arm(profile), plant
        self._stream = SetpointStream(profile_hash(profile), LEASE_NS)
        self._motion: Trajectory = hold((0.0,) * len(JOINTS))
        self._begun_ns: int | None = None
        self._from_rad = 0.0

    @property
    def done(self) -> bool:
        return len(self.turned_rad) == len(TURNS_RAD)

    def step(self, now_ns: int, report: StateReport | None, logs: tuple[LogObservation, ...]) -> bytes | None:
        if report is not None and report.mode in (Mode.ARMED, Mode.ACTIVE) and not self.done:
            self._proceed(report, now_ns)
        if self._begun_ns is None or self.done or not self._stream.due(now_ns):
            return None
        return self._stream.datagram(now_ns, self._motion, (now_ns - self._begun_ns) * 1e-9, GrappleCommand.NEUTRAL)

    def _proceed(self, report: StateReport, now_ns: int) -> None:
        angle_rad = self._plant.joint_positions()[Joint.ROT]
        if self._begun_ns is not None:
            if now_ns < self._begun_ns + int(self._motion.duration_s * 1e9) + REST_NS:
                return
            self.turned_rad.append(angle_rad - self._from_rad)
            if self.done:
                return
        start = self._motion.goal if self._begun_ns is not None else (*report.position[: Joint.ROT], 0.0)
        goal = (*start[: Joint.ROT], TURNS_RAD[len(self.turned_rad)])
        self._motion, self._begun_ns, self._from_rad = joint_motion(self._arm, start, goal), now_ns, angle_rad


def turn_errors(job: Job, path: Path) -> list[float]:
    """Relative error of the true angle of every commanded turn in `TURNS_RAD`, with the profile in a file.

    Raises:
        ExperimentError: the machine did not make all turns.
    """
    profile = load_profile(path)
    plant = Plant(profile_named(job.options["profile"]), seed=job.seed, truth=job.options["truth"], logs=0)
    try:
        turner, digest = _Turner(profile, plant), profile_hash(profile)
        system = Lockstep(
            Settings(profile, digest, profile.rate_hz), build_guard(path), plant, turner,
            Operator(digest, _pressed, max_stops=0), Observer(None, []),
        )  # fmt: skip
        while not turner.done and system.now_ns < START_NS + int(LONGEST_S * 1e9):
            system.advance()
    finally:
        plant.close()
    if not turner.done:
        raise ExperimentError(
            "experiment.quarter-turns", f"only {len(turner.turned_rad)} of {len(TURNS_RAD)} quarter turns were made"
        )
    before = (0.0, *TURNS_RAD)
    asked = [b - a for a, b in zip(before, TURNS_RAD, strict=False)]
    return [true / want - 1.0 for true, want in zip(turner.turned_rad, asked, strict=True)]


def _pressed(action: OperatorAction, report: StateReport) -> None:
    """The emulated operator prints nothing."""
