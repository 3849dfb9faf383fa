"""Running machines on which faults are injected: built once, warmed up until they move, and forked for each injection.

A scene names machine, work and plant.  The work is a motion that never ends: the crane swings all joints, or the
carrier follows far waypoints.  Its setpoints are those of a real planner (20 Hz, lease of `draws.LEASE_MS`).  In the
scenes named carry the real planner carries a log to the bunk; in those named hold the crane swings for some seconds and
then holds its pose.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Final

from autonomy.crane_job.activity import Activity
from autonomy.crane_job.phases import Phase
from autonomy.grasp.sampling_planner import SamplingPlanner
from autonomy.grasp.selection import PlannerSelection
from autonomy.motion.setpoint_stream import PERIOD_NS, SetpointStream
from autonomy.perception.log_list import LogObservation
from can_dbc.messages.crane import GrappleCommand, StateReport
from can_dbc.messages.datagrams import encode
from can_dbc.messages.vehicle import DriveSetpoint, Steering, VehicleReport
from controller.config import Settings
from controller.config import load as load_settings
from controller.crane.load import LoadMoment
from controller.guard.__main__ import build as build_guard
from controller.guard.__main__ import profile_path
from experiments.faults.evidence import Evidence
from hil.faults.draws import LEASE_MS, Scene
from hil.faults.injector import Injector
from hil.harness.lockstep import START_NS, Lockstep, Observer
from hil.harness.operator import Operator
from hil.plc import BridgedPlant, write_plc_profile
from machine.geometry.kinematics import pin_position
from machine.joints import JOINTS, Joint
from machine.profile import Profile
from machine.status.modes import Mode
from runtime.errors import InputRefused
from sim.kinematic import KinematicMachine
from sim.plant import Plant

STEP_NS: Final = 2_500_000
LEASE_NS: Final = round(LEASE_MS * 1e6)
SWING_SHARE: Final = 0.04
"""Amplitude of the swing as a share of the joint's range."""
SPEED_SHARE: Final = 0.5
"""Share of the joint's speed and acceleration limits that the swing uses."""
HOLD_AFTER_S, SLOWING_S = 4.0, 1.5
"""In a hold scene the crane swings for so long, and comes to rest in so long."""
HELD_NS: Final = 500_000_000
FAR_M: Final = 80.0
TURN_RAD: Final = 0.6
TURN_NS: Final = 5_000_000_000
"""The next waypoint lies this far to the other side after this time, so that the machine always turns."""
SPEED_M_S: Final = 0.6
WARM_LIMIT_NS: Final = 60_000_000_000
MOVING_NS: Final = 1_000_000_000
CARRIED_NS: Final = 300_000_000
"""The machine has moved, or carried its log, for so long before the first injection."""
KINDS: Final = {
    "crane palms_471": ("palms_471", "kinematic"),
    "crane palms_471 physics": ("palms_471", "physics"),
    "crane aoro_fc8": ("aoro_fc8", "kinematic"),
    "crane aoro_fc8 physics": ("aoro_fc8", "physics"),
    "hold palms_471 physics": ("palms_471", "physics"),
    "hold aoro_fc8 physics": ("aoro_fc8", "physics"),
    "carry palms_471": ("palms_471", "physics"),
    "carry aoro_fc8": ("aoro_fc8", "physics"),
    "drive aoro_fc8": ("aoro_fc8", "kinematic"),
    "drive aoro_fc8 physics": ("aoro_fc8", "physics"),
    "plc valves palms_471": ("palms_471", "plc valves"),
    "plc references palms_471": ("palms_471", "plc references"),
}
"""Scenes by name: profile, and plant."""


