"""One grasping attempt of paper A IV-A: new arrangement, detection, plan, crane on the bus, lift, hold.

Controller, guard, CAN bytes and plant are those of every lockstep run.  The logs are detected by the camera on the
stick from where the crane rests, at the start and where the activity asks for another detection, or taken from the
plant (poses ``true``).  The physics decides the outcome.
"""

from __future__ import annotations

import math
import random
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from autonomy.crane_job.activity import SETTLE_AFTER_ARRIVAL_NS, Activity
from autonomy.crane_job.phases import Phase
from autonomy.grasp.planner import GraspCandidate, GraspPlanner, GraspRequest
from autonomy.grasp.planners import GRASP_PLANNERS, SEARCH, PlannerChoice
from autonomy.grasp.planners import NETWORKS as WEIGHT_FILES
from autonomy.grasp.selection import PlannerSelection
from autonomy.motion.motion_planner import TimeOptimalPlanner
from autonomy.networks import SHIPPED
from autonomy.perception.log_list import LogObservation
from can_dbc.messages.crane import StateReport
from controller.config import Settings
from controller.guard.__main__ import build as build_guard
from experiments.common import plugins
from experiments.common.individuals import controller_profile
from experiments.common.pool import Job
from experiments.common.recording import recorder_of
from experiments.common.worlds import profile_named, wood_of
from experiments.grasp_configs.grasp_categories import Grip, category, lifted
from experiments.grasp_configs.pose_sources import Detection, PoseSource, misled, pose_source
from hil.harness.lockstep import START_NS, Lockstep, Observer
from hil.harness.operator import Operator
from machine.loading.profile_file import load_profile, profile_hash
from machine.profile import Profile
from recorder.recorder import Recorder
from sim.errors import PlantError
from sim.plant import Plant
from sim.scenes.arrangements import configuration
from sim.wood.log_shape import LogSpec
from sim.wood.stacking import footprint_gap
from sim.world import home_pose

LIMIT_NS: Final = 60_000_000_000
HELD_NS: Final = 2_000_000_000
SEEDS_PER_ATTEMPT: Final = 16
SEGMENTATION: Final = "logs_rgbd.onnx"
REACH_M: Final = (3.5, 6.5)
"""Distances of the places from the crane's column."""
ASIDE_RAD: Final = math.radians(30.0)
"""A place lies at most this far aside of the direction in which the crane starts; its camera sees 45 degrees."""
END_RAD: Final = math.radians(5.0)
"""Places and starts keep this distance from the slew's end stops."""
BUNK_GAP_M: Final = 1.0
"""Least distance of the logs from the bunk, in which open jaws come down."""
PLACES: Final = 100
NETWORKS: Final = {"cnn": "cnn", "cnn_physical": "cnn-physical"}
"""Names of the networks' planners in the results, and in `autonomy.grasp.planners`."""
PAPER_A: Final = "cnn"
VIRTUAL_CAMERAS: Final = 8
"""Places of paper A's virtual camera, over which its network's predictions are averaged (II-C)."""


