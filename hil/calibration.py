"""Calibration of a virtual machine in lockstep: the procedure for a real machine, faster than real time.

Controller, guard, procedure and plant run in one process on virtual time and real CAN bytes
(`hil.harness.lockstep`).  The procedure gets the inputs that it gets at a machine: state reports, the frames of the
crane's bus, and the readings of a total station.
"""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Collection
from dataclasses import dataclass
from typing import Any, Final

import msgspec
import numpy as np

from autonomy.calibration.plan import CalibrationPlan, make_plan
from autonomy.calibration.procedure import Calibration
from autonomy.perception.camera.frame import Pose
from autonomy.perception.camera.survey import surveyed
from autonomy.perception.log_list import LogObservation
from can_dbc.dbc.codec import load
from can_dbc.frame import Frame
from can_dbc.messages.crane import OperatorAction, StateReport
from controller.config import Settings
from controller.guard.__main__ import build as build_guard
from controller.guard.__main__ import profile_path
from hil.harness.lockstep import START_NS, Lockstep, Observer
from hil.harness.operator import Operator
from hil.wire.inprocess import InProcessBus
from machine.geometry.optics import intrinsics
from machine.joints import JOINTS, Joint
from machine.loading.profile_file import load_profile, profile_hash
from machine.profile import Camera, Profile
from machine.status.modes import Mode
from recorder.recorder import Recorder
from runtime.errors import InputRefused
from sim.camera.geometry import mount_view
from sim.camera.noise import StereoNoise
from sim.geometry import IDENTITY
from sim.instruments import TotalStation, grapple_yaw
from sim.plant import Plant

MAX_DURATION_S: Final = 900.0
RUN_ON_NS: Final = 500_000_000
"""A run continues this long after its end, so that the last frames are recorded."""
READY_MODES: Final = (Mode.STANDBY, Mode.ARMED)


@dataclass(slots=True)
class Outcome:
    """The result of a lockstep run: the procedure with its findings, and the virtual time from arming to its end."""

    calibration: Calibration | None
    plan: CalibrationPlan | None
    failure: str | None
    seconds: float
    now_ns: int


class _Calibrator:
    """The procedure as the planner of the lockstep; it plans with the first report of a machine that is ready."""

    def __init__(
        self,
        profile: Profile,
        plant: Plant,
        seed: int,
        surveyed: bool,
        chosen: Collection[Joint],
        show: Callable[[CalibrationPlan], None],
    ) -> None:
        self.calibration: Calibration | None = None
        self.plan: CalibrationPlan | None = None
        self.refused: str | None = None
        self.bus: InProcessBus | None = None
        self._profile, self._plant, self._surveyed, self._show = profile, plant, surveyed, show
        self._chosen = chosen
        self._station = TotalStation(seed)
        self._frames: list[Frame] = []

    def step(self, now_ns: int, report: StateReport | None, logs: tuple[LogObservation, ...] | None) -> bytes | None:
        if self.calibration is None:
            if report is not None and report.mode in READY_MODES and self.refused is None:
                self._plan(report)
            return None
        self._frames.clear()
        if self.bus is not None:
            self.bus.drain(self._frames)
        reading = self._station.read(self._plant.tip()) if self.calibration.wants_reading else None
        yaw_rad = self._station.read_yaw(grapple_yaw(self._plant)) if self.calibration.wants_yaw else None
        return self.calibration.step(now_ns, report, self._frames, reading, yaw_rad)

    def _plan(self, report: StateReport) -> None:
        try:
            self.plan = make_plan(self._profile, report.position, self._surveyed, self._chosen)
        except InputRefused as error:
            self.refused = str(error)
            return
        self._show(self.plan)
        self.calibration = Calibration(self._profile, profile_hash(self._profile), self.plan, load("crane"))


def run_lockstep(
    name: str,
    truth: str,
    seed: int,
    *,
    surveyed: bool,
    chosen: Collection[Joint] = JOINTS,
    recorder: Recorder | None = None,
    show: Callable[[CalibrationPlan], None] = lambda plan: None,
    watch: Callable[[Calibration], None] = lambda calibration: None,
    aborted: Callable[[], bool] = lambda: False,
) -> Outcome:
    """Calibrate the virtual machine of a profile.

    ``show`` gets the plan, ``watch`` the procedure a few times per second; ``aborted`` ends the run.

    Raises:
        ValueError: the truth file cannot be used.
    """
    profile = load_profile(name)
    plant = Plant(profile, seed=seed, truth=truth, logs=0)
    try:
        planner = _Calibrator(profile, plant, seed, surveyed, chosen, show)
        settings = Settings(profile, profile_hash(profile), profile.rate_hz)
        operator = Operator(profile_hash(profile), _on_press, max_stops=0)
        system = Lockstep(settings, build_guard(profile_path(name)), plant, planner, operator, Observer(recorder, []))
        planner.bus = InProcessBus(system.core, "calibrator")
        return _run(system, planner, watch, aborted)
    finally:
        plant.close()