class Swing:
    """A motion of all joints without end; at rest at time 0.  A joint without an encoder stands."""

    duration_s = math.inf

    def __init__(self, profile: Profile, start: Sequence[float]) -> None:
        self._joints = []
        pose = [q if math.isfinite(q) else 0.0 for q in start]
        for j, q in zip(JOINTS, start, strict=True):
            s = profile.joints[j.name.lower()]
            known = s.encoder is not None and math.isfinite(q)
            half = SWING_SHARE * (s.upper - s.lower) * _side(profile, pose, j) if known else 0.0
            w = (
                SPEED_SHARE * min(s.speed_limit / abs(half), math.sqrt(s.acceleration_limit / abs(half)))
                if half
                else 0.0
            )
            self._joints.append((q if math.isfinite(q) else 0.0, half, w))

    def at(self, time_s: float) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Return positions and velocities."""
        t = max(0.0, time_s)
        q = tuple(start + half * (1.0 - math.cos(w * t)) for start, half, w in self._joints)
        return q, tuple(half * w * math.sin(w * t) for _, half, w in self._joints)


def _side(profile: Profile, pose: Sequence[float], j: Joint) -> float:
    """Choose to which side a joint swings, 1 or -1: the pin rises, for below is the ground; else to the middle."""
    spec = profile.joints[j.name.lower()]
    middle = 0.5 * (spec.lower + spec.upper)
    moved = [q + SWING_SHARE * (spec.upper - spec.lower) * (i == j) for i, q in enumerate(pose)]
    rise_m = pin_position(profile.kinematics, moved)[2] - pin_position(profile.kinematics, pose)[2]
    limit = spec.upper if rise_m > 0.0 else spec.lower
    if rise_m == 0.0 or abs(limit - pose[j]) < 2.0 * SWING_SHARE * (spec.upper - spec.lower):
        return math.copysign(1.0, middle - pose[j])
    return math.copysign(1.0, rise_m)


class HeldSwing:
    """A swing that slows down along its path and then holds its pose for ever."""

    duration_s = math.inf

    def __init__(self, swing: Swing) -> None:
        self._swing = swing

    def at(self, time_s: float) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Return positions and velocities: the swing's, at a time of its own that stops."""
        slowing_s = min(max(0.0, time_s - HOLD_AFTER_S), SLOWING_S)
        share = slowing_s / SLOWING_S
        # The rate is 1 - 3 share^2 + 2 share^3: no step in speed or acceleration at either end.
        rate = 1.0 - share * share * (3.0 - 2.0 * share)
        slowed_s = SLOWING_S * (share - share**3 + 0.5 * share**4)
        q, v = self._swing.at(min(time_s, HOLD_AFTER_S) + slowed_s)
        return q, tuple(rate * speed for speed in v)


class CranePlanner:
    """Swings the crane while the machine is armed, or swings it and then holds."""

    def __init__(self, profile: Profile, profile_hash: int, holds: bool = False) -> None:
        self._profile, self._holds = profile, holds
        self._stream = SetpointStream(profile_hash, LEASE_NS)
        self._motion: Swing | HeldSwing | None = None
        self._begin_ns = 0
        self._report: StateReport | None = None

    def step(self, now_ns: int, report: StateReport | None, logs: tuple[LogObservation, ...] | None) -> bytes | None:
        """Return the setpoint to send now."""
        self._report = report or self._report
        if self._report is None or self._report.mode not in (Mode.ARMED, Mode.ACTIVE):
            self._motion = None
            return None
        if not self._stream.due(now_ns):
            return None
        if self._motion is None:
            swing = Swing(self._profile, self._report.reference)
            self._motion, self._begin_ns = HeldSwing(swing) if self._holds else swing, now_ns
        time_s = (now_ns - self._begin_ns) * 1e-9
        return self._stream.datagram(now_ns, self._motion, time_s, GrappleCommand.NEUTRAL)