@dataclass(slots=True)
class Attempt:
    """The planner of the lockstep run: the autonomy's activity with detections from where the crane rests."""

    activity: Activity
    source: PoseSource
    seen: Detection = field(default_factory=Detection)
    looks: int = 0
    """Number of detections; ``seen`` is the last one."""
    _q: tuple[float, ...] = ()
    """Joint positions last measured."""
    _up_ns: int = 0
    """Time at which the lift was completed [ns]; 0: not yet."""
    _rested_ns: int = 0
    """Time since which the crane rests above the logs [ns]."""

    def step(self, now_ns: int, report: StateReport | None, logs: tuple[LogObservation, ...] | None) -> bytes | None:
        """Run one planner cycle (contract of ``hil.harness.lockstep.Planner``); detect logs where the crane rests."""
        activity = self.activity
        self._q = self._q if report is None else report.position
        data = activity.step(now_ns, report, self._looked(now_ns) if logs is not None and self._q else None)
        if self._up_ns == 0 and activity.phase is Phase.LIFT and activity.arrived:
            self._up_ns = now_ns
        return data

    def _looked(self, now_ns: int) -> tuple[LogObservation, ...] | None:
        """Return the logs of a new detection where the crane rests, as a camera on a moving stick is not used."""
        rests = self.activity.phase in (Phase.LOOK, Phase.ABOVE) and self.activity.arrived
        self._rested_ns = (self._rested_ns or now_ns) if rests else 0
        if not rests or now_ns < self._rested_ns + SETTLE_AFTER_ARRIVAL_NS:
            return None
        self._rested_ns = now_ns
        self._look(now_ns)
        return self.seen.logs

    def _look(self, now_ns: int) -> None:
        self.seen = self.source.detect(now_ns, self._q)
        self.looks += 1

    def over(self, now_ns: int) -> bool:
        """Tell whether the grapple has been held still for two seconds after the lift."""
        return self._up_ns > 0 and now_ns - self._up_ns > HELD_NS


@dataclass(slots=True)
class TimedPlanner:
    """A planner that keeps its proposal and its CPU time."""

    planner: GraspPlanner
    proposal: GraspCandidate | None = None
    seconds: float = math.nan

    def __call__(self, request: GraspRequest) -> GraspCandidate:
        """See ``autonomy.grasp.planner``."""
        begun = time.process_time()
        try:
            self.proposal = self.planner(request)
        finally:
            self.seconds = time.process_time() - begun
        return self.proposal


def weights_of(poses: str, planner: str) -> bool:
    """Tell whether the weights that a pair of the ablation needs exist."""
    needed = [WEIGHT_FILES[NETWORKS[planner]]] if planner in NETWORKS else []
    needed += [SEGMENTATION] if poses in ("ours", "faithful") else []
    return all((SHIPPED / name).exists() for name in needed)


def planner_named(name: str) -> GraspPlanner:
    """Make the planner with this name: one of ours, or that of an entry point.

    Raises:
        InputRefused: the network's weights are missing or damaged.
        InputRefused: there is no such planner.
    """
    if name == SEARCH or name in NETWORKS:
        return PlannerChoice(NETWORKS.get(name, name), VIRTUAL_CAMERAS if name == PAPER_A else 1).make()
    return plugins.load(GRASP_PLANNERS, name)  # type: ignore[no-any-return]


def attempt(job: Job) -> dict[str, Any]:
    """Run one attempt.

    Options: profile, truth, configuration, poses (of ``pose_sources.POSE_SOURCES``, or a foreign detector), planner
    (search, cnn, cnn_physical, or a foreign one), scene (its seed; that of the job draws the machine), text (of the
    calibrated profile; None: as shipped), record (folder of a recording).
    """
    with controller_profile(job.options["profile"], job.options.get("text")) as name:
        profile = load_profile(name)
        with recorder_of(job, profile, name) as recorder:
            return _attempt(job, profile, name, recorder)