def _on_press(action: OperatorAction, report: StateReport) -> None:
    """Ignore a button press: presses are not shown."""


def _run(
    system: Lockstep, planner: _Calibrator, watch: Callable[[Calibration], None], aborted: Callable[[], bool]
) -> Outcome:
    limit_ns = START_NS + int(MAX_DURATION_S * 1e9)
    slices = 0
    while system.now_ns < limit_ns and planner.refused is None:
        system.advance()
        calibration = planner.calibration
        slices += 1
        if calibration is not None and slices % 64 == 0:
            watch(calibration)
            if aborted():
                calibration.abort("interrupted")
        if calibration is not None and (calibration.idle or calibration.done):
            break
        if system.operator.gave_up and (calibration is None or calibration.begun_ns is None):
            break
    end_ns = system.now_ns
    while system.now_ns < end_ns + RUN_ON_NS:
        system.advance()
    calibration = planner.calibration
    failure = planner.refused or (calibration.failure if calibration else "the machine did not reach STANDBY")
    if calibration is not None and failure is None and not calibration.done:
        failure = f"not finished within {MAX_DURATION_S:.0f} s, at {calibration.task}"
    return Outcome(calibration, planner.plan, failure, calibration.elapsed_s if calibration else 0.0, system.now_ns)


# -- An emulated survey of a camera's mount and depth scale before the work, from targets on level ground.
#
# The plant hides the true mount of a camera; on a real machine it is surveyed once.  The carrier stands level, the
# targets stand in front of the camera, and each is measured for two seconds.

TARGET_COUNT: Final = 14
SIGMA_M, SIGMA_PX, FRAMES = 0.002, 0.3, 30
"""Errors of a target's surveyed position and of its pixel; pictures of each target."""
MARGIN_PX: Final = 60
RANGE_M: Final = (3.0, 8.0)


def surveyed_profile(profile: Profile, truth: Any, name: str, seed: int) -> Profile:
    """Return the profile with camera ``name`` as surveyed before run ``seed``; ``truth`` is ``plant.world.truth``."""
    camera, hidden = profile.cameras[name], truth.cameras[name]
    scale = StereoNoise(camera, hidden, f"{name} {seed}").scale  # the same as that of the camera rig
    surveyed_camera = survey(camera, hidden, scale, random.Random(f"survey {seed}"))
    return msgspec.structs.replace(profile, cameras={**profile.cameras, name: surveyed_camera})


def survey(camera: Camera, truth: Any, depth_scale: float, rng: random.Random) -> Camera:
    """Return the camera with surveyed mount and depth scale.

    ``truth`` (``plant.world.truth.cameras``) holds the true mount errors and noise; the camera measures ``depth_scale``
    times the true depth.
    """
    pin, fb = intrinsics(camera), camera.fx_px * camera.baseline_m
    errors = (truth.mount_position_m, truth.mount_rpy_rad)
    view = mount_view(((0.0, 0.0, 0.0), IDENTITY), pin, camera.position_m, camera.rpy_rad, *errors)
    pixels, depths, targets = [], [], []
    for _ in range(TARGET_COUNT):
        u = rng.uniform(MARGIN_PX, pin.width_px - MARGIN_PX)
        v, z = rng.uniform(MARGIN_PX, pin.height_px - MARGIN_PX), rng.uniform(*RANGE_M)
        at = view.to_world(pin.deproject(u, v, z)[None])[0]
        targets.append(at + [rng.gauss(0.0, SIGMA_M) for _ in range(3)])
        pixels.append((u + rng.gauss(0.0, SIGMA_PX), v + rng.gauss(0.0, SIGMA_PX)))
        noise = rng.gauss(0.0, truth.disparity_sigma_px / math.sqrt(FRAMES))
        depths.append(depth_scale * fb / (fb / z + noise))
    return surveyed(camera, Pose(np.zeros(3), np.eye(3)), np.array(pixels), np.array(depths), np.array(targets))
