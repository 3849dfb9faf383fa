"""World model of the activity manager: machine state, logs, landings and fences, and the questions asked about them.

`WorldModel.update` accepts every report; `observe` accepts log lists.  All questions are answered from the newest data.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np
from scipy.spatial.transform import Rotation

from autonomy.crane_job.activity import Activity
from autonomy.grasp.bunk_load import lies_in_bunk
from autonomy.localization.frames import Frames
from autonomy.localization.local_plane import LocalPlane
from autonomy.localization.localizer import Localizer
from autonomy.localization.location import Location
from autonomy.manager.checkpoint import LogKnowledge, MissedLog
from autonomy.manager.loading_stops import BaseAt, CraneReach, LoadingStop, best_stop
from autonomy.manager.log_map import CONFIRMED_HITS, LogMap, MappedLog, listed_log, nearest
from autonomy.manager.log_memory import Grip, LogMemory
from autonomy.manager.sorting import Sorting
from autonomy.missions.area import Area
from autonomy.missions.local_frame import bearing_from_yaw
from autonomy.missions.model import ForwardingMission, KnownLog, Point
from autonomy.motion.arm_kinematics import LEVEL, Arm, slope_of
from autonomy.navigation.clothoid_path import Point2
from autonomy.perception.camera.frame import Pose
from autonomy.perception.log_list import LogObservation
from autonomy.perception.standpoint import MAX_AGE_NS, Standpoint, standpoint
from can_dbc.messages.crane import StateReport
from can_dbc.messages.vehicle import VehicleReport
from machine.profile import Bunk, Profile
from machine.status.modes import Mode

SILENT_NS: Final = 300_000_000
NEAR_M: Final = 4.0
"""The machine stops to observe a log that lies no farther ahead of the front axle (paper B: 4 m before the log)."""
CIRCLE_M: Final = 5.3
"""Radius of the circle round the log that the crane's base enters and leaves: about 5 m (paper B)."""
HORIZON_M: Final = 16.0
"""Logs farther away along the route are not considered yet."""
AHEAD_M: Final = 0.5
BEFORE_WHEEL_M: Final = 12.0
"""The middle of no log that a front wheel may hit lies farther away: the longest are 6 m, and ends count."""
BRAKING_M: Final = 0.5
"""Stopping distance from the usual speed."""
JAWS_M: Final = 0.3
"""Room that the jaws need between a front wheel and the middle of a log ahead of it."""
CLEARING_M: Final = 0.7
"""The machine stops this much earlier for a log that the crane can take out of the way."""
SPINE_POINTS: Final = 15
"""Points along a log that are tested against the wheel tracks."""
MAX_ATTEMPTS: Final = 3
STANDSTILL_M_S: Final = 0.02
MAX_POSES: Final = 40
STANDPOINT_NS: Final = 300_000_000
"""A standpoint's velocities are means over about this time, so that the receiver's noise hardly counts."""
MAX_EXTRAPOLATION_STEPS: Final = 4.0
"""The base pose is extrapolated by at most this many report intervals."""
PILE_LENGTH_M, PILE_WIDTH_M, PILE_HEIGHT_M = 3.0, 2.6, 1.5
"""Size of a pile on a landing: longer than the logs, which lie side by side, and no higher."""