class DrivePlanner:
    """Drives towards waypoints far ahead, to the left and to the right in turn, while the machine is armed."""

    def __init__(self, profile: Profile, profile_hash: int) -> None:
        assert profile.carrier is not None
        self._carrier, self._hash = profile.carrier, profile_hash
        self._vehicle: VehicleReport | None = None
        self._goal: tuple[float, float] | None = None
        self._sequence = self._sent_ns = self._turned_ns = 0
        self._side = 1.0
        self._armed = False

    def receive(self, report: VehicleReport) -> None:
        """Receive a report of the vehicle."""
        self._vehicle = report

    def step(self, now_ns: int, report: StateReport | None, logs: tuple[LogObservation, ...] | None) -> bytes | None:
        """Return the setpoint to send now."""
        if report is not None:
            self._armed = report.mode in (Mode.ARMED, Mode.ACTIVE)
        v = self._vehicle
        if not self._armed or v is None or now_ns - self._sent_ns < PERIOD_NS or math.isnan(v.heading_rad):
            return None
        if self._goal is None or now_ns - self._turned_ns > TURN_NS:
            self._side, self._turned_ns = -self._side, now_ns
            bearing = v.heading_rad + self._side * TURN_RAD
            north, east = FAR_M * math.cos(bearing), FAR_M * math.sin(bearing)
            per_deg_m = 111_320.0
            self._goal = (
                v.latitude_deg + north / per_deg_m,
                v.longitude_deg + east / (per_deg_m * math.cos(math.radians(v.latitude_deg))),
            )
        self._sequence, self._sent_ns = self._sequence + 1, now_ns
        heights = (self._carrier.arm_transport_m,) * 4
        setpoint = DriveSetpoint(
            self._sequence,
            self._hash,
            now_ns,
            LEASE_NS,
            Steering.WAYPOINT,
            *self._goal,
            0.0,
            0.0,
            SPEED_M_S,
            heights,
            False,
            False,
        )
        return encode(setpoint)


class Supervisor(Operator):
    """The emulated operator, who lets go once ``hands_off`` is set and only watches: nothing may start by itself
    after that.
    """

    hands_off = False

    def _press(self, report: StateReport) -> bytes | None:
        return None if self.hands_off else super()._press(report)


class _NoLogs:
    """A detector that sees nothing."""

    def detect(self, q: Sequence[float], now_ns: int) -> None:
        return None


@dataclass(slots=True)
class Running:
    """A running machine with its evidence and its injector."""

    name: str
    scene: Scene
    system: Lockstep
    plant: Any
    operator: Supervisor
    evidence: Evidence
    injector: Injector

    @property
    def holds(self) -> bool:
        """Whether the crane holds its pose, so that neutral valves are no reaction."""
        return self.name.startswith("hold")

    def advance(self) -> None:
        """Run one slice."""
        self.system.advance()
        self.evidence.slice(self.system.now_ns)

    def until_moving(self) -> None:
        """Run until the machine has moved for a second.

        Raises:
            InputRefused: it does not.
        """
        system, since_ns = self.system, 0
        needed_ns = MOVING_NS if self.phase() is None else CARRIED_NS
        while not since_ns or system.now_ns < since_ns + needed_ns:
            self.advance()
            moving = system.report is not None and system.report.mode == Mode.ACTIVE and self.speed() > 0.0
            moving = moving and self.phase() in (None, Phase.CARRY)
            since_ns = (since_ns or system.now_ns) if moving else 0
            if system.now_ns > START_NS + WARM_LIMIT_NS:
                reason = system.report.reason if system.report else -1
                raise InputRefused(
                    "experiment.not-moving", f"the machine of scene {self.name!r} does not move: reason {reason}"
                )

    def until_held(self) -> None:
        """Run on until the reference has stood for half a second.

        Raises:
            InputRefused: it does not.
        """
        system, since_ns, before = self.system, 0, None
        while not since_ns or system.now_ns < since_ns + HELD_NS:
            self.advance()
            reference = system.report.reference if system.report is not None else None
            if reference != before:
                since_ns = 0
            elif not since_ns:
                since_ns = system.now_ns
            before = reference
            if system.now_ns > START_NS + WARM_LIMIT_NS:
                raise InputRefused(
                    "experiment.not-holding", f"the machine of scene {self.name!r} does not hold its pose"
                )

    def phase(self) -> Phase | None:
        """Return the phase of the log job, as its planner tells it; None in the other scenes."""
        planner = self.system.activity
        return planner.phase if isinstance(planner, Activity) else None

    def speed(self) -> float:
        """Return the greatest speed of what moves here, as the machine itself reports it [rad/s, m/s]."""
        if self.scene.drives:
            vehicle = self.system.vehicle_report
            return abs(vehicle.speed_m_s) if vehicle is not None and math.isfinite(vehicle.speed_m_s) else 0.0
        report = self.system.report
        return max((abs(v) for v in report.velocity if math.isfinite(v)), default=0.0) if report else 0.0

    def place(self) -> tuple[float, ...]:
        """Return the true place of what could hurt [m]: hanger pin in the base frame, or front axle in the world."""
        if self.scene.drives:
            return tuple(self.plant.world.carrier.front_axle())
        return tuple(pin_position(self.scene.profile.kinematics, self.plant.joint_positions()[:4]))

    def astray_m(self) -> float:
        """Compute the pin's distance from its reference [m]; 0 while driving, where the path itself counts."""
        report = self.system.report
        if self.scene.drives or report is None or not all(map(math.isfinite, report.reference[:4])):
            return 0.0
        return math.dist(pin_position(self.scene.profile.kinematics, report.reference[:4]), self.place())

    def overloaded(self) -> bool:
        """Tell whether the machine carries more than it bears (ground truth).

        The force at the hanger pin makes a moment about the tipping line beyond the limit, or the lift's oil is above
        the pump's relief: the pump cannot lift the load, and a little more opens the port's.
        """
        profile, world = self.scene.profile, self.plant.world
        if profile.stability is None:
            return False
        judged = LoadMoment(profile, profile.stability)
        moment_nm = judged.moment_nm(self.plant.joint_positions(), world.load_kg(), *self.plant.tilt_rad)
        relief_pa = world.truth.supply.relief_pa
        return moment_nm > judged.limit_nm or max(world.hydraulics.pressures_pa["lift"]) > relief_pa

    def valves_neutral(self) -> bool:
        """Tell whether the valve node's outputs are neutral now (ground truth; a held grapple counts as neutral)."""
        plc = getattr(self.plant, "plc", None)
        outputs = plc.outputs if plc is not None else self.plant.valve.outputs_pct
        node = self.plant.vehicle_node
        return not any(outputs[:5]) and (node is None or node.brake or not node.drive_m_s)


