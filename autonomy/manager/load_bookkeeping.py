"""The load: what is on board, whether more is wanted, which logs may share a grasp, and the booking of each grasp."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from autonomy.crane_job.activity import Activity
from autonomy.manager.checkpoint import Checkpoint, copied_tally
from autonomy.manager.tally import LoadedLog, Tally, volume_m3
from autonomy.manager.world_model import WorldModel
from autonomy.missions.local_frame import yaw_from_bearing
from autonomy.missions.model import ForwardingMission, Point
from autonomy.navigation.clothoid_path import Point2
from autonomy.perception.log_list.observation import LogObservation
from machine.profile import Profile


class LoadBookkeeping:
    """Load of one mission; logs of a list are identified by the world model's numbers."""

    def __init__(
        self, profile: Profile, mission: ForwardingMission, world: WorldModel, progress: Checkpoint | None = None
    ) -> None:
        self.tally, self.sorting = Tally(), world.sorting
        if progress is not None:
            self.tally = copied_tally(progress.tally)
            self.sorting.restore(progress.landing, progress.served, progress.rounds)
        self._world, self._bunk = world, profile.bunk
        self._wanted, self._lands = mission.options.logs_wanted, bool(mission.landings)
        bearings = [landing.bearing_deg for landing in mission.landings]
        self._log_direction_rad = [None if deg is None else yaw_from_bearing(deg) for deg in bearings]

    @property
    def has_enough(self) -> bool:
        """Whether as many logs were loaded as the mission wants."""
        return self._wanted is not None and self.tally.loaded >= self._wanted

    @property
    def full(self) -> bool:
        """Whether no more logs are wanted: there are enough, the bunk has no room, or, if there is a landing, the bunk
        holds its planned volume.
        """
        full = self.tally.brimful or (self._lands and self.tally.full(self._bunk))
        return full or self.has_enough

    @property
    def loaded(self) -> bool:
        """Whether there is a load for a landing: loaded in this mission, or seen on board."""
        tally = self.tally
        return self._lands and (tally.on_board > 0 or bool(tally.board) or self._world.in_bunk > 0)

    @property
    def needs_another_round(self) -> bool:
        """Whether the route must be driven again for logs of other landings."""
        return not self.has_enough and self.sorting.needs_another_round(
            log.assortment for log in self._world.collectable()
        )

    @property
    def landing_name(self) -> str:
        """Name of the landing of the load; empty with a single landing or while it is undecided."""
        return self.sorting.landing_name(self.sorting.landing)

    def landing(self) -> tuple[Point2, float | None]:
        """The landing of the load: its centre in the plane and the direction of its logs [rad] (None: any)."""
        here, places = self._world.location, self._world.landings
        assert here is not None
        which = self.sorting.choose_landing(places, (here.x_m, here.y_m))
        return places[which], self._log_direction_rad[which] if self._log_direction_rad else None

    def logs_to_leave(self, logs: Sequence[LogObservation], target: int | None) -> tuple[int, ...]:
        """List numbers of the logs that a grasp of the target must leave."""
        log_map, world = self._world.log_map, self._world
        first = None if target is None else log_map.get(target)
        found = []
        for log in logs:
            number = world.map_number(log.id)
            mapped = None if number is None else log_map.get(number)
            kind, with_ = ("" if known is None else known.assortment for known in (mapped, first))
            if not self.sorting.may_share_grasp(kind, with_) or (mapped is not None and world.is_on_landing(mapped)):
                found.append(log.id)
        return tuple(found)

    def book_loaded(self, job: Activity, now_ns: int) -> None:
        """Book a grasp that was placed in the bunk."""
        assert job.grasp is not None
        loaded_logs = [self._loaded_log(log, now_ns) for log in job.grasp.logs]
        self.tally.book_loaded(loaded_logs, job.lifted_kg)
        self.sorting.book_loaded(log.assortment for log in loaded_logs)

    def _loaded_log(self, log: LogObservation, now_ns: int) -> LoadedLog:
        """Remove a grasped log from the map and return it with the place where it had lain."""
        world = self._world
        number = world.map_number(log.id)
        mapped = None if number is None else world.log_map.get(number)
        if number is not None:
            world.log_map.remove(number)
        at = world.base.to_base(np.asarray(log.center_m)) if mapped is None else mapped.center_m
        lat, lon, _ = world.plane.geodetic(float(at[0]), float(at[1]))
        wood = volume_m3(log.length_m, log.diameter_m)
        return LoadedLog(Point(lat, lon), now_ns, wood, "" if mapped is None else mapped.assortment)

    def book_miss(self, job: Activity, target: int | None, for_good: bool) -> None:
        """Book a failed grasp; the log is given up after too many failures (``for_good``: at once)."""
        assert job.failure is not None
        tally = self.tally
        tally.missed += 1
        number = self._world.map_number(job.grasp.log.id) if job.grasp is not None else target
        if job.bunk_full:
            tally.brimful = True
            if number is not None and not self._lands:
                tally.given_up[number] = job.failure
        elif number is not None and self._world.record_miss(number, for_good):
            tally.given_up[number] = job.failure

    def book_unloaded(self, job: Activity) -> bool:
        """Book a finished grasp from the bunk; returns whether it failed."""
        failed = job.failure is not None
        self.tally.missed += failed
        if job.done and job.grasp is not None:
            self.tally.book_unloaded(len(job.grasp.logs))
        return failed

    def book_empty(self, now_ns: int, driven_m: float) -> None:
        """Book an empty bunk."""
        self.tally.book_empty(now_ns, driven_m, self.sorting.landing or 0)
        self.sorting.book_unloaded()
