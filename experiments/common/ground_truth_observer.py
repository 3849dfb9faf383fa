"""Samples the plant's ground truth during a mission.

On top of a log, just before the grapple is activated, it measures the true offset of the point between the open tips
from the middle of the log, as paper B did with two cameras (4.1.3): across the rear frame, along it, and up.  It
records every grasp with its phases, the path of the front axle, and which logs the machine had detected before it took
them.
"""

from __future__ import annotations

import math
from typing import Any, Final

import numpy as np

from autonomy.crane_job.activity import Activity
from autonomy.crane_job.phases import Phase
from autonomy.localization.local_plane import LocalPlane
from autonomy.manager.log_map import CONFIRMED_HITS
from autonomy.manager.transition_table import State
from autonomy.motion.arm_kinematics import Arm
from experiments.common.minimum_time import full_limits, minimum_time_s
from hil.harness.lockstep import START_NS
from hil.missions.lockstep import MissionRun
from machine.geometry.grapple import tip_below_pin_m
from machine.joints import N_JOINTS, Joint
from machine.profile import Profile
from sim.camera.geometry import quaternion_matrix

PATH_PERIOD_NS: Final = 500_000_000
DETECTION_PERIOD_NS: Final = 1_000_000_000
DETECTED_M: Final = 0.8
"""A log counts as detected if the log map holds one this near: the grapple opens 1.4 m."""
GRASPED_M: Final = 1.2
"""A grasp belongs to the log whose middle is nearest to the grapple, within this distance."""
MOVED_M: Final = 0.3
"""A log that has moved farther than this need not be detected any more."""
REPLACED_M: Final = 8.0
"""A log that has moved farther than this was replaced for another lap."""
MIN_POINTS: Final = 4


