"""Virtual log lists from the log map, for a machine whose only camera looks ahead.

Paper B's crane works from what the front camera saw while driving: log positions in the plane (3.2.6) are transformed
into the crane's base frame by the receiver and the kinematic chain.  Logs in the grapple move with it while the crane
scale measures a load; logs in the bunk lie where they fell.  Four times a second this yields a list like a detector's,
with the map's numbers.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from autonomy.crane_job.activity import Activity
from autonomy.crane_job.phases import Phase
from autonomy.grasp.bunk_load import is_over_bunk, lies_in_bunk, reaches_above_stakes, settled_in_bunk
from autonomy.manager.load_detector import LoadDetector, WoodScale
from autonomy.manager.log_map import LogMap
from autonomy.motion.arm_kinematics import Arm, slope_of
from autonomy.perception.camera.frame import Pose
from autonomy.perception.log_list import LogObservation
from can_dbc.messages.crane import StateReport
from machine.geometry.grapple import grapple_yaw
from machine.joints import JOINTS
from machine.profile import Profile, joint

PERIOD_NS: Final = 250_000_000
RANGE_M: Final = 12.0
LIFTED_M: Final = 0.5
"""The scale is used above this height only: below it, the log may still rest on the ground."""
BESIDE_M: Final = 0.45
"""Jaws may close on a log whose axis is no farther than this from the middle of the grasp on the ground."""


@dataclass(frozen=True, slots=True)
class Grip:
    """What a released grip held, by its weight ``read_kg`` [kg] (NaN: not weighed): logs that nobody meant to grip, and
    the numbers of those that were meant and did not come up.

    ``high``: the numbers of the released logs that by the model of the load lie as high as the stakes.
    """

    also: tuple[LogObservation, ...]
    left: tuple[int, ...]
    read_kg: float
    high: tuple[int, ...] = ()


class LogMemory:
    """Call ``log_list`` once per step; see the module's contract."""

    def __init__(self, profile: Profile) -> None:
        self._profile, self._arm = profile, Arm(profile)
        self._due_ns = 0
        self._in_bunk: list[LogObservation] = []
        self._job: Activity | None = None
        self._held: dict[int, LogObservation] = {}
        """Logs of the grasp relative to hanger pin and grapple yaw, from the time it closed."""
        self._meant: tuple[int, ...] = ()
        self._low_m = 0.0
        self._released: list[LogObservation] = []
        self._beside: tuple[LogObservation, ...] = ()
        self._beside_held: dict[int, LogObservation] = {}
        """The logs beside the grasp as they would hang."""
        self.grip: Grip | None = None
        """What the job has released, by its weight; None before that."""
        self._wood = WoodScale()
        self._load_detector: LoadDetector | None = None
        self._slipped = False

    @property
    def in_bunk(self) -> int:
        """Number of logs that were placed in the bunk."""
        return len(self._in_bunk)

    def lose(self, count: int) -> None:
        """Forget logs that fell off the bunk: which ones is unknown, so those laid last, which lie on top."""
        if count:
            del self._in_bunk[-count:]

    def leave(self) -> None:
        """Forget what the job has released: it never hung in the jaws, and lies where it lay."""
        self._released = []

    def correct(self, load: LogObservation, report: StateReport) -> None:
        """Let the load hang as a camera sees it, in the base frame: what the jaws hold turns with it about the pin."""
        if not self._held:
            return
        _, yaw = self._pin(report)
        remembered = max(self._held.values(), key=lambda log: log.length_m)
        seen = math.atan2(load.axis[1], load.axis[0]) - yaw
        turn = math.remainder(seen - math.atan2(remembered.axis[1], remembered.axis[0]), math.pi)
        for held in (self._held, self._beside_held):
            for number, log in held.items():
                held[number] = replace(log, center_m=_turned(log.center_m, turn), axis=_turned(log.axis, turn))
        self._due_ns = 0

    def log_list(
        self, now_ns: int, log_map: LogMap, base: Pose, report: StateReport | None, job: Activity | None
    ) -> tuple[LogObservation, ...] | None:
        """Return the remembered logs in the base frame; None when no new list is due."""
        if job is not self._job:
            self._end()
            self._job = job
            self._arm = Arm(self._profile, slope=slope_of(base.rotation))  # as the job takes it

        def lying() -> list[LogObservation]:
            return [log.observation(base) for log in log_map.near(base.position_m[:2], RANGE_M) if log.has_place]

        if job is not None and report is not None:
            self._follow(job, report, lying)
        if now_ns < self._due_ns:
            return None
        self._due_ns = now_ns + PERIOD_NS
        hanging = self._hanging(report)
        gone = {log.id for log in (*hanging, *self._released)}
        near = [log for log in lying() if log.id not in gone]
        return (*near, *hanging, *self._released, *(log for log in self._in_bunk if log.id not in gone))

    def _end(self) -> None:
        """End the job: logs placed in the bunk are on board, logs taken from it are not."""
        moved = {log.id for log in self._released}
        self._in_bunk = [log for log in self._in_bunk if log.id not in moved]
        self._in_bunk += [log for log in self._released if lies_in_bunk(self._profile.bunk, log)]
        self._released, self._held, self._load_detector, self._slipped = [], {}, None, False
        self._beside, self._beside_held, self.grip = (), {}, None

    def _follow(self, job: Activity, report: StateReport, lying: Callable[[], Sequence[LogObservation]]) -> None:
        """Track what the grapple closes on, loses and releases."""
        grasp = job.grasp
        if grasp is None:
            return
        if job.phase < Phase.CLOSE:
            self._held, self._load_detector, self._slipped = {}, None, False
        elif Phase.LIFT <= job.phase < Phase.OPEN and not (self._held or self._slipped or self._released):
            pin, yaw = self._pin(report)
            self._low_m = pin[2]
            self._held = {log.id: _relative(log, pin, yaw) for log in grasp.logs}
            meant = {log.id for log in grasp.logs}
            self._beside = tuple(o for o in lying() if o.id not in meant and _aside_m(o, pin) < BESIDE_M)
            self._beside_held = {log.id: _relative(log, pin, yaw) for log in self._beside}
            self._meant = tuple(sorted(meant))
            self._load_detector = LoadDetector(grasp.logs, self._beside, self._wood)
        elif Phase.LIFT <= job.phase < Phase.LOWER and self._load_detector is not None:
            # Only while it hangs: lowered onto others, or laid back where it lay, it weighs less and less.
            self._load_detector.update(report.stamp_ns, report.load_kg)
            if self._pin(report)[0][2] > self._low_m + LIFTED_M:
                self._judge(self._load_detector)
        elif Phase.OPEN <= job.phase <= Phase.DONE and self._held:
            if self._load_detector is not None:
                self._weigh(self._load_detector)
            under = [log for log in self._in_bunk if log.id not in self._held]
            laid: list[LogObservation] = []
            for log in self._hanging(report):
                laid.append(settled_in_bunk(self._profile.bunk, log, under + laid, self._arm.slope))
            self._released, self._held, self._load_detector = laid, {}, None
            if self.grip is not None:
                bunk = self._profile.bunk
                over = [log for log in laid if is_over_bunk(bunk, *log.center_m[:2])]
                self.grip = replace(self.grip, high=tuple(log.id for log in over if reaches_above_stakes(bunk, log)))

    def _judge(self, detector: LoadDetector) -> None:
        """Judge the load by its weight: logs that the weight does not explain still lie where they lay."""
        assert self._job is not None
        if detector.is_empty and not self._job.judged_by_picture:
            self._held, self._load_detector, self._slipped = {}, None, True
        elif explained_logs := {number: log for number, log in self._held.items() if number in detector.gripped}:
            self._held = explained_logs

    def _weigh(self, detector: LoadDetector) -> None:
        """Record what was in the released load by its weight."""
        detector.learn()
        also = tuple(log for log in self._beside if log.id in detector.gripped)
        left = tuple(number for number in self._meant if number not in self._held)
        self.grip = Grip(also, left, detector.read_kg)
        self._held |= {log.id: self._beside_held[log.id] for log in also}

    def _hanging(self, report: StateReport | None) -> list[LogObservation]:
        if not self._held or report is None:
            return []
        pin, yaw = self._pin(report)
        return [_absolute(log, pin, yaw) for log in self._held.values()]

    def _pin(self, report: StateReport) -> tuple[np.ndarray, float]:
        """Return the hanger pin in the base frame and grapple yaw; joints without an encoder use their reference."""
        assert self._job is not None
        sent = self._job.last_setpoint
        q = tuple(
            p if joint(self._profile, j).encoder is not None else s
            for j, p, s in zip(JOINTS, report.position, sent, strict=True)
        )
        pose = self._arm.pose(q)
        x, y = self._arm.xy(pose)
        return np.array([x, y, pose.z_m]), grapple_yaw(self._profile, q)


