"""What the planning process can be told to do: lay one log into the bunk, or do a whole forwarding mission.

A `Job` is pure.  ``step`` takes what has come since the last turn and gives the datagrams to send; ``idle`` says that
nothing more will be sent.  ``news`` is what the operator is told when it is not as it was: event and its particulars;
``outcome`` is what there is to say at the end.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, Final, Protocol

import msgspec

from autonomy.crane_job.activity import Activity
from autonomy.grasp.grasp import Grasp
from autonomy.manager.activity_manager import ActivityManager
from autonomy.manager.checkpoint import Checkpoint
from autonomy.manager.transition_table import FINAL_STATES, State
from autonomy.missions.model import ForwardingMission
from autonomy.perception.log_list.observation import LogObservation
from autonomy.process.mission_publisher import MissionPublisher
from can_dbc.messages.crane import StateReport
from can_dbc.messages.mission import MissionOrder, MissionReport, Order
from can_dbc.messages.vehicle import VehicleReport

JobEvent = tuple[str, Mapping[str, Any]]
STOPPING_TIMEOUT_NS: Final = 5_000_000_000
"""After its end a mission goes on telling the machine to stand for so long, or until it does."""

ABORTED: Final = "aborted by the operator"


class Job(Protocol):
    """See the module's contract."""

    @property
    def idle(self) -> bool:
        """Whether nothing more will be sent."""

    @property
    def done(self) -> bool:
        """Whether it came to its good end."""

    @property
    def failure(self) -> str | None:
        """Why it did not, once that is so."""

    def step(
        self, now_ns: int, report: StateReport | None, vehicle: VehicleReport | None, logs: tuple[LogObservation, ...]
    ) -> list[bytes]:
        """One turn; to be called at 20 Hz or faster."""

    def abort(self, reason: str) -> None:
        """End it; the machine comes to a smooth stop."""

    def events(self) -> Iterator[JobEvent]:
        """What is to be told, now."""

    def outcome(self) -> dict[str, Any]:
        """What it came to."""

    def execute(self, order: MissionOrder) -> str:
        """Do what a person orders; why not, or empty."""

    def report(self, now_ns: int) -> MissionReport | None:
        """What those who watch it are told, if there is more to tell than the controller does."""

    def progress(self) -> Checkpoint | None:
        """What a planner that is started again must know to go on, if it can."""


class SingleLogJob:
    """A crane's activity as a job."""

    def __init__(self, activity: Activity) -> None:
        self._activity = activity

    @property
    def idle(self) -> bool:
        """As of the activity."""
        return self._activity.idle

    @property
    def done(self) -> bool:
        """As of the activity."""
        return self._activity.done

    @property
    def failure(self) -> str | None:
        """As of the activity."""
        return self._activity.failure

    def step(
        self, now_ns: int, report: StateReport | None, vehicle: VehicleReport | None, logs: tuple[LogObservation, ...]
    ) -> list[bytes]:
        """One turn of the activity; the carrier stands."""
        data = self._activity.step(now_ns, report, logs)
        return [] if data is None else [data]

    def abort(self, reason: str) -> None:
        """The crane stops smoothly."""
        self._activity.abort(reason)

    def events(self) -> Iterator[JobEvent]:
        """The grasp, the phase and what it waits for."""
        yield from _of_crane(self._activity.grasp, self._activity.phase.name)
        yield _waiting(self._activity.paused)

    def outcome(self) -> dict[str, Any]:
        """Nothing but the end itself."""
        return {}

    def execute(self, order: MissionOrder) -> str:
        """It can be ended, and no more."""
        if order.order is not Order.ABORT:
            return "one log is laid into the bunk; there is no mission to order about"
        self.abort(ABORTED)
        return ""

    def report(self, now_ns: int) -> MissionReport | None:
        """Nothing."""
        return None

    def progress(self) -> Checkpoint | None:
        """Nothing: it begins anew with what is seen."""
        return None


