"""The activity manager: reports and log lists in; crane and drive setpoints out, at 20 Hz or faster.

`ActivityManager.step` holds no clock and does no I/O.  Transitions are in `autonomy.manager.transition_table`, the
conditions of events in `autonomy.manager.event_conditions`; this module enters states and sends setpoints.  When the
controller stops, faults or falls silent, the mission pauses; once it is armed again, the state is entered again.  Every
state has a timeout, and ``failure`` is the reason why a mission failed.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Final

from autonomy.crane_job.activity import Activity
from autonomy.crane_job.rotator_estimate import RotatorEstimate
from autonomy.grasp.planner import GraspSelector
from autonomy.grasp.selection import select_direct
from autonomy.localization.local_plane import LocalPlane
from autonomy.manager.checkpoint import Checkpoint, copied_tally, mission_digest
from autonomy.manager.crane_executor import CraneExecutor
from autonomy.manager.event_conditions import EventConditions
from autonomy.manager.load_bookkeeping import LoadBookkeeping
from autonomy.manager.log_memory import LogMemory
from autonomy.manager.operator_switch import OperatorSwitch
from autonomy.manager.route_driver import RouteDriver
from autonomy.manager.tally import Tally
from autonomy.manager.target_log import TargetLog
from autonomy.manager.transition_table import (
    FINAL_STATES,
    OURS,
    PAPER_B,
    RULES,
    Event,
    Height,
    State,
    Table,
    awaited_events,
    next_state,
)
from autonomy.manager.world_model import WorldModel
from autonomy.missions.model import ForwardingMission
from autonomy.motion.motion_planner import MotionPlanner, MovementPrimitivePlanner, TimeOptimalPlanner
from autonomy.motion.movement_primitives import load
from autonomy.navigation.clothoid_path import PathRefused
from autonomy.navigation.navigator import LEASE_NS, Navigator, Phase
from autonomy.perception.log_list import LogObservation
from autonomy.perception.standpoint import Standpoint
from can_dbc.messages.crane import StateReport
from can_dbc.messages.datagrams import encode
from can_dbc.messages.vehicle import VehicleReport
from machine.profile import Profile
from runtime.errors import Problem

MAX_OUTSIDE_M: Final = 0.5
"""Farther outside a fence than any error of receiver or path follower: the mission fails."""
PAUSED: Final = "an operator has paused the mission"
HISTORY_LENGTH: Final = 64
"""Transitions kept for the operator."""


@dataclass(frozen=True, slots=True)
class Transition:
    """A transition: time, event and new state."""

    at_ns: int
    event: Event
    state: State


class ActivityManager:
    """Runs one mission.  ``state``, ``paused``, ``failure``, ``tally`` and ``changes`` are for the operator.

    ``table`` is `OURS` or `PAPER_B`.  ``selector`` picks grasps on the ground, ``unloading_selector`` those from the
    bunk.  ``motions`` plans crane motions; the default is ours, or the shipped demonstrations for paper B.
    ``uses_memory``: the camera only sees logs while driving, and the crane works from memory.  ``progress`` resumes
    from a checkpoint; the logs in the bunk are then detected, not remembered.
    """

    def __init__(
        self,
        profile: Profile,
        profile_hash: int,
        mission: ForwardingMission,
        table: Table = OURS,
        selector: GraspSelector = select_direct,
        plane: LocalPlane | None = None,
        key: bytes | None = None,
        lease_ns: int = LEASE_NS,
        motions: MotionPlanner | None = None,
        uses_memory: bool = False,
        unloading_selector: GraspSelector | None = None,
        progress: Checkpoint | None = None,
    ) -> None:
        assert profile.carrier is not None and not (uses_memory and progress)
        self.resumed = progress is not None
        self.state, self.paused = State.IDLE, "the controller has not reported"
        self._failure: Problem | None = None
        self.changes: deque[Transition] = deque(maxlen=HISTORY_LENGTH)
        self.single_step = False
        """Every transition waits for `next_step`."""
        self.world = WorldModel(profile, mission, plane, progress.known if progress else None)
        self.load = LoadBookkeeping(profile, mission, self.world, progress)
        self._digest = mission_digest(mission)
        self.log_memory = LogMemory(profile) if uses_memory else None
        self.switch = OperatorSwitch()
        self._auto = self._step_released = False
        self._idle_reason = ""
        """Why the mission was set to Idle; empty while it never was."""
        self.pending_event: Event | None = None
        """In single-step mode: the event that waits for `next_step`."""
        self._table, self._key = table, key
        motions = motions or (MovementPrimitivePlanner(load(profile)) if table is PAPER_B else TimeOptimalPlanner())
        self._crane = CraneExecutor(
            profile,
            profile_hash,
            self.world,
            self.load,
            selector,
            unloading_selector or selector,
            motions,
            lease_ns,
            key,
            progress.rotator if progress else RotatorEstimate(),
            table is PAPER_B,
            self.log_memory,
        )
        options, carrier = mission.options, profile.carrier
        transport, loading = options.transport_height_m, options.loading_height_m
        self._heights = {
            Height.TRANSPORT: carrier.arm_transport_m if transport is None else transport,
            Height.LOADING: 0.0 if loading is None else loading,
        }
        self._height_m = self._heights[Height.TRANSPORT]
        self._navigator = Navigator(carrier, profile_hash, lease_ns=lease_ns)
        left, driven_m = (progress.left, progress.driven_m) if progress else (None, 0.0)
        self.route = RouteDriver(carrier, self._navigator, mission, table is PAPER_B, left, driven_m)
        self._target = TargetLog(self.world, self.route, self.load)
        self._events = EventConditions(self.world, self.route, self.load, self._target, self._crane)
        self._route_begun = self._unloaded = False

    @property
    def failure(self) -> str:
        """Why the mission failed; empty while it has not."""
        return self._failure.sentence if self._failure else ""

    @property
    def failure_code(self) -> str | None:
        """The code of ``failure``."""
        return self._failure.code if self._failure else None

    @property
    def activity(self) -> Activity | None:
        """The active crane job, None without one."""
        return self._crane.job

    @property
    def target(self) -> int | None:
        """Map number of the target log, None without one."""
        return self._target.number

    @property
    def tally(self) -> Tally:
        """Counts of logs and loads."""
        return self.load.tally

    @property
    def description(self) -> str:
        """What the machine is doing, with landing or round where there are several."""
        text, rounds = RULES[self.state].description, self.world.sorting.rounds
        if self.state in (State.HAUL, State.SETTLE, State.UNLOAD) and (name := self.load.landing_name):
            return f"{text} ({name})"
        if self.state is State.IDLE and self.resumed:
            return f"{text}, to resume the mission"
        return f"{text} (round {rounds + 1})" if self.state is State.SEARCH and rounds else text

    def progress(self) -> Checkpoint:
        """Make a checkpoint of the mission."""
        world, sorting = self.world, self.world.sorting
        return Checkpoint(
            mission=self._digest,
            tally=copied_tally(self.tally),
            known=world.known(),
            left=self.route.remainder(world.plane if world.located else None),
            landing=sorting.landing,
            served=tuple(sorted(sorting.served)),
            rounds=sorting.rounds,
            driven_m=self.route.driven_m,
            rotator=self._crane.rotator,
            finished=self.state is State.DONE,
        )

    def standpoint(self, now_ns: int) -> Standpoint | None:
        """Tell, with memory, where the camera's next picture is taken; None while it must take none, because the crane
        works in front of it and shows it no load, or the machine is not located.
        """
        works = RULES[self.state].crane and not self.shows_load
        if self.log_memory is None or works or self.state in FINAL_STATES:
            return None
        standpoint = self.world.standpoint(now_ns)
        return replace(standpoint, load=True) if standpoint is not None and self.shows_load else standpoint

    @property
    def shows_load(self) -> bool:
        """With memory: whether the next picture is that of a load, which the crane holds in front of the camera."""
        return self._crane.shows_load

    # ------------------------------------------------------------------ operator commands
    @property
    def is_auto(self) -> bool:
        """Whether the mission is at Auto."""
        return self._auto

    def auto(self) -> None:
        """Set the mission to Auto; without effect while the operator's mode switch holds."""
        self._auto = True

    def idle(self, reason: str = PAUSED) -> None:
        """Set the mission to Idle for a reason: everything stops smoothly; the next Auto resumes the mission."""
        self._auto, self._idle_reason = False, reason

    def next_step(self) -> None:
        """Release the next transition in single-step mode."""
        self._step_released = True

    def abort(self, reason: str) -> None:
        """Fail the mission; crane and machine stop smoothly."""
        if self.state not in FINAL_STATES:
            self._fail(Problem("mission.aborted", reason))

    # ------------------------------------------------------------------ one step
    def step(
        self,
        now_ns: int,
        report: StateReport | None = None,
        vehicle: VehicleReport | None = None,
        logs: Sequence[LogObservation] | None = None,
        seen_ns: int | None = None,
    ) -> list[bytes]:
        """Return the datagrams to send now.

        Reports and log list are the newest since the last step, None when nothing arrived; the list was observed at
        ``seen_ns`` (None: now).
        """
        world = self.world
        world.update(now_ns, report, vehicle)
        self._obey_switch(report)
        if vehicle is not None and world.location is not None and world.location.usable:
            self.route.update_distance(world.location)
        seen_ns = now_ns if seen_ns is None else seen_ns
        if self.log_memory is not None:
            if logs is not None and self.shows_load:
                self._crane.view_load(logs)
            elif logs is not None:
                world.update_map(logs, seen_ns)
                if logs and world.located:
                    self.log_memory.lose(self.load.check_fallen(now_ns))
            logs = world.recall(self.log_memory, self.activity, now_ns)
        elif logs is not None and RULES[self.state].crane:  # a log in the grapple does not lie on the ground
            world.count_bunk(logs, seen_ns)
        elif logs is not None:
            world.observe(logs, seen_ns)
            self.load.check_bunk(now_ns, self.route.driven_m)
        obstacle = world.blocked_reason(now_ns) or self._off()
        if obstacle:
            if not self.paused:
                self.route.halt()
                self._navigator.holds_heights = False
                self._crane.on_interrupted()
            self.paused = obstacle
        elif self.paused:
            self.paused = ""
            if self.pending_event is None:
                self._enter(self.state, now_ns)
            self._crane.on_resumed()
        elif self.state not in FINAL_STATES:
            self._proceed(now_ns)
        return self._send(now_ns, report, vehicle, logs)

    def _obey_switch(self, report: StateReport | None) -> None:
        self.switch.take(report)
        if self.switch.started:
            self.auto()
        elif (hold := self.switch.hold) is not None:
            self.idle(hold.sentence)

    def _off(self) -> str:
        """Tell why the mission is at Idle after it has been set so; empty while it is not, and once it has ended."""
        return "" if self._auto or self.state in FINAL_STATES else self._idle_reason

    def _danger(self) -> Problem | None:
        """Tell why a driving machine must stop; None while it may drive."""
        if (outside_fence_m := self.world.outside_fence_m) > MAX_OUTSIDE_M:
            return Problem(
                "mission.outside-fence",
                f"the machine is {outside_fence_m:.1f} m outside its fence; drive it back by hand and check the route",
            )
        if not self.route.as_paper_b and (log := self.world.log_before_wheel()) is not None:
            return Problem(
                "mission.log-before-wheel",
                f"log {log.number} lies in front of a wheel; remove it or route the machine round it",
            )
        return None

    def _proceed(self, now_ns: int) -> None:
        """Fail, time out, or take the transition of the first event that has occurred."""
        if self._navigator.phase is Phase.STOPPED and RULES[self.state].drives:
            self._fail(Problem("mission.carrier-stopped", self._navigator.reason))
            return
        if RULES[self.state].drives and (danger := self._danger()):
            self._fail(danger)
            return
        event = self.pending_event
        if event is None:
            event = next((e for e in awaited_events(self._table, self.state) if self._has(e, now_ns)), None)
        if self._crane.failure:
            self._fail(self._crane.failure)
            return
        if event is None and self._events.late(RULES[self.state], now_ns):
            event = Event.TIME_OUT
        if event is None:
            return
        if self.single_step and not self._step_released:
            self.pending_event = event  # the event is kept until the operator releases the transition
            if RULES[self.state].drives:
                self.route.halt()
            return
        self._step_released, self.pending_event = False, None
        if event is Event.INVALID:
            self._target.record_unreachable()
        if event is Event.EMPTY:
            self._unloaded = True
        if event is Event.ROUND_END:
            self.world.sorting.start_round()
            self.route.restart()
            self._route_begun = False
        state = next_state(self._table, self.state, event)
        if state is State.FAILED:
            self._fail(Problem("mission.timeout", RULES[self.state].timeout_reason))
        else:
            self._enter(state, now_ns)
        self.changes.append(Transition(now_ns, event, state))

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
        self._navigator.holds_heights = rule.height is not Height.KEEP
        if rule.drives:
            self._drive(state)
        elif state is State.LOOK and self._target.is_ahead:
            self._target.restart_average()
        elif state is State.COLLECT and self.activity is None:
            self._crane.load_target(self.target, only=self._target.clearing is not None)
        elif state is State.STOW and self.activity is None:
            self._crane.stow()
        elif not rule.crane:
            self.route.halt()

    def _drive(self, state: State) -> None:
        location = self.world.location
        assert location is not None
        try:
            if state is State.HAUL:
                landing, log_direction_rad = self.load.landing()
                self.route.drive_to_landing(
                    location, landing, log_direction_rad, partial(self.world.landing_stop_m, landing)
                )
                return
            if not self._route_begun and not self.route.ended:
                self.route.begin(location, self.world.plane)
                self._route_begun = True
            elif self._unloaded:
                self.route.rejoin(location)
        except PathRefused as error:
            self._fail(Problem(error.code, f"the route cannot be driven: {error}"))
            return
        self._unloaded = False
        if self.route.ended:  # there is no route left to return to
            return
        if state is State.SEARCH:
            self._target.clear()
        self.route.drive_on(None if state is State.SEARCH or self.route.as_paper_b else self._target.stop_m)

    def _fail(self, failure: Problem) -> None:
        self._failure, self.state = failure, State.FAILED
        self.route.halt()
        self._crane.abort(failure.sentence)

    # ------------------------------------------------------------------ sending
    def _send(
        self,
        now_ns: int,
        report: StateReport | None,
        vehicle: VehicleReport | None,
        logs: Sequence[LogObservation] | None,
    ) -> list[bytes]:
        out = []
        if (data := self._crane.step(now_ns, report, logs, halted=bool(self._off()))) is not None:
            out.append(data)
        if vehicle is not None and self.world.location is not None and self.state is not State.IDLE:
            request = self._navigator.step(now_ns, vehicle, self.world.location)
            if request is not None and not RULES[self.state].crane:
                out.append(encode(request, self._key))
        return out