class GroundTruthObserver:
    """Observer of one mission; ``step`` is called after every slice of the lockstep."""

    def __init__(self, run: MissionRun, profile: Profile, site: LocalPlane) -> None:
        self.grasps: list[dict[str, Any]] = []
        self.path: list[list[float]] = []
        self.stands: list[list[float]] = []
        """Position of the crane base when the frame was lowered: x, y [m] and time [s]."""
        self._run, self._profile, self._site = run, profile, site
        self._arm, self._limits = Arm(profile), full_limits(profile)
        k = profile.kinematics
        pin_to_rotator = k.hanger_to_fork_m + k.fork_to_rotator_m
        self._tips_m = tip_below_pin_m(profile.grapple.jaws, 0.0)
        self._below_m = self._tips_m - pin_to_rotator
        self._phase: Phase | None = None
        self._activity: Activity | None = None
        self._driven = np.zeros((0, N_JOINTS))
        self._state = run.manager.state
        self._next_path_ns = self._next_detection_ns = 0
        self._lay: dict[int, np.ndarray] = {}
        self.known: set[int] = set()
        """Logs of the scene that were in the log map while they lay in their original place."""

    def step(self) -> None:
        """Sample the present state."""
        run = self._run
        now_ns, manager = run.system.now_ns, run.manager
        if now_ns >= self._next_path_ns:
            self._next_path_ns = now_ns + PATH_PERIOD_NS
            carrier = run.plant.world.carrier
            assert carrier is not None
            x, y, _ = carrier.front_axle()
            self.path.append([round(self._seconds(), 1), round(x, 3), round(y, 3), manager.tally.on_board])
        if now_ns >= self._next_detection_ns:
            self._next_detection_ns = now_ns + DETECTION_PERIOD_NS
            self._update_detected()
        if manager.state is not self._state:
            self._state = manager.state
            if manager.state.name == "LOWER":
                x, y, _ = run.plant.base_pose()[0]
                self.stands.append([round(x, 3), round(y, 3), round(self._seconds(), 1)])
        activity = None if manager.state is State.STOW else manager.activity  # which grasps nothing
        if activity is not self._activity:
            self._activity, self._phase = activity, None
            if activity is not None:
                self._record_grasp()
        if activity is not None and activity.phase is not self._phase:
            self._record_phase(activity)

    def _seconds(self) -> float:
        return (self._run.system.now_ns - START_NS) * 1e-9

    def _update_detected(self) -> None:
        """Update which logs in their original place are in the log map."""
        logs, world = self._run.plant.logs(), self._run.manager.world
        if world.location is None:
            return
        known_positions = [self._in_world(log.center_m) for log in world.log_map.logs if log.hits >= CONFIRMED_HITS]
        for i, log in enumerate(logs):
            at = np.asarray(log.position_m)
            if i not in self._lay or np.linalg.norm(at - self._lay[i]) > REPLACED_M:
                self._lay[i] = at
            if i in self.known or np.linalg.norm(at - self._lay[i]) > MOVED_M:
                continue
            if any(math.dist(at[:2], b) < DETECTED_M for b in known_positions):
                self.known.add(i)

    def _in_world(self, point: np.ndarray) -> tuple[float, float]:
        """Transform a point of the machine's local plane to the plant's world frame."""
        lat, lon, _ = self._run.manager.world.plane.geodetic(float(point[0]), float(point[1]))
        x, y, _ = self._site.local(lat, lon)
        return x, y

    # ------------------------------------------------------------------ grasps
    def _record_grasp(self) -> None:
        state = self._run.manager.state.name
        self.grasps.append({"begin_s": round(self._seconds(), 2), "state": state, "phases": [], "attempts": []})

    def _record_phase(self, activity: Activity) -> None:
        """Record the start of a phase."""
        note = self.grasps[-1]
        self._phase = activity.phase
        note["phases"].append([activity.phase.name, round(self._seconds(), 2), self._shortest(activity)])
        if activity.phase is Phase.CLOSE:
            note["attempts"].append(self._offset(activity))
        elif activity.phase in (Phase.DONE, Phase.FAILED):
            note["failure"] = activity.failure
            note["end_s"] = round(self._seconds(), 2)

    def _shortest(self, activity: Activity) -> float:
        """Compute the shortest time [s] for the path of the phase's motion by speeds, accelerations and pump flow.

        0 if the motion continues that of the phase before, apart from a turn of the rotator.
        """
        before, position = self._driven, np.array(activity.motion.position)
        self._driven = position
        if position.shape == before.shape and np.allclose(position[:, : Joint.ROT], before[:, : Joint.ROT]):
            return 0.0
        if len(position) < MIN_POINTS or float(np.ptp(position, axis=0).max()) < 1e-3:
            return 0.0
        return round(float(minimum_time_s(position, self._limits)), 3)

    def _offset(self, activity: Activity) -> dict[str, Any]:
        """Compute the true offset of the open grapple from the middle of the log that it is about to grasp."""
        plant, grasp = self._run.plant, activity.grasp
        assert grasp is not None
        origin, turn = plant.base_pose()
        base = quaternion_matrix(turn)
        at, hangs = plant.link_poses()["rotator"]
        tips = np.asarray(at) + quaternion_matrix(hangs) @ np.array([0.0, 0.0, -self._below_m])
        in_base = (tips - np.asarray(origin)) @ base
        logs = np.array([(np.asarray(log.position_m) - np.asarray(origin)) @ base for log in plant.logs()])
        apart = np.linalg.norm(logs[:, :2] - in_base[:2], axis=1)
        aboard = [log.in_bunk for log in plant.evaluate().logs]
        if self.grasps[-1]["state"] == "UNLOAD":
            aboard = [not a for a in aboard]
        apart[np.array(aboard, bool)] = math.inf
        log = int(np.argmin(apart))
        planned_z = self._arm.pose(activity.last_setpoint).z_m - self._tips_m - grasp.log.center_m[2]
        along, across, up = (in_base - logs[log]).tolist()
        return {
            "log": log if apart[log] < GRASPED_M else None,
            "logs": len(grasp.logs),
            "meant_m": round(grasp.along_m, 4),
            "off_m": [round(across, 4), round(along, 4), round(up - planned_z, 4)],
        }
