"""The load: what is on board, whether more is wanted, which logs may share a grasp, and the booking of each grasp."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from autonomy.crane_job.activity import Activity
from autonomy.grasp.weight import UNSURE_KG, green_kg
from autonomy.manager.checkpoint import Checkpoint, copied_tally
from autonomy.manager.log_map import MappedLog
from autonomy.manager.log_memory import Grip
from autonomy.manager.tally import LoadedLog, Tally, volume_m3
from autonomy.manager.world_model import WorldModel
from autonomy.missions.local_frame import yaw_from_bearing
from autonomy.missions.model import ForwardingMission, Point
from autonomy.navigation.clothoid_path import Point2
from autonomy.perception.camera.frame import Pose
from autonomy.perception.log_list import LogObservation
from machine.profile import Bunk, Profile

# -- Logs that fell off the machine, told by a camera that only looks ahead.
#
# Such a camera sees neither the bunk nor what falls beside it.  But it has seen the ground before the machine drove
# over it: a log that lies where the loaded bunk has been, and that was not mapped when the machine stood there, was
# not there. On the next lap it is seen, and it came from the load.


STEP_M: Final = 0.5
"""The bunk's place is kept every so often on the way, ..."""
MAX_PLACES: Final = 4000
"""... for the last two kilometres."""
BESIDE_M: Final = 0.9
"""A log that falls over the stakes comes to rest at most this far beside them: its own length stands in the way of
rolling on.  Logs to be loaded lie farther out: the machine's wheels must pass between them."""
BEHIND_M: Final = 1.2
MIN_HITS: Final = 4
"""Pictures that must show a log: this often in its place, it is no shadow."""


@dataclass(frozen=True, slots=True)
class _Place:
    """The middle and direction (2,) of the bunk in the plane, and the first number that no log had then."""

    middle_m: np.ndarray
    along: np.ndarray
    next_number: int


class FallenLogs:
    """Where the loaded bunk has been; call `passes` on the way, and `fallen` with the logs on the map."""

    def __init__(self, bunk: Bunk) -> None:
        self._bunk = bunk
        self._half_m = (0.5 * bunk.length_m + BEHIND_M, 0.5 * bunk.width_m + BESIDE_M)
        self._places: deque[_Place] = deque(maxlen=MAX_PLACES)
        self._known: set[int] = set()
        """Logs that were told as fallen."""

    def passes(self, base: Pose, next_number: int) -> None:
        """Record that the loaded machine is here; ``next_number`` is the first one that no mapped log has."""
        x, y = self._bunk.center_m
        middle = base.to_base(np.array([x, y, 0.0]))[:2]
        if self._places and math.dist(middle, self._places[-1].middle_m) < STEP_M:
            return
        c, s = math.cos(self._bunk.yaw_rad), math.sin(self._bunk.yaw_rad)
        along = (base.rotation @ np.array([c, s, 0.0]))[:2]
        self._places.append(_Place(middle, along / np.linalg.norm(along), next_number))

    def fallen(self, logs: Iterable[MappedLog]) -> list[MappedLog]:
        """Find the logs that have fallen off, each once."""
        fallen_logs = [
            log for log in logs if log.hits >= MIN_HITS and log.number not in self._known and self._fell(log)
        ]
        self._known |= {log.number for log in fallen_logs}
        return fallen_logs

    def forget(self) -> None:
        """Forget where the machine has been: the bunk is empty."""
        self._places.clear()

    def _fell(self, log: MappedLog) -> bool:
        return any(log.number >= passed.next_number and self._is_near(passed, log) for passed in self._places)

    def _is_near(self, place: _Place, log: MappedLog) -> bool:
        off = log.center_m[:2] - place.middle_m
        along = float(off @ place.along)
        return abs(along) < self._half_m[0] and math.sqrt(max(0.0, float(off @ off) - along**2)) < self._half_m[1]


# -- The load