class WorldModel:
    """One machine's view of its surroundings.

    ``log_map`` maps the logs on the ground; ``sorting`` decides which of them are wanted.  ``location`` is the newest
    one, None before the first.  ``known`` restores the log knowledge of a checkpoint.
    """

    def __init__(
        self,
        profile: Profile,
        mission: ForwardingMission,
        plane: LocalPlane | None = None,
        known: LogKnowledge | None = None,
    ) -> None:
        assert profile.carrier is not None
        self.log_map, self.sorting = LogMap(profile.bunk), Sorting(mission)
        self.location: Location | None = None
        self.report: StateReport | None = None
        self.vehicle: VehicleReport | None = None
        self.list_ns = 0
        """When the newest log list was observed."""
        self.in_bunk = self.counted_ns = self.empty_looks = 0
        self.grip: Grip | None = None
        """With a camera that only looks ahead: what the scale says of the grip that was released last."""
        self.outside_fence_m = 0.0
        """Distance of the front axle or the crane's base outside the fences; 0 inside."""
        self._carrier, self._bunk, self._ground_z_m = profile.carrier, profile.bunk, profile.workspace.ground_z_m
        self._localizer = Localizer(profile.carrier, plane)
        self._reach = CraneReach(Arm(profile), profile.carrier)
        self._report_ns = self._vehicle_ns = 0
        self._bases: deque[tuple[int, Pose]] = deque(maxlen=MAX_POSES)
        self._bends_rad: deque[float] = deque(maxlen=MAX_POSES)
        """The articulation with every stored pose."""
        self._numbers: dict[int, int] = {}
        self.landings: list[Point2] = []
        """Landing positions in the plane; empty before the first location."""
        self._places = tuple(landing.position for landing in mission.landings)
        self._listed = mission.logs if mission.options.logs == "listed" else ()
        self._known = known or LogKnowledge()
        self._fences, self._area = mission.fences, Area()

    @property
    def plane(self) -> LocalPlane:
        """The local plane; only valid once the machine is located."""
        assert self._localizer.plane is not None
        return self._localizer.plane

    @property
    def located(self) -> bool:
        """Whether the crane's base is known."""
        return bool(self._bases)

    @property
    def base(self) -> Pose:
        """The crane's base now."""
        return self._bases[-1][1]

    @property
    def slope(self) -> tuple[float, float]:
        """How the machine stands now (`autonomy.motion.arm_kinematics`); level before it is located."""
        return slope_of(self.base.rotation) if self._bases else LEVEL

    def base_at(self, at_ns: int) -> Pose:
        """Return the crane's base at a time: the nearest stored pose, extrapolated after the last one."""
        stamp, last = self._bases[-1]
        if at_ns <= stamp or len(self._bases) < 2:
            return min(self._bases, key=lambda known: abs(known[0] - at_ns))[1]
        before, first = self._bases[-2]
        if stamp <= before:
            return last
        share = min((at_ns - stamp) / (stamp - before), MAX_EXTRAPOLATION_STEPS)
        turn = Rotation.from_matrix(last.rotation @ first.rotation.T).as_rotvec()
        return Pose(
            last.position_m + share * (last.position_m - first.position_m),
            Rotation.from_rotvec(share * turn).as_matrix() @ last.rotation,
        )

    def standpoint(self, now_ns: int) -> Standpoint | None:
        """Tell where the machine was at its newest report; None when it is not located now."""
        if not self._bases:
            return None
        stamp, current_pose = self._bases[-1]
        at = next((k for k, (known, _) in enumerate(self._bases) if stamp - known <= STANDPOINT_NS), -1)
        before_ns, earlier_pose = self._bases[at]
        bends_rad = (self._bends_rad[at], self._bends_rad[-1])
        newest_standpoint = standpoint(stamp, current_pose, earlier_pose, bends_rad, (stamp - before_ns) * 1e-9)
        return newest_standpoint if now_ns - stamp <= MAX_AGE_NS else None

    def update(self, now_ns: int, report: StateReport | None, vehicle: VehicleReport | None) -> None:
        """Accept the newest reports and update the location."""
        if report is not None:
            self.report, self._report_ns = report, now_ns
        if vehicle is not None:
            self.vehicle, self._vehicle_ns = vehicle, now_ns
            self.location = self._localizer.step(vehicle)
            if self.location.usable:
                self._bases.append((self.location.stamp_ns, Frames(self._carrier, self.location).base()))
                self._bends_rad.append(vehicle.articulation_rad)
                if len(self._bases) == 1:
                    self._resolve_mission()
                places = np.array([(self.location.x_m, self.location.y_m), self.base.position_m[:2]])
                self.outside_fence_m = float(self._area.outside_m(places).max())

    def _resolve_mission(self) -> None:
        """Convert landings, fences and listed logs of the mission into the plane, and restore the known logs."""
        plane = self.plane
        self.landings = [plane.local(p.latitude_deg, p.longitude_deg)[:2] for p in self._places]
        rings = [
            (np.array([plane.local(c.latitude_deg, c.longitude_deg)[:2] for c in fence.corners]), fence.keep_out)
            for fence in self._fences
        ]
        self._area = Area(tuple(r for r, out in rings if not out), tuple(r for r, out in rings if out))
        ground_m = float(self.base.position_m[2]) + self._ground_z_m
        for log in self._listed:
            self.log_map.add_known(listed_log(log, plane, ground_m))
        for number in self._known.gone:
            self.log_map.remove(number)
        for missed in self._known.missed:
            mapped = listed_log(missed.log, plane, ground_m)
            self.log_map.restore(replace(mapped, number=missed.number, misses=missed.misses, hits=0))
        self.log_map.reserve_numbers(self._known.free)

    def known(self) -> LogKnowledge:
        """Return the log knowledge to store in a checkpoint."""
        if not self._bases:
            return self._known
        gone = tuple(n for n in range(1, len(self._listed) + 1) if self.log_map.get(n) is None)
        return LogKnowledge(
            gone, tuple(self._as_missed(log) for log in self.log_map.missed_logs), self.log_map.next_number
        )

    def _as_missed(self, log: MappedLog) -> MissedLog:
        x, y, _ = log.center_m.tolist()
        position = Point(*self.plane.geodetic(x, y)[:2])
        bearing = bearing_from_yaw(math.atan2(log.axis[1], log.axis[0]))
        known_log = KnownLog(
            position,
            "",
            bearing,
            log.length_m,
            log.diameter_m,
            log.species,
            log.assortment,
            log.product_key,
            log.sigma_m,
        )
        return MissedLog(log.number, known_log, log.misses)

    def log_before_wheel(self, braking_m: float = BRAKING_M) -> MappedLog | None:
        """Find the first log that a front wheel would hit within a distance [m]; None without one."""
        assert self.location is not None
        location, c = self.location, self._carrier
        cos, sin = math.cos(location.yaw_rad), math.sin(location.yaw_rad)
        turn = np.array([[cos, -sin], [sin, cos]])
        for log in self.log_map.near(np.array([location.x_m, location.y_m]), BEFORE_WHEEL_M):
            if not log.has_place:
                continue
            spine = log.center_m + np.linspace(-0.5, 0.5, SPINE_POINTS)[:, None] * log.length_m * log.axis
            ahead, lateral = ((spine[:, :2] - (location.x_m, location.y_m)) @ turn).T
            near = (ahead > 0.0) & (ahead < c.wheel_radius_m + 0.5 * log.diameter_m + braking_m)
            if np.any(near & (np.abs(np.abs(lateral) - 0.5 * c.track_width_m) < 0.5 * c.wheel_width_m)):
                return log
        return None

    def can_clear(self, log: MappedLog) -> bool:
        """Tell whether the crane can load a log that lies ahead of the front wheels from here."""
        assert self.location is not None
        location, c = self.location, self._carrier
        ahead = np.array([math.cos(location.yaw_rad), math.sin(location.yaw_rad)])
        ahead_m = float((log.center_m[:2] - (location.x_m, location.y_m)) @ ahead)
        if log.misses >= MAX_ATTEMPTS or not self.sorting.wants(log.assortment) or self.is_on_landing(log):
            return False
        clear = ahead_m > c.wheel_radius_m + JAWS_M
        return clear and math.isfinite(self._reach.work_s(log.observation(self.base), is_clear=True))

    def observe(self, logs: Sequence[LogObservation], seen_ns: int) -> None:
        """Accept a log list in the base frame of a time; ignored before the machine is located."""
        if self._bases:
            if logs:  # a picture of nothing is no look into a loaded bunk
                self.count_bunk(logs, seen_ns)
            self._numbers = self.update_map(logs, seen_ns)
            self.list_ns = seen_ns

    def update_map(self, logs: Sequence[LogObservation], seen_ns: int) -> dict[int, int]:
        """Merge a list into the log map only; return the map number of each list number."""
        if not logs or not self._bases:
            return {}
        return self.log_map.observe(logs, self.base_at(seen_ns), seen_ns)

    def recall(self, log_memory: LogMemory, job: Activity | None, now_ns: int) -> tuple[LogObservation, ...] | None:
        """Replace the detector's list by one from memory; None while there is no new one."""
        if not self._bases:
            return None
        logs = log_memory.log_list(now_ns, self.log_map, self.base, self.report, job)
        self.grip = log_memory.grip
        if logs is None:
            return None
        self._numbers = {log.id: log.id for log in logs}
        self.list_ns = now_ns
        self._counted(log_memory.in_bunk, now_ns)
        return logs

    def count_bunk(self, logs: Sequence[LogObservation], seen_ns: int) -> None:
        """Count the logs of a list that lie in the bunk; `empty_looks` lists in a row have shown none."""
        self._counted(sum(lies_in_bunk(self._bunk, log) for log in logs), seen_ns)

    def _counted(self, in_bunk: int, seen_ns: int) -> None:
        self.in_bunk, self.counted_ns = in_bunk, seen_ns
        self.empty_looks = 0 if in_bunk else self.empty_looks + 1

    def landing_stop_m(self, point: Point2, base_at: BaseAt, end_m: float) -> float | None:
        """Find the distance along a path from which the crane reaches a landing best; None if there is none."""
        pile = MappedLog(0, np.array([*point, 0.0]), np.array([1.0, 0.0, 0.0]), 2.0, 0.3, 0.1, CONFIRMED_HITS, 0)
        stop = best_stop([pile], self._reach, base_at, 0.0, end_m)
        return None if stop is None else stop.along_m

    def landing_pile(self, point: Point2, log_direction_rad: float | None = None) -> Bunk:
        """Return the landing as a bunk on the ground for the crane: beside the machine, parallel to it or to
        ``log_direction_rad`` [rad] in the plane.
        """
        x, y, _ = self.base.to_optical(np.array([*point, self.base.position_m[2]])).tolist()
        base_yaw = math.atan2(self.base.rotation[1, 0], self.base.rotation[0, 0])
        yaw = 0.0 if log_direction_rad is None else math.remainder(log_direction_rad - base_yaw, math.pi)
        return Bunk((x, y), yaw, PILE_LENGTH_M, PILE_WIDTH_M, self._ground_z_m, PILE_HEIGHT_M)

    def blocked_reason(self, now_ns: int) -> str:
        """Tell why the machine cannot act on setpoints now; empty when it can."""
        if self.report is None or self.vehicle is None:
            return "the controller has not reported"
        if now_ns - min(self._report_ns, self._vehicle_ns) > SILENT_NS:
            return "the controller is silent"
        if self.report.mode not in (Mode.ARMED, Mode.ACTIVE):
            return f"the controller is in {Mode(self.report.mode).name}"
        if self.location is None or not self.location.usable:
            return f"not located: {self.location.reason if self.location else 'no report'}"
        return ""

    @property
    def stopped(self) -> bool:
        """Whether the controller is in STOP or FAULT."""
        return self.report is not None and self.report.mode in (Mode.STOP, Mode.FAULT)

    def is_at_height(self, height_m: float) -> bool:
        """Tell whether all four swing arms are at a height."""
        assert self.vehicle is not None
        near = 1.5 * self._carrier.arm_in_band_m
        return all(abs(h - height_m) <= near for h in self.vehicle.heights_m)

    def is_standing(self) -> bool:
        """Tell whether the machine is at standstill."""
        return self.vehicle is not None and abs(self.vehicle.speed_m_s) < STANDSTILL_M_S

    # ------------------------------------------------------------------ logs
    def map_number(self, listed: int) -> int | None:
        """Return the map number of a log of the newest list."""
        return self._numbers.get(listed)

    def list_number(self, number: int | None) -> int | None:
        """Return the newest list's number of a mapped log."""
        return next((k for k, n in self._numbers.items() if n == number), None)

    def record_miss(self, number: int, for_good: bool = False) -> bool:
        """Record a failed grasp; return whether the log is given up: it stays mapped but is no longer collected."""
        if self.log_map.get(number) is None:
            return False
        while (misses := self.log_map.record_miss(number)) < MAX_ATTEMPTS and for_good:
            pass
        return misses >= MAX_ATTEMPTS

    def is_given_up(self, listed: int) -> bool:
        """Tell whether a log of the newest list is given up."""
        number = self._numbers.get(listed)
        log = None if number is None else self.log_map.get(number)
        return log is not None and log.misses >= MAX_ATTEMPTS

    def nearest_candidate(self) -> MappedLog | None:
        """Find, for paper B, the log nearest to the crane among those near enough to stop for.

        These are logs a little ahead, and logs whose circle the crane's base is still inside: the machine may have
        passed a second log while it approached the first.
        """
        assert self.location is not None
        location = self.location
        ahead = np.array([math.cos(location.yaw_rad), math.sin(location.yaw_rad)])
        near = [
            g
            for g in self._relevant()
            if self.is_in_circle(g) or 0.0 < float((g.center_m[:2] - (location.x_m, location.y_m)) @ ahead) <= NEAR_M
        ]
        return nearest(near, self.base.position_m[:2])

    def next_stop(self, base_at: BaseAt, along_m: float, end_m: float) -> LoadingStop | None:
        """Find the best next place to stop along the path; None without one."""
        begin = along_m + AHEAD_M
        return best_stop(self._relevant(), self._reach, base_at, begin, min(begin + HORIZON_M, end_m))

    def is_in_circle(self, log: MappedLog | None) -> bool:
        """Tell whether the crane's base is in the circle round a log."""
        return log is not None and math.dist(log.center_m[:2], self.base.position_m[:2]) < CIRCLE_M

    def has_passed(self, log: MappedLog | None) -> bool:
        """Tell whether the crane's base has left the circle on the far side; noise at the near edge does not count."""
        if log is None:
            return True
        behind_m = float(self.base.to_optical(log.center_m)[0])  # the base looks backwards
        return behind_m > 0.0 and not self.is_in_circle(log)

    def graspable(self, only: int | None = None) -> list[MappedLog]:
        """List the logs of the newest list that the crane can grasp from here, best first; or only the log ``only``."""
        seen = set(self._numbers.values()) if only is None else {only}
        logs = [g for g in self._relevant() if g.number in seen and g.has_place]
        work = sorted((self._reach.work_s(g.observation(self.base)), g.number, g) for g in logs)
        return [g for seconds, _, g in work if math.isfinite(seconds)]

    def collectable(self) -> list[MappedLog]:
        """List the logs that can be collected: not given up and not on a landing."""
        return [g for g in self.log_map.logs if self._is_collectable(g)]

    def _is_collectable(self, log: MappedLog) -> bool:
        return log.misses < MAX_ATTEMPTS and not self.is_on_landing(log)

    def is_on_landing(self, log: MappedLog) -> bool:
        """Tell whether a log lies on a landing."""
        return any(math.dist(log.center_m[:2], at) <= PILE_LENGTH_M for at in self.landings)

    def _relevant(self) -> list[MappedLog]:
        """List the collectable logs of the current load that are close enough to affect the next stop."""
        near = self.log_map.near(self.base.position_m[:2], HORIZON_M)
        return [g for g in near if self._is_collectable(g) and self.sorting.wants(g.assortment)]
