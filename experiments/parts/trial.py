"""One trial of one part of the forwarder, as plain data.

``primitive``: a demonstration that the primitives have not learned from, repeated by them on the physics.
``ground``: a drive over rough ground, with the front axle on its float valve or on its four arms' laws.
``level``: the standing machine levels itself on a slope.  ``pictures``: what a picture of the front camera costs while
the machine drives past logs.
"""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, Final

import numpy as np

from autonomy.localization.local_plane import LocalPlane
from autonomy.localization.location import Location
from autonomy.motion.arm_kinematics import Arm
from autonomy.motion.demonstration import JointTrack, joint_vectors, read_demonstrations
from autonomy.motion.movement_primitives import SHIPPED_FOLDER, PrimitiveMotions, learn_primitives
from autonomy.motion.setpoint_stream import SetpointStream
from autonomy.motion.trajectory import Trajectory, joint_motion
from autonomy.navigation.joining_path import joining_path
from autonomy.navigation.navigator import Navigator
from autonomy.navigation.navigator import Phase as NavigatorPhase
from autonomy.navigation.path_drive import PathDrive
from autonomy.perception.camera.frame import Pose as CameraPose
from autonomy.perception.camera.frame import RgbdFrame
from autonomy.perception.driving_log_detector import CylinderLocalizer, DrivingLogDetector
from autonomy.perception.log_list import LogObservation
from autonomy.perception.segmentation.log_segmenter import LogSegmenter
from autonomy.perception.tracking.log_filter import SURVEYED_BY_GNSS
from can_dbc.messages.crane import GrappleCommand, StateReport
from can_dbc.messages.vehicle import DriveSetpoint, VehicleReport
from controller.config import Settings
from controller.guard.__main__ import build as build_guard
from controller.guard.__main__ import profile_path
from experiments.common.carrier_driver import CarrierDriver, Drive
from experiments.common.individuals import calibrated, controller_profile
from experiments.common.pool import Job
from experiments.common.worlds import place, profile_named
from hil.calibration import surveyed_profile
from hil.harness.lockstep import START_NS, Lockstep, Observer
from hil.harness.operator import Operator
from hil.missions.detectors import CAMERA
from hil.plant.camera import RigCamera
from machine.geometry.kinematics import Unreachable, pin_position
from machine.joints import JOINTS, Joint
from machine.loading.profile_file import load_profile, profile_hash
from machine.profile import Carrier, Profile
from machine.status.modes import Mode
from sim.camera.geometry import quaternion_matrix
from sim.camera.rig import CameraRig
from sim.mechanics.carrier import Carrier as CarrierBody
from sim.plant import Plant
from sim.wood.log_shape import LogSpec

LEASE_NS: Final = 200_000_000
REST_S: Final = 3.0
PATH_POINT_COUNT: Final = 200
DRIVE_M: Final = 20.0
SAMPLE_NS: Final = 100_000_000
LEVEL_S: Final = 40.0
DRIVING_M_S: Final = 0.1
PICTURE_NS: Final = 500_000_000
LIMIT_S: Final = 300.0
LOG_COUNT: Final = 8


def perform(job: Job) -> dict[str, Any]:
    """Run one trial; options: profile, truth, text (of the calibrated profile), and those of its kind."""
    return KINDS[job.kind](job)


# -- movement primitives