def _relative(log: LogObservation, pin: np.ndarray, yaw: float) -> LogObservation:
    """Return a log relative to the grapple: closing jaws centre it between them; along its axis it stays put."""
    axis = np.asarray(log.axis)
    off = np.asarray(log.center_m) - pin
    level = axis * (1.0, 1.0, 0.0)
    drawn = level * float(off @ level) / max(float(level @ level), 1e-9)
    center = _turned((float(drawn[0]), float(drawn[1]), float(off[2])), -yaw)
    return replace(log, center_m=center, axis=_turned(log.axis, -yaw), covariance=None)


def _aside_m(log: LogObservation, pin: np.ndarray) -> float:
    """Compute the distance on the ground from below a pin to the nearest point of a log's axis."""
    center, axis = np.asarray(log.center_m)[:2], np.asarray(log.axis)[:2]
    along = float((pin[:2] - center) @ axis) / max(float(axis @ axis), 1e-9)
    along = min(max(along, -0.5 * log.length_m), 0.5 * log.length_m)
    return float(np.linalg.norm(center + along * axis - pin[:2]))


def _absolute(log: LogObservation, pin: np.ndarray, yaw: float) -> LogObservation:
    x, y, z = _turned(log.center_m, yaw)
    return replace(log, center_m=(pin[0] + x, pin[1] + y, pin[2] + z), axis=_turned(log.axis, yaw))


def _turned(v: tuple[float, float, float], yaw: float) -> tuple[float, float, float]:
    c, s = math.cos(yaw), math.sin(yaw)
    return (c * v[0] - s * v[1], s * v[0] + c * v[1], v[2])
