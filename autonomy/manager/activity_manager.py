"""The activity manager: reports and log lists in; crane and drive setpoints out, at 20 Hz or faster.

`ActivityManager.step` holds no clock and does no I/O.  Transitions are in `autonomy.manager.transition_table`, the
conditions of events in `autonomy.manager.event_conditions`; this module enters states and sends setpoints.  When the
controller stops, faults or falls silent, the mission pauses; once it is armed again, the state is entered again.  Every
state has a timeout, and ``failure`` is the reason why a mission failed.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Final

from autonomy.crane_job.activity import Activity
from autonomy.crane_job.rotator_estimate import RotatorEstimate
from autonomy.grasp.selection import select_direct
from autonomy.grasp.planner import GraspSelector
from autonomy.localization.local_plane import Plane
from autonomy.manager.load_bookkeeping import Cargo
from autonomy.manager.crane_executor import Hand
from autonomy.manager.event_conditions import Events
from autonomy.manager.log_memory import Memory
from autonomy.manager.checkpoint import Progress, copied, digest
from autonomy.manager.route_driver import Ride
from autonomy.manager.transition_table import (
    ENDS,
    OURS,
    PAPER_B,
    RULES,
    Event,
    Height,
    State,
    Table,
    awaited,
    following,
)
from autonomy.manager.tally import Tally
from autonomy.manager.target_log import Target
from autonomy.manager.world_model import Outlook
from autonomy.missions.model import ForwardingMission
from autonomy.motion.motion_planner import MovementPrimitivePlanner, MotionPlanner, TimeOptimalPlanner
from autonomy.motion.movement_primitives import load
from autonomy.navigation.clothoid_path import PathRefused
from autonomy.navigation.navigator import LEASE_NS, Navigator, Phase
from autonomy.perception.log_list.observation import LogObservation
from can_dbc.messages.crane import StateReport
from can_dbc.messages.datagrams import encode
from can_dbc.messages.vehicle import VehicleReport
from machine.profile import Profile

STRAYED_M: Final = 0.5
"""Farther outside a fence than any error of receiver or path follower: the mission fails."""
HISTORY: Final = 64
"""Transitions kept for the operator."""


@dataclass(frozen=True, slots=True)
class Change:
    """A transition: time, event and new state."""

    at_ns: int
    event: Event
    state: State


class Manager:
    """Runs one mission.  ``state``, ``paused``, ``failure``, ``tally`` and ``changes`` are for the operator.

    ``table`` is `OURS` or `PAPER_B`.  ``chooser`` picks grasps on the ground, ``emptier`` those from the bunk.
    ``motions`` plans crane motions; the default is ours, or the shipped demonstrations for paper B.  ``remembers``: the
    camera only sees logs while driving, and the crane works from memory.  ``progress`` resumes from a checkpoint; the
    logs in the bunk are then detected, not remembered.
    """

    def __init__(
        self,
        profile: Profile,
        profile_hash: int,
        mission: ForwardingMission,
        table: Table = OURS,
        chooser: GraspSelector = select_direct,
        plane: Plane | None = None,
        key: bytes | None = None,
        lease_ns: int = LEASE_NS,
        motions: MotionPlanner | None = None,
        remembers: bool = False,
        emptier: GraspSelector | None = None,
        progress: Progress | None = None,
    ) -> None:
        assert profile.carrier is not None and not (remembers and progress)
        self.resumed = progress is not None
        self.state, self.paused, self.failure = State.IDLE, "the controller has not reported", ""
        self.changes: deque[Change] = deque(maxlen=HISTORY)
        self.single_step = False
        """Every transition waits for `step_on`."""
        self.outlook = Outlook(profile, mission, plane, progress and progress.known)
        self.cargo = Cargo(profile, mission, self.outlook, progress)
        self._digest = digest(mission)
        self.memory = Memory(profile) if remembers else None
        self._auto = self._may_step = False
        self.waiting: Event | None = None
        """In single-step mode: the event that waits for `step_on`."""
        self._table, self._key = table, key
        motions = motions or (MovementPrimitivePlanner(load(profile)) if table is PAPER_B else TimeOptimalPlanner())
        self._hand = Hand(
            profile, profile_hash, self.outlook, self.cargo, chooser, emptier or chooser, motions, lease_ns, key,
            progress.rotator if progress else RotatorEstimate(), table is PAPER_B,
        )  # fmt: skip
        options, carrier = mission.options, profile.carrier
        transport, loading = options.transport_height_m, options.loading_height_m
        self._heights = {
            Height.TRANSPORT: carrier.arm_transport_m if transport is None else transport,
            Height.LOADING: 0.0 if loading is None else loading,
        }
        self._height_m = self._heights[Height.TRANSPORT]
        self._navigator = Navigator(carrier, profile_hash, lease_ns=lease_ns)
        left, driven_m = (progress.left, progress.driven_m) if progress else (None, 0.0)
        self.ride = Ride(carrier, self._navigator, mission, table is PAPER_B, left, driven_m)
        self._target = Target(self.outlook, self.ride, self.cargo)
        self._events = Events(self.outlook, self.ride, self.cargo, self._target, self._hand)
        self._begun = self._unloaded = False

    @property
    def activity(self) -> Activity | None:
        """The active crane job, None without one."""
        return self._hand.job

    @property
    def target(self) -> int | None:
        """Map number of the target log, None without one."""
        return self._target.number

    @property
    def tally(self) -> Tally:
        """Counts of logs and loads."""
        return self.cargo.tally

    @property
    def words(self) -> str:
        """What the machine is doing, with landing or round where there are several."""
        words, rounds = RULES[self.state].words, self.outlook.sorting.rounds
        if self.state in (State.HAUL, State.SETTLE, State.UNLOAD) and (name := self.cargo.bound_for):
            return f"{words} ({name})"
        if self.state is State.IDLE and self.resumed:
            return f"{words}, to resume the mission"
        return f"{words} (round {rounds + 1})" if self.state is State.SEARCH and rounds else words

    def progress(self) -> Progress:
        """A checkpoint of the mission."""
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
            rotator=self._hand.rotator,
            finished=self.state is State.DONE,
        )

    # ------------------------------------------------------------------ operator commands
    def auto(self) -> None:
        """Set the mode switch to Auto."""
        self._auto = True

    def idle(self) -> None:
        """Set the mode switch to Idle: everything stops smoothly; the next Auto resumes the mission."""
        self._auto = False

    def step_on(self) -> None:
        """In single-step mode: release the next transition."""
        self._may_step = True

    def abort(self, reason: str) -> None:
        """Fail the mission; crane and machine stop smoothly."""
        if self.state not in ENDS:
            self._fail(reason)

    # ------------------------------------------------------------------ one step
    def step(
        self,
        now_ns: int,
        report: StateReport | None = None,
        vehicle: VehicleReport | None = None,
        logs: Sequence[LogObservation] = (),
        seen_ns: int | None = None,
    ) -> list[bytes]:
        """The datagrams to send now.

        Reports and log list are the newest since the last step; the list was observed at ``seen_ns`` (None: now).
        """
        outlook = self.outlook
        outlook.take(now_ns, report, vehicle)
        if vehicle is not None and outlook.location is not None and outlook.location.usable:
            self.ride.moved(outlook.location)
        seen_ns = now_ns if seen_ns is None else seen_ns
        if self.memory is not None:
            outlook.learn(logs, seen_ns)
            logs = outlook.remember(self.memory, self.activity, now_ns)
        elif RULES[self.state].crane:  # a log in the grapple does not lie on the ground
            outlook.aboard(logs, seen_ns)
        else:
            outlook.see(logs, seen_ns)
        obstacle = outlook.obstacle(now_ns) or self._off()
        if obstacle:
            if not self.paused:
                self.ride.halt()
                self._navigator.holds = False
                self._hand.interrupted()
            self.paused = obstacle
        elif self.paused:
            self.paused = ""
            if self.waiting is None:
                self._enter(self.state, now_ns)
            self._hand.resumed()
        elif self.state not in ENDS:
            self._proceed(now_ns)
        return self._send(now_ns, report, vehicle, logs)

    def _off(self) -> str:
        return "the mode switch is at Idle" if not self._auto and self.state not in ENDS | {State.IDLE} else ""

    def _danger(self) -> str:
        """Why a driving machine must stop; empty while it may drive."""
        if (strayed_m := self.outlook.strayed_m) > STRAYED_M:
            return f"the machine is {strayed_m:.1f} m outside its fence; drive it back by hand and check the route"
        if not self.ride.faithful and (log := self.outlook.in_the_way()) is not None:
            return f"log {log.number} lies in front of a wheel; remove it or route the machine round it"
        return ""

    def _proceed(self, now_ns: int) -> None:
        """Fail, time out, or take the transition of the first event that has occurred."""
        if self._navigator.phase is Phase.STOPPED and RULES[self.state].drives:
            self._fail(self._navigator.reason)
            return
        if RULES[self.state].drives and (danger := self._danger()):
            self._fail(danger)
            return
        event = self.waiting
        if event is None:
            event = next((e for e in awaited(self._table, self.state) if self._has(e, now_ns)), None)
        if self._hand.trouble:
            self._fail(self._hand.trouble)
            return
        if event is None and self._events.late(RULES[self.state], now_ns):
            event = Event.TIME_OUT
        if event is None:
            return
        if self.single_step and not self._may_step:
            self.waiting = event  # the event is kept until the operator releases the transition
            if RULES[self.state].drives:
                self.ride.halt()
            return
        self._may_step, self.waiting = False, None
        if event is Event.INVALID:
            self._target.not_takable()
        if event is Event.EMPTY:
            self._unloaded = True
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

    def _has(self, event: Event, now_ns: int) -> bool:
        match event:
            case Event.RESUMED:
                return self._auto and self.resumed
            case Event.AUTO:
                return self._auto
        return self._events.has(event, now_ns)

    # ------------------------------------------------------------------ entering a state
    def _enter(self, state: State, now_ns: int) -> None:
        """Enter a state, or enter it again after a pause."""
        self.state, rule = state, RULES[state]
        if rule.height is not Height.KEEP:
            self._height_m = self._heights[rule.height]
            self._navigator.heights_m = (self._height_m,) * 4
        self._events.begin(now_ns, self._height_m)
        self._navigator.holds = rule.height is not Height.KEEP
        if rule.drives:
            self._drive(state)
        elif state is State.LOOK and self._target.lies_ahead:
            self._target.look_again()
        elif state is State.COLLECT and self.activity is None:
            self._hand.fetch(self.target)
        elif state is State.STOW and self.activity is None:
            self._hand.stow()
        elif not rule.crane:
            self.ride.halt()

    def _drive(self, state: State) -> None:
        here = self.outlook.location
        assert here is not None
        try:
            if state is State.HAUL:
                landing, lie_rad = self.cargo.landing()
                self.ride.haul(here, landing, lie_rad, partial(self.outlook.landing_ahead, landing))
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
        if self.ride.ended:  # there is no route left to return to
            return
        if state is State.SEARCH:
            self._target.search()
        self.ride.go(None if state is State.SEARCH or self.ride.faithful else self._target.stop_m)

    def _fail(self, reason: str) -> None:
        self.failure, self.state = reason, State.FAILED
        self.ride.halt()
        self._hand.abort(reason)

    # ------------------------------------------------------------------ sending
    def _send(
        self, now_ns: int, report: StateReport | None, vehicle: VehicleReport | None, logs: Sequence[LogObservation]
    ) -> list[bytes]:
        out = []
        if (data := self._hand.step(now_ns, report, logs, halted=bool(self._off()))) is not None:
            out.append(data)
        if vehicle is not None and self.outlook.location is not None and self.state is not State.IDLE:
            asked = self._navigator.step(now_ns, vehicle, self.outlook.location)
            if asked is not None and not RULES[self.state].crane:
                out.append(encode(asked, self._key))
        return out