class _Repetition:
    """Planner that brings the crane to where a motion begins, makes the motion, and holds; samples its pin.

    ``errors_m`` and ``true_errors_m``: distance of the pin from its reference while the motion runs, by the encoders
    and truly; ``rest_m``: by the encoders, over the last second at rest.
    """

    def __init__(self, profile: Profile, motion: Trajectory, tip: Callable[[], tuple[float, ...]]) -> None:
        self.errors_m: list[float] = []
        self.true_errors_m: list[float] = []
        self.rest_m = math.nan
        self.over = False
        self._profile, self._motion, self._tip = profile, motion, tip
        self._stream = SetpointStream(profile_hash(profile), LEASE_NS)
        self._approach: Trajectory | None = None
        self._begin_ns = 0
        self._rest: list[float] = []

    def receive(self, report: VehicleReport) -> None:
        """Ignore the vehicle's report: the machine stands."""

    def step(self, now_ns: int, report: StateReport | None, logs: tuple[LogObservation, ...] | None) -> bytes | None:
        """Return the setpoint to send now."""
        if report is None or report.mode not in (Mode.ARMED, Mode.ACTIVE):
            return None
        if self._approach is None:
            start = (*report.position[: Joint.ROT], self._motion.position[0][Joint.ROT])  # which nothing measures
            self._approach = joint_motion(Arm(self._profile), start, self._motion.position[0])
            self._begin_ns = now_ns
        begins_s = self._approach.duration_s + REST_S
        self._sample(report, (report.stamp_ns - self._begin_ns) * 1e-9 - begins_s)
        elapsed_s = (now_ns - self._begin_ns) * 1e-9
        if not self._stream.due(now_ns):
            return None
        if elapsed_s < begins_s:
            return self._stream.datagram(now_ns, self._approach, elapsed_s, GrappleCommand.NEUTRAL)
        return self._stream.datagram(now_ns, self._motion, elapsed_s - begins_s, GrappleCommand.NEUTRAL)

    def figures(self, joints: np.ndarray, demonstrated_s: float) -> dict[str, Any]:
        """Compare the motion with the demonstration of joint vectors (n, 5) and that duration [s]."""
        motion = self._motion
        demonstrated, planned = (_pin_path(self._profile, q) for q in (joints, np.array(motion.position)))
        apart_m = [float(np.linalg.norm(demonstrated - point, axis=1).min()) for point in planned]
        return {
            "shape_rms_m": _rms(apart_m),
            "shape_max_m": max(apart_m),
            "time_share": motion.duration_s / demonstrated_s,
            "tip_rms_m": _rms(self.errors_m),
            "true_rms_m": _rms(self.true_errors_m),
            "rest_m": self.rest_m,
            "demonstrated": _plane(demonstrated),
            "planned": _plane(planned),
        }

    def _sample(self, report: StateReport, time_s: float) -> None:
        if time_s < 0.0:
            return
        kinematics = self._profile.kinematics
        asked_m = pin_position(kinematics, self._motion.at(time_s)[0])
        error_m = math.dist(pin_position(kinematics, report.position), asked_m)
        if time_s < self._motion.duration_s:
            self.errors_m.append(error_m)
            self.true_errors_m.append(math.dist(self._tip(), asked_m))
        elif time_s > self._motion.duration_s + REST_S - 1.0:
            self._rest.append(error_m)
            self.over = time_s > self._motion.duration_s + REST_S
            self.rest_m = float(np.mean(self._rest))


def demonstrations(profile: str) -> tuple[JointTrack, ...]:
    """Read the demonstrations that the machine's shipped primitives were learned from."""
    return read_demonstrations(SHIPPED_FOLDER / f"{profile}.csv")[1]


def primitive(job: Job) -> dict[str, Any]:
    """Repeat demonstration ``number`` by primitives of all others, from its beginning to its end.

    The shape is the distance of the primitive's path of the pin from the demonstrated one, whatever the time on it.
    """
    shown = list(demonstrations(job.options["profile"]))
    own = shown.pop(job.options["number"])
    joints = joint_vectors(own)

    def repetition(profile: Profile, _: LocalPlane, plant: Plant) -> _Repetition:
        arm = Arm(profile)
        plan = PrimitiveMotions(learn_primitives(profile, shown))
        return _Repetition(profile, plan(arm, arm.pose(joints[0].tolist()), arm.pose(joints[-1].tolist())), plant.tip)

    try:
        with _system(job, repetition) as (system, repeated):
            _run(system, repeated)
            figures: dict[str, Any] = repeated.figures(joints, float(own.time_s[-1]))
            return figures | {"stops": system.operator.stops}
    except Unreachable as refused:
        return {"failure": str(refused), "stops": 0}


def _rms(values: Sequence[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values)))) if values else math.nan


def _pin_path(profile: Profile, joints: np.ndarray) -> np.ndarray:
    """Compute `PATH_POINT_COUNT` pins (n, 3) [m] evenly along the path of joint vectors (m, 5)."""
    pins = np.array([pin_position(profile.kinematics, q) for q in joints])
    along_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(pins, axis=0), axis=1))])
    at_m = np.linspace(0.0, along_m[-1], PATH_POINT_COUNT)
    return np.column_stack([np.interp(at_m, along_m, column) for column in pins.T])


