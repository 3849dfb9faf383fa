"""The activity manager: reports and log lists in; crane and drive setpoints out.

``Manager.step`` is pure but for its state and holds no clock.  What follows what is in `autonomy.manager.table`; here
is how each state begins, how its events are known, and what is sent meanwhile.  A controller that stops, faults or
falls silent pauses the mission; when it is armed again the state begins anew.  Every wait has its patience, and
``failure`` says why a mission ended.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Final

from autonomy.activity import Activity
from autonomy.grasp.direct import Chooser, choose, lies_in
from autonomy.localization.plane import Plane
from autonomy.logs import LogObservation
from autonomy.manager.cargo import Cargo
from autonomy.manager.field import FieldLog
from autonomy.manager.hand import Hand
from autonomy.manager.memory import Memory
from autonomy.manager.outlook import Outlook
from autonomy.manager.progress import Progress, copied, digest
from autonomy.manager.rides import Ride
from autonomy.manager.table import ENDS, OURS, PAPER_B, RULES, Event, Height, State, Table, awaited, following
from autonomy.manager.tally import Tally
from autonomy.mission import Mission
from autonomy.missions.model import ForwardingMission
from autonomy.motion.primitives import load
from autonomy.motion.ways import AsShown, Motions, Swiftest
from autonomy.navigation.curves import PathRefused
from autonomy.navigation.navigator import LEASE_NS, Navigator, Phase
from autonomy.rotator import Rotator
from can_dbc.setpoint import StateReport, VehicleReport, encode
from machine.profile import Profile

SECOND: Final = 1_000_000_000
SETTLED_NS: Final = 400_000_000
"""What stands or is at its height has been so for this long."""
HOLD_NS: Final = 3 * SECOND
"""Paper B's hold time: so long the log is watched at standstill."""
COMMIT_M: Final = 2.5
"""A stop that is no further ahead is driven to."""
WEIGH_NS: Final = 200_000_000
"""The next stop is thought over so often."""
STOPS: Final = 3
"""So often the controller may stop the crane before a grasp is given up."""
STRAYED_M: Final = 0.5
"""So far beyond a fence neither a receiver errs nor a good follower strays: the mission ends there."""
PROGRESS_M: Final = 0.2
HISTORY: Final = 64


@dataclass(frozen=True, slots=True)
class Change:
    """A change of state: when, what came about, and what is done now."""

    at_ns: int
    event: Event
    state: State