LOOKS: Final = 4
"""Log lists in a row, a second of them, that must show the same number of logs in the bunk before it is believed."""


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
        self._from_before: int | None = None
        """Logs in the bunk that were there before this mission; None before the first look."""
        self._looked_ns = self._booked_ns = 0
        self._difference = self._differing = 0
        self._fallen = FallenLogs(profile.bunk)
        self._agreed_m = 0.0
        """Driven distance at the last look that agreed with what was booked."""
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
        full = self.tally.bunk_full or (self._lands and self.tally.full(self._bunk))
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
        """Return the landing of the load: its centre in the plane and the direction of its logs [rad] (None: any)."""
        location, places = self._world.location, self._world.landings
        assert location is not None
        landing_index = self.sorting.choose_landing(places, (location.x_m, location.y_m))
        return places[landing_index], self._log_direction_rad[landing_index] if self._log_direction_rad else None

    def logs_to_leave(self, logs: Sequence[LogObservation], target: int | None) -> tuple[int, ...]:
        """Return the list numbers of the logs that a grasp of the target must leave."""
        log_map, world = self._world.log_map, self._world
        target_log = None if target is None else log_map.get(target)
        log_ids = []
        for log in logs:
            number = world.map_number(log.id)
            mapped = None if number is None else log_map.get(number)
            kind, with_ = ("" if known is None else known.assortment for known in (mapped, target_log))
            if not self.sorting.may_share_grasp(kind, with_) or (mapped is not None and world.is_on_landing(mapped)):
                log_ids.append(log.id)
        return tuple(log_ids)

    def book_loaded(self, job: Activity, now_ns: int) -> None:
        """Book a grasp that was placed in the bunk."""
        assert job.grasp is not None
        grip = self._world.grip
        logs = job.grasp.logs
        if grip is not None:
            logs = (*(log for log in logs if log.id not in grip.left), *grip.also)
            self._remark_grip(job.grasp.logs, grip, now_ns, job.judged_by_picture)
        loaded_logs = [self._loaded_log(log, now_ns) for log in logs]
        self.tally.book_loaded(loaded_logs)
        if job.failure is not None:
            self.tally.remark(
                now_ns,
                f"log {' and '.join(str(log.id) for log in logs)} was released into the bunk and counts as loaded, but "
                f"the crane did not rise from it: {job.failure}",
            )
        self._booked_ns = now_ns
        self.sorting.book_loaded(log.assortment for log in loaded_logs)

    def _remark_grip(self, logs: Sequence[LogObservation], grip: Grip, now_ns: int, is_seen: bool) -> None:
        """Say where the weight in the grapple differs from what was meant, or cannot tell where nothing else does, and
        what lies high.
        """
        names = " and ".join(str(log.id) for log in logs)
        for log in grip.also:
            self.tally.remark(
                now_ns, f"log {log.id} came up with log {names}: {grip.read_kg:.0f} kg hung in the grapple"
            )
        for number in grip.left:
            self.tally.remark(
                now_ns,
                f"log {number} did not come up with log {names}: only {grip.read_kg:.0f} kg hung in the grapple; it is "
                "looked for again where it lay",
            )
        for number in grip.high:
            self.tally.remark(
                now_ns,
                f"log {number} was laid down as high as the stakes, where no camera looks: it may lie above them; look "
                "at the load before the machine drives on",
            )
        weight_kg = sum(green_kg(log) for log in logs)
        if not grip.left and weight_kg < UNSURE_KG and not is_seen:
            self.tally.remark(
                now_ns,
                f"log {names} weighs some {weight_kg:.0f} kg, less than the scale can tell from none; it is "
                "counted unseen",
            )

    def check_bunk(self, now_ns: int, driven_m: float) -> None:
        """Compare a look into the bunk with what was booked; call it while no log hangs in the grapple.

        A difference that `LOOKS` lists in a row show is booked and said.  ``driven_m`` is the driven distance.
        """
        world, tally = self._world, self.tally
        if world.counted_ns == self._looked_ns or world.counted_ns <= self._booked_ns:
            return
        self._looked_ns = world.counted_ns
        if self._from_before is None:
            self._from_before = max(0, world.in_bunk - tally.on_board)
        difference = world.in_bunk - self._from_before - tally.on_board
        self._differing = self._differing + 1 if difference and difference == self._difference else 1
        self._difference = difference
        if not difference:
            self._agreed_m = driven_m
        elif self._differing >= LOOKS:
            self._book_difference(difference, driven_m, now_ns)
            self._differing = 0

    def check_fallen(self, now_ns: int) -> int:
        """Book, with a camera that only looks ahead, the logs that it finds where they can only have fallen off the
        machine, and say so; return how many.
        """
        world, tally = self._world, self.tally
        if not tally.on_board:
            self._fallen.forget()
            return 0
        self._fallen.passes(world.base, world.log_map.next_number)
        fallen_logs = [log for log in self._fallen.fallen(world.log_map.logs) if not world.is_on_landing(log)]
        lost = fallen_logs[: tally.on_board]
        for log in lost:
            self._book_lost(1)
            tally.remark(
                now_ns,
                f"log {log.number} lies where the loaded machine has been: it fell off; {tally.on_board} are on board, "
                "and it is loaded again like any log on the ground",
            )
        return len(lost)

    def _book_difference(self, difference: int, driven_m: float, now_ns: int) -> None:
        tally, one = self.tally, abs(difference) == 1
        if difference > 0:
            tally.book_found(difference)
            more = "one log more lies" if one else f"{difference} logs more lie"
            tally.remark(now_ns, f"{more} in the bunk than was gripped on purpose; {tally.on_board} are on board")
            return
        on_board = min(-difference, tally.on_board)
        self._book_lost(on_board)
        assert self._from_before is not None
        self._from_before += difference + on_board
        tally.remark(
            now_ns,
            f"{'a log was' if one else f'{-difference} logs were'} lost between {self._agreed_m:.0f} m and "
            f"{driven_m:.0f} m of the drive; {tally.on_board} are on board; what was lost is looked for again",
        )

    def _book_lost(self, count: int) -> None:
        """Book lost logs; the landing of a load of which nothing is left is undecided again."""
        self.tally.book_lost(count)
        if not self.tally.on_board:
            self.sorting.book_unloaded()

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
        if mapped is None:
            return LoadedLog(Point(lat, lon), now_ns, wood)
        return LoadedLog(Point(lat, lon), now_ns, wood, mapped.assortment, mapped.species, mapped.product_key)

    def book_miss(self, job: Activity, target: int | None, for_good: bool) -> None:
        """Book a failed grasp; the log is given up after too many failures (``for_good``: at once)."""
        assert job.failure is not None
        tally = self.tally
        tally.missed += 1
        number = self._world.map_number(job.grasp.log.id) if job.grasp is not None else target
        if job.bunk_full:
            tally.bunk_full = True
            if number is not None and not self._lands:
                tally.given_up[number] = job.failure
        elif number is not None and self._world.record_miss(number, for_good):
            tally.given_up[number] = job.failure

    def book_unseen(self, job: Activity, now_ns: int) -> None:
        """Book a grasp of logs that neither the scale nor a picture has shown: they stay on the map, unconfirmed."""
        assert job.grasp is not None
        self.tally.missed += 1
        for log in job.grasp.logs:
            self.tally.remark(
                now_ns,
                f"no picture showed log {log.id} in the jaws, and it is too light to weigh: it is not counted, and is "
                "looked for again where it lay; it may lie in the bunk",
            )
            number = self._world.map_number(log.id)
            if number is not None and self._world.record_miss(number):
                self.tally.given_up[number] = f"no picture showed log {log.id} in the jaws, again and again"

    def book_unloaded(self, job: Activity) -> bool:
        """Book a finished grasp from the bunk; return whether it failed."""
        failed = job.failure is not None
        self.tally.missed += failed
        if (job.done or job.has_released) and job.grasp is not None:
            self.tally.book_unloaded(len(job.grasp.logs))
        return failed

    def book_empty(self, now_ns: int, driven_m: float) -> None:
        """Book an empty bunk."""
        self._from_before, self._booked_ns = 0, now_ns
        self.tally.book_empty(now_ns, driven_m, self.sorting.landing or 0)
        self.sorting.book_unloaded()