def _plane(path: np.ndarray) -> list[list[float]]:
    """Return distance from the slew axis and height of every tenth point [m], for the plot."""
    return [[round(math.hypot(x, y), 3), round(z, 3)] for x, y, z in path[::10].tolist()]


# -- the carrier


def carrier_of(profile: Profile) -> Carrier:
    """Return the carrier of a machine that has one."""
    assert profile.carrier is not None
    return profile.carrier


def body_of(plant: Plant) -> CarrierBody:
    """Return the true carrier of a machine that has one."""
    assert plant.world.carrier is not None
    return plant.world.carrier


class _OnArms(Navigator):
    """Navigator that lets no axle float: all four arms are held by their laws."""

    def step(self, now_ns: int, report: VehicleReport, location: Location) -> DriveSetpoint | None:
        """Return the setpoint to send now, or None."""
        setpoint = super().step(now_ns, report, location)
        return None if setpoint is None else dataclasses.replace(setpoint, float_front=False, float_rear=False)


class _Straight(CarrierDriver):
    """Drives ``DRIVE_M`` straight on."""

    def begin_drive(self, location: Location) -> Drive:
        """Return the drive from a location."""
        x, y, yaw = location.x_m, location.y_m, location.yaw_rad
        goal = (x + DRIVE_M * math.cos(yaw), y + DRIVE_M * math.sin(yaw))
        return PathDrive(self.carrier, joining_path((x, y), yaw, [goal], self.carrier))


@contextmanager
def _system(
    job: Job, make: Callable[[Profile, LocalPlane, Plant], Any], logs: tuple[LogSpec, ...] = ()
) -> Iterator[tuple[Lockstep, Any]]:
    """Open the whole machine in lockstep on its ground, and the planner that ``make`` makes.

    Controller, guard and planner have the calibrated profile; the plant is that of the shipped one.
    """
    o = job.options
    with controller_profile(o["profile"], o["text"]) as name:
        profile = load_profile(name)
        carrier = carrier_of(profile)
        plant = Plant(profile_named(o["profile"]), job.seed, o["truth"], scene=logs, terrain=o.get("terrain", "flat"))
        try:
            place(plant, (0.0, 0.0, math.radians(o.get("heading_deg", 0.0))))
            planner = make(profile, LocalPlane(carrier.site_lat_deg, carrier.site_lon_deg, 0.0), plant)
            digest = profile_hash(profile)
            settings, operator = Settings(profile, digest, profile.rate_hz), Operator(digest, lambda *_: None)
            observer = Observer(None, [], [planner.receive])
            yield Lockstep(settings, build_guard(profile_path(name)), plant, planner, operator, observer), planner
        finally:
            plant.close()


def _run(system: Lockstep, planner: Any, sample: Callable[[], None] = lambda: None, every_ns: int = SAMPLE_NS) -> None:
    """Run until the planner is over, and call ``sample`` at intervals meanwhile."""
    next_ns = START_NS
    while not planner.over and not system.operator.gave_up and system.now_ns < START_NS + LIMIT_S * 1e9:
        system.advance()
        if system.now_ns >= next_ns:
            next_ns = system.now_ns + every_ns
            sample()


def _straight(profile: Profile, plane: LocalPlane, _: Plant) -> CarrierDriver:
    return _Straight(carrier_of(profile), plane, Navigator(carrier_of(profile), profile_hash(profile)))


def _straight_on_arms(profile: Profile, plane: LocalPlane, _: Plant) -> CarrierDriver:
    return _Straight(carrier_of(profile), plane, _OnArms(carrier_of(profile), profile_hash(profile)))


def _standing(profile: Profile, plane: LocalPlane, _: Plant) -> CarrierDriver:
    navigator = Navigator(carrier_of(profile), profile_hash(profile), level=True)
    navigator.holds_heights = True
    return CarrierDriver(carrier_of(profile), plane, navigator)