class Manager:
    """One mission.  ``state``, ``paused``, ``failure``, ``tally`` and ``changes`` are for the operator.

    ``table`` is whose way it is done: `OURS` or `PAPER_B`.  ``chooser`` picks the grasps,
    ``emptier`` those from the bunk at a landing; ``motions`` are the crane's:
    by default ours, or in paper B's way those that ship as shown to the machine.
    ``remembers``: logs are seen on the way alone, and the crane works from memory.  ``progress``: it goes on where a
    planner before it ended; what lay in the bunk then is seen, not remembered.
    """

    def __init__(
        self,
        profile: Profile,
        profile_hash: int,
        mission: ForwardingMission,
        table: Table = OURS,
        chooser: Chooser = choose,
        plane: Plane | None = None,
        key: bytes | None = None,
        lease_ns: int = LEASE_NS,
        motions: Motions | None = None,
        remembers: bool = False,
        emptier: Chooser | None = None,
        progress: Progress | None = None,
    ) -> None:
        assert profile.carrier is not None and not (remembers and progress)
        self.resumed = progress is not None
        self.state, self.paused, self.failure = State.IDLE, "the controller has not reported", ""
        self.changes: deque[Change] = deque(maxlen=HISTORY)
        self.target: int | None = None
        self.activity: Activity | None = None
        self.single_step = False
        """Every change waits for `step_on`."""
        self.outlook = Outlook(profile, mission, plane, progress and progress.known)
        self.cargo = Cargo(profile, mission, self.outlook, progress)
        self._digest = digest(mission)
        self.memory = Memory(profile) if remembers else None
        self._auto = self._may_step = False
        self.waiting: Event | None = None
        """In single step: what has come about and waits for `step_on`."""
        self._profile, self._table, self._key = profile, table, key
        motions = motions or (AsShown(load(profile)) if table is PAPER_B else Swiftest())
        self._hand = Hand(
            profile, profile_hash, self.cargo, chooser, emptier or chooser, motions, lease_ns, key,
            progress.rotator if progress else Rotator(),
        )  # fmt: skip
        options, carrier = mission.options, profile.carrier
        transport, loading = options.transport_height_m, options.loading_height_m
        self._heights = {
            Height.TRANSPORT: carrier.arm_transport_m if transport is None else transport,
            Height.LOADING: 0.0 if loading is None else loading,
        }
        self._height = Height.TRANSPORT
        self._navigator = Navigator(carrier, profile_hash, lease_ns=lease_ns)
        left, driven_m = (progress.left, progress.driven_m) if progress else (None, 0.0)
        self.ride = Ride(carrier, self._navigator, mission, table is PAPER_B, left, driven_m)
        self._begun = self._was_inside = self._unloaded = False
        self._stop_m = self._progress_m = 0.0
        self._stops = self._failures = 0
        self._since_ns = self._settled_ns = self._progress_ns = self._weighed_ns = 0

    @property
    def tally(self) -> Tally:
        """What is on board, and what was done."""
        return self.cargo.tally

    @property
    def words(self) -> str:
        """What the machine is about, where there are several landings or rounds with which one it is."""
        words, rounds = RULES[self.state].words, self.outlook.sorting.rounds
        if self.state in (State.HAUL, State.SETTLE, State.UNLOAD) and (name := self.cargo.bound_for):
            return f"{words} ({name})"
        if self.state is State.IDLE and self.resumed:
            return f"{words}, to go on where it was left"
        return f"{words} (round {rounds + 1})" if self.state is State.SEARCH and rounds else words

    def progress(self) -> Progress:
        """How far the mission has come."""
        outlook, sorting = self.outlook, self.outlook.sorting
        return Progress(
            mission=self._digest,
            tally=copied(self.tally),
            known=outlook.known(),
            left=self.ride.left(outlook.plane if outlook.located else None),
            landing=sorting.landing,
            served=tuple(sorted(sorting.served)),
            rounds=sorting.rounds,
            driven_m=self.ride.driven_m,
            rotator=self._hand.rotator if self.activity is None else self.activity.rotator,
            finished=self.state is State.DONE,
        )

    # ------------------------------------------------------------------ the operator
    def auto(self) -> None:
        """The switch to Auto."""
        self._auto = True

    def idle(self) -> None:
        """The switch back: everything stops smoothly, and the mission goes on with the next Auto."""
        self._auto = False

    def step_on(self) -> None:
        """In single step: the next change may happen."""
        self._may_step = True

    def abort(self, reason: str) -> None:
        """The mission ends here; crane and machine stop smoothly."""
        if self.state not in ENDS:
            self._fail(reason)

    # ------------------------------------------------------------------ one turn
    def step(
        self,
        now_ns: int,
        report: StateReport | None = None,
        vehicle: VehicleReport | None = None,
        logs: Sequence[LogObservation] = (),
        seen_ns: int | None = None,
    ) -> list[bytes]:
        """The datagrams to send now.  Reports and log list are the newest since the last turn; the list was seen at
        ``seen_ns`` (None: now).  To be called at 20 Hz or faster.
        """
        outlook = self.outlook
        outlook.take(now_ns, report, vehicle)
        if vehicle is not None and outlook.location is not None and outlook.location.usable:
            self.ride.moved(outlook.location)
        seen_ns = now_ns if seen_ns is None else seen_ns
        if self.memory is not None:
            outlook.learn(logs, seen_ns)
            logs = outlook.remember(self.memory, self.activity, now_ns)
        elif RULES[self.state].crane:  # what hangs in the grapple does not lie in the field
            outlook.aboard(logs, seen_ns)
        else:
            outlook.see(logs, seen_ns)
        obstacle = outlook.obstacle(now_ns) or self._off()
        if obstacle:
            if not self.paused:
                self.ride.halt()
                self._navigator.holds = False
                self._stops += self.activity is not None and outlook.stopped
            self.paused = obstacle
        elif self.paused:
            self.paused = ""
            if self.waiting is None:
                self._enter(self.state, now_ns)
            if self.activity is not None and self._stops >= STOPS:
                self.activity.abort(f"the controller stopped the crane {self._stops} times")
        elif self.state not in ENDS:
            self._proceed(now_ns)
        return self._send(now_ns, report, vehicle, logs)

    def _off(self) -> str:
        return "the switch is at Idle" if not self._auto and self.state not in ENDS | {State.IDLE} else ""

    def _proceed(self, now_ns: int) -> None:
        """Change the state when something has come about."""
        if self._navigator.phase is Phase.STOPPED and RULES[self.state].drives:
            self._fail(self._navigator.reason)
            return
        if RULES[self.state].drives and (strayed_m := self.outlook.strayed_m()) > STRAYED_M:
            self._fail(f"the machine has left its fence by {strayed_m:.1f} m; drive it back by hand, and see its route")
            return
        event = self.waiting or next((e for e in awaited(self._table, self.state) if self._has(e, now_ns)), None)
        if event is None and self._late(now_ns):
            event = Event.TIME_OUT
        if event is None:
            return
        if self.single_step and not self._may_step:
            self.waiting = event  # it has come about once, and stands until the operator goes on
            if RULES[self.state].drives:
                self.ride.halt()
            return
        self._may_step, self.waiting = False, None
        if event is Event.INVALID and self.target is not None and not self.cargo.full:
            self.outlook.missed(self.target)  # it looked better from afar: not again and again
        if event is Event.ROUND_END:
            self.outlook.sorting.begins_anew()
            self.ride.renew()
            self._begun = False
        state = following(self._table, self.state, event)
        if state is State.FAILED:
            self._fail(RULES[self.state].trouble)
        else:
            self._enter(state, now_ns)
        self.changes.append(Change(now_ns, event, state))

    def _late(self, now_ns: int) -> bool:
        """Whether a state takes too long: driving counts from the last progress."""
        if self.ride.driven_m > self._progress_m + PROGRESS_M:
            self._progress_m, self._progress_ns = self.ride.driven_m, now_ns
        rule = RULES[self.state]
        begun = max(self._since_ns, self._progress_ns) if rule.drives else self._since_ns
        return now_ns - begun > rule.patience_s * SECOND

    # ------------------------------------------------------------------ how a state begins
    def _enter(self, state: State, now_ns: int) -> None:
        """Begin a state, or begin it anew after a pause."""
        self.state, self._since_ns, self._settled_ns, self._progress_ns = state, now_ns, 0, now_ns
        self._progress_m = self.ride.driven_m
        rule = RULES[state]
        if rule.height is not Height.KEEP:
            self._height = rule.height
            self._navigator.heights_m = (self._heights[self._height],) * 4
        self._navigator.holds = rule.height is not Height.KEEP
        if rule.drives:
            self._drive(state)
        elif state is State.LOOK and self.target is not None and not self.outlook.in_circle(self._log()):
            self.outlook.field.anew(self.target)  # one beside the machine is out of the front camera's sight
        elif state is State.COLLECT and self.activity is None:
            only = self.outlook.listed_as(self.target) if self.ride.faithful else None
            self._begin_grasp(Mission(log_id=only))
        elif state is State.STOW and self.activity is None:
            self._begin_grasp(None)
        elif not rule.crane:
            self.ride.halt()

    def _begin_grasp(self, mission: Mission | None) -> None:
        """A new job for the crane; None: to go over the bunk."""
        self._stops = 0
        onward = None if self.ride.faithful else self._goes_on
        self.activity = self._hand.begin(mission, self.target, onward, self.outlook.report)

    def _goes_on(self, log: LogObservation) -> bool:
        """Whether the next grasp would be of such a log."""
        if self.state is State.UNLOAD:
            return lies_in(self._profile.bunk, log)
        number = self.outlook.number_of(log.id)
        return number is not None and not self.cargo.full and number in {g.number for g in self.outlook.takable()}

    def _end_grasp(self) -> None:
        assert self.activity is not None
        self._hand.end(self.activity)
        self.activity = None

    def _drive(self, state: State) -> None:
        here = self.outlook.location
        assert here is not None
        try:
            if state is State.HAUL:
                landing = self.cargo.landing()
                self.ride.haul(here, landing, partial(self.outlook.landing_ahead, landing))
                return
            if not self._begun and not self.ride.ended:
                self.ride.begin(here, self.outlook.plane)
                self._begun = True
            elif self._unloaded:
                self.ride.rejoin(here)
        except PathRefused as error:
            self._fail(f"the route cannot be driven: {error}")
            return
        self._unloaded = False
        if self.ride.ended:  # from the landing there is nothing to come back to
            return
        if state is State.SEARCH:
            self.target, self._was_inside = None, False
        self.ride.go(None if state is State.SEARCH or self.ride.faithful else self._stop_m)

    def _fail(self, reason: str) -> None:
        self.failure, self.state = reason, State.FAILED
        self.ride.halt()
        if self.activity is not None:
            self.activity.abort(reason)

    # ------------------------------------------------------------------ what has come about
    def _has(self, event: Event, now_ns: int) -> bool:
        """Whether an event has come about."""
        match event:
            case Event.RESUMED:
                return self._auto and self.resumed
            case Event.AUTO:
                return self._auto
            case Event.AT_HEIGHT:
                return self._settled(self.outlook.at_height(self._heights[self._height]), now_ns)
            case Event.STANDING:
                return self._settled(self.outlook.stands(), now_ns)
            case Event.ARRIVED:
                return self._settled(self.ride.arrived, now_ns)
            case Event.LOG_NEAR:
                return self._log_near(now_ns)
            case Event.AVERAGED:
                log = self._log()
                return log is not None and log.hits >= 2 and now_ns - self._since_ns > HOLD_NS
            case Event.GONE:
                return self._log() is None
            case Event.INSIDE:
                self._was_inside = self._was_inside or self.outlook.in_circle(self._log())
                return self._was_inside
            case Event.OUTSIDE:
                return self.outlook.past(self._log())
            case Event.VALID | Event.INVALID:
                looked = self.outlook.list_ns > self._since_ns
                return looked and self._takable() == (event is Event.VALID)
            case Event.COLLECTED:
                return self._collected(now_ns)
            case Event.MISSED:
                return self._missed()
            case Event.LOADED:
                return self.cargo.loaded and (self.cargo.full or self.ride.ended)
            case Event.EMPTY:
                return self._emptied(now_ns)
            case Event.STOWED:
                return self._stowed()
            case Event.ROUND_END:
                return self.ride.ended and self.cargo.another_round
            case Event.ROUTE_END:
                return self.ride.ended or self.cargo.enough
        return False

    def _settled(self, so: bool, now_ns: int) -> bool:
        """Whether something has been so for ``SETTLED_NS``."""
        self._settled_ns = (self._settled_ns or now_ns) if so else 0
        return so and now_ns - self._settled_ns >= SETTLED_NS

    def _log(self) -> FieldLog | None:
        return None if self.target is None else self.outlook.field.get(self.target)

    def _log_near(self, now_ns: int) -> bool:
        """Paper B stops for the nearest log; we, where the best place to stop is just ahead; full, for none."""
        if self.cargo.full:
            return False
        if self.ride.faithful:
            log = self.outlook.near()
            self.target = None if log is None else log.number
            return log is not None
        if now_ns - self._weighed_ns < WEIGH_NS:
            return False
        self._weighed_ns = now_ns
        along = self.ride.along_m
        stop = self.outlook.stop_ahead(self.ride.base_at, along, self.ride.length_m)
        if stop is None or stop.along_m > along + COMMIT_M:
            return False
        self._stop_m, self.target = stop.along_m, stop.numbers[0]
        return True

    def _takable(self) -> bool:
        """Whether a log can be taken from here: paper B checks its target, we all that are seen."""
        found = [] if self.cargo.full else self.outlook.takable(self.target if self.ride.faithful else None)
        if found:
            self.target = found[0].number
        return bool(found)

    def _collected(self, now_ns: int) -> bool:
        done = self.activity
        if done is None or not done.idle or not done.done or done.grasp is None:
            return False
        self.cargo.took(done, now_ns)
        self._end_grasp()
        return True

    def _stowed(self) -> bool:
        """Whether the crane is out of the way for driving; one that does not get there ends the mission."""
        done = self.activity
        if done is None or not done.idle:
            return False
        self._end_grasp()
        if done.failure is not None:
            self._fail(f"the crane cannot be brought over the bunk: {done.failure}")
            return False
        return True

    def _missed(self) -> bool:
        """Whether the crane came back empty; a log that was missed too often is given up."""
        done = self.activity
        if done is None or not done.idle or done.failure is None:
            return False
        self.cargo.missed(done, self.target, for_good=self.ride.faithful)
        self._end_grasp()
        return True

    def _emptied(self, now_ns: int) -> bool:
        """Whether nothing is left in the bunk; while there is, the next grasp begins."""
        done = self.activity
        if done is not None and done.idle:
            self._failures = self._failures + 1 if self.cargo.unloaded(done) else 0
            self._since_ns = now_ns
            self._end_grasp()
            if self._failures >= STOPS:
                self._fail(f"unloading: {done.failure}")
                return False
        if self.activity is not None or self.outlook.counted_ns <= self._since_ns:
            return False
        if self.outlook.in_bunk:
            self._begin_grasp(Mission(source=self._profile.bunk, target=self.outlook.pile_at(self.cargo.landing())))
            return False
        self.cargo.emptied(now_ns, self.ride.driven_m)
        self._unloaded = True
        return True

    # ------------------------------------------------------------------ what is sent
    def _send(
        self, now_ns: int, report: StateReport | None, vehicle: VehicleReport | None, logs: Sequence[LogObservation]
    ) -> list[bytes]:
        out = []
        if self.activity is not None:
            self.activity.halted = bool(self._off())
            offered = tuple(log for log in logs if not self.outlook.given_up(log.id))
            if (data := self.activity.step(now_ns, report, offered)) is not None:
                out.append(data)
        if vehicle is not None and self.outlook.location is not None and self.state is not State.IDLE:
            asked = self._navigator.step(now_ns, vehicle, self.outlook.location)
            if asked is not None and not RULES[self.state].crane:
                out.append(encode(asked, self._key))
        return out