def _attempt(job: Job, profile: Profile, name: str, recorder: Recorder | None) -> dict[str, Any]:
    o = job.options
    number, field = o["configuration"], o.get("scene", job.seed)
    digest = profile_hash(profile)
    scene, slew_rad = arranged(o["profile"], o["truth"], number, field)
    plant = Plant(profile_named(o["profile"]), job.seed, o["truth"], scene=scene, home={"slew": slew_rad})
    try:
        before = plant.logs()
        timed = TimedPlanner(planner_named(o["planner"]))
        activity = Activity(
            profile, digest, grasp_selector=PlannerSelection(timed), motion_planner=TimeOptimalPlanner(direct=False)
        )
        planner_run = Attempt(activity, pose_source(o["poses"], plant, profile, field))
        operator = Operator(digest, lambda *_: None)
        settings = Settings(profile, digest, profile.rate_hz)
        guard = build_guard(Path(name))
        system = Lockstep(settings, guard, plant, planner_run, operator, Observer(recorder, []))
        grip, closings = Grip(0.0, 0.0, 0.0), 0
        phase = activity.phase
        while not activity.failure and not operator.gave_up and not planner_run.over(system.now_ns):
            system.advance()
            if activity.phase is not phase:
                phase = activity.phase
                closings += phase is Phase.CLOSE
                if phase is Phase.LIFT:
                    grip = _grip(plant)
            if system.now_ns > START_NS + LIMIT_NS:
                break
        ground = profile.workspace.ground_z_m
        up = lifted(before, plant.logs(), ground) if planner_run.over(system.now_ns) else []
        evaluation = plant.evaluate()
        up = [i for i in up if evaluation.logs[i].left_ground or not evaluation.logs[i].max_grip_n]
        p, seen = timed.proposal, planner_run.seen
        wrong = misled(before, seen.logs)
        rise = [now.position_m[2] - was.position_m[2] for was, now in zip(before, plant.logs(), strict=True)]
        return {
            "configuration": number,
            "individual": o["truth"] == "sampled",
            "category": category(number, before, up, grip, wrong),
            "lifted": len(up),
            "misled": wrong,
            "looks": planner_run.looks,
            "closings": closings,
            "seen": len(seen.logs),
            "see_ms": 1e3 * seen.seconds,
            "logs": len(before),
            "up": up,
            "failure": activity.failure,
            "stops": operator.stops,
            "expected": list(p.logs) if p else [],
            "probability": p.probability if p else math.nan,
            "reason": p.reason if p else "",
            "plan_ms": 1e3 * timed.seconds,
            "grip": [grip.x_m, grip.y_m, grip.yaw_rad],
            "rise_m": rise,
            "tong_rad": plant.jaw_angle_rad(),
            "asked": [p.x_m, p.y_m, p.yaw_rad] if p else [],
            "seconds": (system.now_ns - START_NS) * 1e-9,
        }
    finally:
        plant.close()


def _grip(plant: Plant) -> Grip:
    """Return the true position where the grapple closed."""
    x, y, _ = plant.tip()
    (_, turn) = plant.link_poses()["rotator"]
    m = plant.world.client.getMatrixFromQuaternion(turn)
    return Grip(x, y, math.atan2(m[3], m[0]))


def arranged(profile: str, truth: str, number: int, seed: int) -> tuple[tuple[LogSpec, ...], float]:
    """Arrange the logs of an attempt and choose the slew angle [rad] at which the crane starts: random sizes, a random
    place, a random direction.

    A fixed crane gets a place anywhere in its reach, clear of the bunk; it starts turned so far that its camera sees
    the place.  A forwarder gets its pick area.
    """
    machine, wood, drawn = profile_named(profile), wood_of(profile, truth), seed * SEEDS_PER_ATTEMPT + number
    if machine.carrier is not None:
        return configuration(number, machine, wood, drawn), home_pose(machine, truth)["slew"]
    slew, bunk, rng = machine.joints["slew"], machine.bunk, random.Random(drawn)
    stakes = LogSpec(*bunk.center_m, bunk.yaw_rad, bunk.length_m, bunk.width_m, 0.0)
    for _ in range(PLACES):
        reach_m, slew_rad = rng.uniform(*REACH_M), rng.uniform(slew.lower + END_RAD, slew.upper - END_RAD)
        aside_rad = rng.uniform(-ASIDE_RAD, ASIDE_RAD)
        turn_rad = machine.kinematics.theta1_offset_rad + slew_rad
        at = (reach_m * math.cos(turn_rad), reach_m * math.sin(turn_rad))
        logs = configuration(number, machine, wood, drawn, at=at)
        if min(footprint_gap(log, stakes) for log in logs) >= BUNK_GAP_M:
            return logs, min(max(slew_rad + aside_rad, slew.lower + END_RAD), slew.upper - END_RAD)
    raise PlantError(
        "scene.no-place",
        f"configuration {number} fits nowhere in the reach of {profile} beside its bunk; move the bunk",
    )