def ground(job: Job) -> dict[str, Any]:
    """Drive straight over rough ground; ``floats``: the front axle is on its float valve, as in every mission.

    Samples hold the height of each arm that a law holds less the transport height [m], the wheels' loads as shares
    of a quarter of their sum, and the roll of the rear half [rad].
    """
    floats = job.options["floats"]
    with _system(job, _straight if floats else _straight_on_arms) as (system, driver):
        body, transport_m = body_of(system.plant), carrier_of(system.plant.profile).arm_transport_m
        heights, loads, rolls = [], [], []

        def sample() -> None:
            if abs(body.speed_m_s) < DRIVING_M_S:
                return
            held = body.arm_heights_m[2:] if floats else body.arm_heights_m
            heights.append([round(h - transport_m, 4) for h in held])
            quarter_n = sum(body.wheel_loads_n) / 4.0
            loads.append([round(n / quarter_n, 3) for n in body.wheel_loads_n])
            rolls.append(round(body.roll_rad, 4))

        _run(system, driver, sample)
        return {
            "heights_m": heights,
            "loads": loads,
            "roll_rad": rolls,
            "arrived": driver.navigator.phase is NavigatorPhase.ARRIVED,
            "reason": driver.navigator.reason,
            "stops": system.operator.stops,
        }


def level(job: Job) -> dict[str, Any]:
    """Level the standing machine on a slope; the greater tilt of roll and pitch [rad] over the time [s]."""
    with _system(job, _standing) as (system, _):
        body = body_of(system.plant)
        before_rad = _tilt_rad(body)
        curve = []
        for k in range(1, round(LEVEL_S) + 1):
            while system.now_ns < START_NS + k * 1e9:
                system.advance()
            curve.append([k, round(_tilt_rad(body), 5)])
        return {"before_rad": before_rad, "after_rad": curve[-1][1], "curve": curve, "stops": system.operator.stops}


def _tilt_rad(body: CarrierBody) -> float:
    return max(abs(body.roll_rad), abs(body.pitch_rad))


# -- pictures


class _Timed:
    """A camera source that counts the processor time of drawing, which a real camera does itself."""

    def __init__(self, source: RigCamera) -> None:
        self._source = source
        self.drawn_ns = 0

    def frame(self) -> RgbdFrame | None:
        """Return the picture now."""
        begin_ns = time.process_time_ns()
        picture = self._source.frame()
        self.drawn_ns += time.process_time_ns() - begin_ns
        return picture

    def close(self) -> None:
        """Release the camera."""
        self._source.close()


def pictures(job: Job) -> dict[str, Any]:
    """Take a picture twice a second while the machine drives past logs: logs in it, processor time without drawing."""
    logs = tuple(_log(k) for k in range(LOG_COUNT))
    with _system(job, _straight, logs) as (system, driver):
        plant, profile = system.plant, system.plant.profile
        body = body_of(plant)
        surveyed = surveyed_profile(profile, plant.world.truth, CAMERA, job.seed)
        source = _Timed(RigCamera(CameraRig(plant.world, profile, plant.world.truth, job.seed), CAMERA))
        localizer = CylinderLocalizer(surveyed, SURVEYED_BY_GNSS)
        front = DrivingLogDetector(surveyed, CAMERA, source, LogSegmenter().segment, localizer)
        counts, times_ms = [], []

        def sample() -> None:
            if abs(body.speed_m_s) < DRIVING_M_S:
                return
            position, turn = plant.base_pose()
            base = CameraPose(np.array(position), quaternion_matrix(turn))
            q = [plant.world.q[j.name.lower()] for j in JOINTS]
            begin_ns, drawn_ns = time.process_time_ns(), source.drawn_ns
            seen = front.detect(base, q, body.articulation_rad)
            times_ms.append((time.process_time_ns() - begin_ns - source.drawn_ns + drawn_ns) / 1e6)
            counts.append(len(seen or ()))

        _run(system, driver, sample, PICTURE_NS)
        return {"logs": counts, "ms": [round(ms, 2) for ms in times_ms], "stops": system.operator.stops}


def _log(number: int) -> LogSpec:
    """Lay a log beside the drive, alternately left and right."""
    side = 1.0 if number % 2 else -1.0
    return LogSpec(6.0 + 2.5 * number, side * 3.5, 0.4 * side, 2.0, 0.25, 800.0)


KINDS: Final[dict[str, Callable[[Job], dict[str, Any]]]] = {
    "calibration": calibrated,
    "primitive": primitive,
    "ground": ground,
    "level": level,
    "pictures": pictures,
}
