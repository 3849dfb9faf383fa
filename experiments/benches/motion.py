"""Benchmark of motion planning: planning time and duration of collision-free motions, compared with full-height travel.

In every scene one cycle is planned as the activity does: from the rest position to a log, with the log to the bunk, and
back to the next log.  Planning is measured in CPU time of this process, for the first run and for the best of a few,
which is what a quiet host takes.  Motions are compared with `autonomy.motion.trajectory.travel`.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Final

import numpy as np

from autonomy.crane_job.phase_motions import approach_motion, carry_motion
from autonomy.grasp.bunk_load import plan_place
from autonomy.grasp.grapple_heights import approach_length_m, hover_height_m, travel_height_m
from autonomy.grasp.planner import NoGrasp
from autonomy.grasp.selection import plan_single_log_grasp
from autonomy.missions.crane_job import CraneJob
from autonomy.motion.arm_kinematics import Arm, Pose
from autonomy.motion.clearance import clearance_reserve
from autonomy.motion.motion_planner import TimeOptimalPlanner
from autonomy.motion.obstacles import CollisionScene, HeldLog, collision_scene, held_log
from autonomy.motion.trajectory import Trajectory, travel_over
from autonomy.perception.log_list import LogObservation
from experiments.common.worlds import wood_of
from machine.geometry.kinematics import Unreachable
from machine.profile import Profile
from sim.scenes.arrangements import arrangement
from sim.wood.log_shape import LogSpec
from sim.world import home_pose

SCENES: Final = (("separate", 2), ("parallel", 3), ("crossed", 3), ("pile", 5))
REPEAT_COUNT: Final = 3
GOAL_MS: Final = 50.0


@dataclass(slots=True)
class Bench:
    """Measurements of one machine.

    CPU times [ms], durations [s] of our motions and of travel, clearance of travel [m].
    """

    cpu_ms: list[float] = field(default_factory=list)
    best_ms: list[float] = field(default_factory=list)
    ours_s: list[float] = field(default_factory=list)
    travel_s: list[float] = field(default_factory=list)
    travel_spare_m: list[float] = field(default_factory=list)
    blocked: list[str] = field(default_factory=list)
    no_grasp: int = 0

    def metrics(self) -> dict[str, float]:
        """Compute the metrics by name."""
        return {
            "motions": len(self.cpu_ms),
            "blocked": len(self.blocked),
            "no_grasp": self.no_grasp,
            "cpu_p50_ms": _at(self.cpu_ms, 50),
            "cpu_p95_ms": _at(self.cpu_ms, 95),
            "cpu_best_p50_ms": _at(self.best_ms, 50),
            "cpu_best_p95_ms": _at(self.best_ms, 95),
            "ours_mean_s": float(np.mean(self.ours_s)) if self.ours_s else math.nan,
            "travel_mean_s": float(np.mean(self.travel_s)) if self.travel_s else math.nan,
            "travel_too_near": int(sum(s < 0.0 for s in self.travel_spare_m)),
        }


def _at(values: list[float], percent: float) -> float:
    return float(np.percentile(values, percent)) if values else math.nan


def run(profile: Profile, seeds: int, progress: Callable[[int, int], None] = lambda done, total: None) -> Bench:
    """Plan one cycle in every scene of every seed."""
    bench, arm, wood = Bench(), Arm(profile), wood_of(profile.name, "nominal")
    home = arm.pose(tuple(home_pose(profile)[n] for n in ("slew", "lift", "tilt", "ext", "rot")))
    cases = [(kind, count, seed) for seed in range(seeds) for kind, count in SCENES]
    for i, (kind, count, seed) in enumerate(cases):
        logs = [observed(profile, k, s) for k, s in enumerate(arrangement(kind, profile, wood, seed, count))]
        _cycle(bench, arm, home, logs)
        progress(i + 1, len(cases))
    return bench


def observed(profile: Profile, number: int, spec: LogSpec) -> LogObservation:
    """Turn a log of a scene into an ideal detection in the crane's base frame, with the machine at its lowest."""
    x, y, yaw, c = spec.x_m, spec.y_m, spec.yaw_rad, profile.carrier
    if c is not None:
        dx, dy, turn = x - c.crane_base_m[0], y - c.crane_base_m[1], -c.crane_yaw_rad
        x, y = math.cos(turn) * dx - math.sin(turn) * dy, math.sin(turn) * dx + math.cos(turn) * dy
        yaw += turn
    z = profile.workspace.ground_z_m + spec.z_m + spec.diameter_m / 2
    return LogObservation(number, (x, y, z), (math.cos(yaw), math.sin(yaw), 0.0), spec.length_m, spec.diameter_m)


def _cycle(bench: Bench, arm: Arm, home: Pose, logs: list[LogObservation]) -> None:
    profile, top = arm.profile, travel_height_m(arm.profile)
    log = max(logs, key=lambda o: o.center_m[2])
    other_logs = [o for o in logs if o is not log]
    try:
        grasp = plan_single_log_grasp(arm, log, home.rot_rad)
        drop_pose = plan_place(arm, CraneJob(), grasp, logs)
    except NoGrasp:
        bench.no_grasp += 1
        return
    motions, free_m = TimeOptimalPlanner(), approach_length_m(profile, log)
    around, held = collision_scene(profile, other_logs), held_log(arm, grasp.pose, log)
    over = grasp.pose.at_height(hover_height_m(profile, grasp))
    clear = Task(collision_scene(profile, logs), None, top, 0.0)
    laden = Task(around, held, top, free_m)
    _measure(bench, arm, home, over, clear, partial(approach_motion, arm, motions, home, grasp, logs))
    _measure(
        bench,
        arm,
        grasp.pose,
        drop_pose,
        laden,
        partial(carry_motion, arm, motions, grasp.pose, drop_pose, grasp, logs, False),
    )
    _measure(
        bench,
        arm,
        drop_pose,
        over,
        Task(around, None, top, 0.0),
        partial(approach_motion, arm, motions, drop_pose, grasp, other_logs),
    )


@dataclass(frozen=True, slots=True)
class Task:
    """Obstacles, the held log, and for `travel_over` its height and the straight approach before the goal [m]."""

    around: CollisionScene
    held: HeldLog | None
    high_m: float
    free_m: float


def _measure(bench: Bench, arm: Arm, start: Pose, goal: Pose, task: Task, make: Callable[[], Trajectory]) -> None:
    times = []
    for _ in range(1 + REPEAT_COUNT):
        begin = time.process_time()
        try:
            motion = make()
        except Unreachable as error:
            bench.blocked.append(str(error))
            return
        times.append(1e3 * (time.process_time() - begin))
    bench.cpu_ms.append(times[0])
    bench.best_ms.append(min(times))
    try:
        always = travel_over(arm, start, goal, task.high_m, task.free_m)
    except Unreachable:
        return
    bench.ours_s.append(motion.duration_s)
    bench.travel_s.append(always.duration_s)
    bench.travel_spare_m.append(clearance_reserve(arm, always, task.around, task.held)[0])