def build(name: str, seed: int = 0, truth: str = "nominal", terrain: str = "flat") -> Running:
    """Build the machine of a scene at its start."""
    profile_name, kind = KINDS[name]
    with tempfile.TemporaryDirectory() as folder:
        path = profile_path(profile_name)
        if kind.startswith("plc"):
            role = "valves" if kind.endswith("valves") else "references"
            path = write_plc_profile(profile_name, role, Path(folder))  # type: ignore[arg-type]
        settings, guard = load_settings(path), build_guard(path)
    drives, carries = name.startswith("drive"), name.startswith("carry")
    profile = settings.profile
    plant = Plant(profile, seed, truth) if carries else _plant(settings, kind, seed, truth, terrain)
    vehicle_hooks: list[Callable[[VehicleReport], None]] = []
    planner: CranePlanner | DrivePlanner | Activity
    if carries:
        planner = Activity(profile, settings.profile_hash, grasp_selector=PlannerSelection(SamplingPlanner()))
    elif drives:
        planner = DrivePlanner(profile, settings.profile_hash)
        vehicle_hooks.append(planner.receive)
    else:
        planner = CranePlanner(profile, settings.profile_hash, name.startswith("hold"))
    operator = Supervisor(settings.profile_hash, lambda *_: None, watches=True)
    observer = Observer(None, [], vehicle_hooks)
    system = Lockstep(settings, guard, plant, planner, operator, observer, None if carries else _NoLogs())
    evidence = Evidence(system.cores, profile)
    observer.on_outputs.append(evidence.outputs)
    observer.on_report.append(evidence.report)
    observer.on_vehicle.append(evidence.vehicle)
    scene = Scene(profile, drives, kind.startswith("plc"))
    return Running(name, scene, system, plant, operator, evidence, Injector(system))


def _plant(settings: Settings, kind: str, seed: int, truth: str, terrain: str) -> Any:
    profile = settings.profile
    if kind == "kinematic":
        return KinematicMachine(profile, seed, truth, step_ns=STEP_NS)
    if kind == "physics":
        return Plant(profile, seed, truth, scene=(), terrain=terrain)
    return BridgedPlant(profile, seed, truth, logs=1, transport="udp" if kind.endswith("valves") else "modbus")


@cache
def warm(name: str) -> Running:
    """Build the machine of a scene and bring it into motion; one per process."""
    machine = build(name)
    machine.until_moving()
    if machine.holds:
        machine.until_held()
    machine.operator.hands_off = True
    return machine
