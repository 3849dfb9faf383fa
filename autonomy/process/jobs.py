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
from autonomy.grasp.direct import Grasp
from autonomy.manager.manager import Manager
from autonomy.manager.progress import Progress
from autonomy.manager.table import ENDS, State
from autonomy.missions.model import ForwardingMission
from autonomy.perception.logs import LogObservation
from autonomy.process.mission_publisher import Voice
from can_dbc.mission_datagrams import MissionOrder, MissionReport, Order
from can_dbc.setpoint import StateReport, VehicleReport

News = tuple[str, Mapping[str, Any]]
COME_TO_REST_NS: Final = 5_000_000_000
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

    def news(self) -> Iterator[News]:
        """What is to be told, now."""

    def outcome(self) -> dict[str, Any]:
        """What it came to."""

    def obey(self, order: MissionOrder) -> str:
        """Do what a person orders; why not, or empty."""

    def report(self, now_ns: int) -> MissionReport | None:
        """What those who watch it are told, if there is more to tell than the controller does."""

    def progress(self) -> Progress | None:
        """What a planner that is started again must know to go on, if it can."""


class OneLog:
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

    def news(self) -> Iterator[News]:
        """The grasp, the phase and what it waits for."""
        yield from _of_crane(self._activity.grasp, self._activity.phase.name)
        yield _waiting(self._activity.paused)

    def outcome(self) -> dict[str, Any]:
        """Nothing but the end itself."""
        return {}

    def obey(self, order: MissionOrder) -> str:
        """It can be ended, and no more."""
        if order.order is not Order.ABORT:
            return "one log is laid into the bunk; there is no mission to order about"
        self.abort(ABORTED)
        return ""

    def report(self, now_ns: int) -> MissionReport | None:
        """Nothing."""
        return None

    def progress(self) -> Progress | None:
        """Nothing: it begins anew with what is seen."""
        return None


class Forwarding:
    """An activity manager as a job, with its switch at Auto from the beginning; a mission that goes on where another
    planner ended waits at Idle, for nobody knows what was done to the machine meanwhile.
    """

    def __init__(self, manager: Manager, mission: ForwardingMission) -> None:
        self._manager = manager
        self._ended_ns = self._now_ns = 0
        self._voice = Voice(manager, mission)
        self._auto = not manager.resumed
        self._order, self._refusal = 0, ""
        if self._auto:
            manager.auto()

    @property
    def idle(self) -> bool:
        """Whether the mission has ended and crane and machine stand."""
        manager = self._manager
        if manager.state not in ENDS:
            return False
        rests = manager.outlook.stands() and (manager.activity is None or manager.activity.idle)
        return rests or self._now_ns - self._ended_ns > COME_TO_REST_NS

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
        if self._manager.state not in ENDS:
            self._ended_ns = now_ns
        return sent

    def abort(self, reason: str) -> None:
        """Crane and machine stop smoothly; a mission that was never begun ends too."""
        self._manager.abort(reason)

    def news(self) -> Iterator[News]:
        """The state, the load, the crane's grasp and phase, and what it waits for."""
        manager, activity = self._manager, self._manager.activity
        yield "state", {"state": manager.state.name, "words": manager.words}
        yield "load", {"logs": manager.tally.loaded}
        if activity is not None:
            yield from _of_crane(activity.grasp, activity.phase.name)
        yield _waiting(manager.paused or None)

    def outcome(self) -> dict[str, Any]:
        """The tally."""
        tally = self._manager.tally
        given_up = [{"log": number, "reason": reason} for number, reason in tally.given_up.items()]
        return {
            "loaded": tally.loaded, "driven_m": round(self._manager.ride.driven_m, 1), "given_up": given_up,
            "loads": msgspec.to_builtins(tally.loads),
        }  # fmt: skip

    def obey(self, order: MissionOrder) -> str:
        """Pause and go on, step by step or through, or end; an ended mission obeys nothing."""
        self._order, self._refusal = order.sequence, self._obeyed(order.order)
        return self._refusal

    def _obeyed(self, order: Order) -> str:
        manager = self._manager
        if manager.state in ENDS:
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
                if manager.waiting is None:
                    return "nothing waits for the next step"
                manager.step_on()
            case Order.ABORT:
                manager.abort(ABORTED)
        return ""

    def report(self, now_ns: int) -> MissionReport:
        """How the mission stands."""
        return self._voice.report(now_ns, self._auto, self._order, self._refusal)

    def progress(self) -> Progress:
        """How far the mission has come."""
        return self._manager.progress()


def _of_crane(grasp: Grasp | None, phase: str) -> Iterator[News]:
    if grasp is not None:
        logs = [log.id for log in grasp.logs]
        yield "grasp", {"logs": logs, "probability": grasp.probability, "reason": grasp.reason}
    yield "phase", {"phase": phase}


def _waiting(reason: str | None) -> News:
    return "paused", {"reason": reason}