class ForwardingJob:
    """An activity manager as a job, with its switch at Auto from the beginning; a mission that goes on where another
    planner ended waits at Idle, for nobody knows what was done to the machine meanwhile.
    """

    def __init__(self, manager: ActivityManager, mission: ForwardingMission) -> None:
        self._manager = manager
        self._ended_ns = self._now_ns = 0
        self._voice = MissionPublisher(manager, mission)
        self._auto = not manager.resumed
        self._order, self._refusal = 0, ""
        if self._auto:
            manager.auto()

    @property
    def idle(self) -> bool:
        """Whether the mission has ended and crane and machine stand."""
        manager = self._manager
        if manager.state not in FINAL_STATES:
            return False
        rests = manager.world.is_standing() and (manager.activity is None or manager.activity.idle)
        return rests or self._now_ns - self._ended_ns > STOPPING_TIMEOUT_NS

    @property
    def done(self) -> bool:
        """Whether the route was driven to its end."""
        return self._manager.state is State.DONE

    @property
    def failure(self) -> str | None:
        """Why the mission ended early."""
        return self._manager.failure or None

    def step(
        self, now_ns: int, report: StateReport | None, vehicle: VehicleReport | None, logs: tuple[LogObservation, ...]
    ) -> list[bytes]:
        """One turn of the manager."""
        self._now_ns = now_ns
        sent = self._manager.step(now_ns, report, vehicle, logs)
        if self._manager.state not in FINAL_STATES:
            self._ended_ns = now_ns
        return sent

    def abort(self, reason: str) -> None:
        """Crane and machine stop smoothly; a mission that was never begun ends too."""
        self._manager.abort(reason)

    def events(self) -> Iterator[JobEvent]:
        """The state, the load, the crane's grasp and phase, and what it waits for."""
        manager, activity = self._manager, self._manager.activity
        yield "state", {"state": manager.state.name, "words": manager.description}
        yield "load", {"logs": manager.tally.loaded}
        if activity is not None:
            yield from _of_crane(activity.grasp, activity.phase.name)
        yield _waiting(manager.paused or None)

    def outcome(self) -> dict[str, Any]:
        """The tally."""
        tally = self._manager.tally
        given_up = [{"log": number, "reason": reason} for number, reason in tally.given_up.items()]
        return {
            "loaded": tally.loaded, "driven_m": round(self._manager.route.driven_m, 1), "given_up": given_up,
            "loads": msgspec.to_builtins(tally.loads),
        }  # fmt: skip

    def execute(self, order: MissionOrder) -> str:
        """Pause and go on, step by step or through, or end; an ended mission obeys nothing."""
        self._order, self._refusal = order.sequence, self._executed(order.order)
        return self._refusal

    def _executed(self, order: Order) -> str:
        manager = self._manager
        if manager.state in FINAL_STATES:
            return "the mission has ended"
        match order:
            case Order.AUTO:
                self._auto = True
                manager.auto()
            case Order.PAUSE:
                self._auto = False
                manager.idle()
            case Order.SINGLE_STEP:
                manager.single_step = True
            case Order.RUN_THROUGH:
                manager.single_step = False
            case Order.NEXT_STEP:
                if manager.pending_event is None:
                    return "nothing waits for the next step"
                manager.next_step()
            case Order.ABORT:
                manager.abort(ABORTED)
        return ""

    def report(self, now_ns: int) -> MissionReport:
        """How the mission stands."""
        return self._voice.report(now_ns, self._auto, self._order, self._refusal)

    def progress(self) -> Checkpoint:
        """How far the mission has come."""
        return self._manager.progress()


def _of_crane(grasp: Grasp | None, phase: str) -> Iterator[JobEvent]:
    if grasp is not None:
        logs = [log.id for log in grasp.logs]
        yield "grasp", {"logs": logs, "probability": grasp.probability, "reason": grasp.reason}
    yield "phase", {"phase": phase}


def _waiting(reason: str | None) -> JobEvent:
    return "paused", {"reason": reason}
