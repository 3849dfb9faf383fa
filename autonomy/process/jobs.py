"""The jobs of the planning process: load a single log, or execute a forwarding mission.

A `Job` does no I/O.  ``step`` accepts the data received since the last step and returns the datagrams to send; ``idle``
means that nothing more will be sent.  ``events`` are the current status events, each with its fields; ``outcome`` has
the fields of the final event.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, Final, Protocol

import msgspec

from autonomy.crane_job.activity import Activity
from autonomy.crane_job.phases import Phase
from autonomy.grasp.planner import Grasp
from autonomy.manager.activity_manager import ActivityManager
from autonomy.manager.checkpoint import Checkpoint
from autonomy.manager.operator_switch import OperatorSwitch
from autonomy.manager.transition_table import FINAL_STATES, State
from autonomy.missions.model import ForwardingMission
from autonomy.perception.driving_log_detector import in_base
from autonomy.perception.log_list import LogObservation
from autonomy.perception.standpoint import Standpoint
from autonomy.process.mission_publisher import MissionPublisher, chosen_grasp
from can_dbc.messages.crane import StateReport
from can_dbc.messages.mission import ChosenGrasp, MissionAction, MissionCommand, MissionReport
from can_dbc.messages.vehicle import VehicleReport
from runtime.errors import Problem

JobEvent = tuple[str, Mapping[str, Any]]
MAX_TOLD: Final = 3
"""Remarks on the load in one event: the newest."""
STOPPING_TIMEOUT_NS: Final = 5_000_000_000
"""After its end a mission keeps sending stop setpoints until the machine stands, at most for this long."""

ABORTED: Final = "aborted by the operator"
"""Reason of a commanded abort."""
MISSION_ENDED: Final = "the mission has ended"
NO_PENDING_STEP: Final = "no transition waits for the next step"
ONLY_ABORT: Final = "a single-log job only accepts Abort"
"""Reasons for which a command is refused."""


class Job(Protocol):
    """A job; see the module's contract."""

    @property
    def idle(self) -> bool:
        """Whether nothing more will be sent."""

    @property
    def done(self) -> bool:
        """Whether the job has succeeded."""

    @property
    def failure(self) -> str | None:
        """Why the job has failed, None otherwise."""

    @property
    def begun(self) -> bool:
        """Whether the job must not be replaced by another."""

    def step(
        self,
        now_ns: int,
        report: StateReport | None,
        vehicle: VehicleReport | None,
        logs: tuple[LogObservation, ...] | None,
    ) -> list[bytes]:
        """Take one step; call it at 20 Hz or faster.  What has not arrived since the last one is None."""

    @property
    def drives(self) -> bool:
        """Whether the detector's camera looks ahead of a machine that drives: its lists are in the plane."""

    def standpoint(self, now_ns: int) -> Standpoint | None:
        """Tell where the next picture of such a job is taken, None while none is wanted."""

    def abort(self, reason: str) -> None:
        """Fail the job; the machine stops smoothly."""

    def events(self) -> Iterator[JobEvent]:
        """Yield the current status events."""

    def outcome(self) -> dict[str, Any]:
        """Return the fields of the final event."""

    def execute(self, command: MissionCommand) -> str:
        """Execute an operator command; return why it is refused, empty otherwise."""

    def report(self, now_ns: int) -> MissionReport | None:
        """Return the mission report, None without a mission."""

    def chosen_grasp(self) -> ChosenGrasp | None:
        """Return the grasp that the crane is about to make, None at other times."""

    def progress(self) -> Checkpoint | None:
        """Return the checkpoint from which the job can be resumed, None if it cannot."""


class SingleLogJob:
    """One crane job: a single log."""

    begun = True

    def __init__(self, activity: Activity) -> None:
        self._activity = activity
        self._switch, self._held = OperatorSwitch(), ""

    @property
    def idle(self) -> bool:
        """State of the activity."""
        return self._activity.idle

    @property
    def done(self) -> bool:
        """State of the activity."""
        return self._activity.done

    @property
    def failure(self) -> str | None:
        """State of the activity."""
        return self._activity.failure

    def step(
        self,
        now_ns: int,
        report: StateReport | None,
        vehicle: VehicleReport | None,
        logs: tuple[LogObservation, ...] | None,
    ) -> list[bytes]:
        """Take one step of the activity, which the operator's mode switch may hold; the carrier stands."""
        self._switch.take(report)
        if self._switch.started:
            self._held = ""
        elif (hold := self._switch.hold) is not None:
            self._held = hold.sentence
        self._activity.halted = bool(self._held)
        if self._held and self._activity.phase is Phase.WAIT:
            return []
        data = self._activity.step(now_ns, report, logs)
        return [] if data is None else [data]

    @property
    def drives(self) -> bool:
        """The machine stands."""
        return False

    def standpoint(self, now_ns: int) -> Standpoint | None:
        """Return None: the crane's joints say where its camera is."""
        return None

    def abort(self, reason: str) -> None:
        """Fail the activity; the crane stops smoothly."""
        self._activity.abort(reason)

    def events(self) -> Iterator[JobEvent]:
        """Yield grasp, phase and pause reason."""
        yield from _crane_events(self._activity.grasp, self._activity.phase.name)
        yield _pause_event(self._held or self._activity.paused)

    def outcome(self) -> dict[str, Any]:
        """Return no fields."""
        return {}

    def execute(self, command: MissionCommand) -> str:
        """Accept only Abort."""
        if command.action is not MissionAction.ABORT:
            return ONLY_ABORT
        self.abort(ABORTED)
        return ""

    def report(self, now_ns: int) -> MissionReport | None:
        """Return None: there is no mission."""
        return None

    def chosen_grasp(self) -> ChosenGrasp | None:
        """Return the grasp of the activity."""
        return chosen_grasp(self._activity)

    def progress(self) -> Checkpoint | None:
        """Return None: the job starts over with a new detection."""
        return None


class ForwardingJob:
    """A mission as a job.  It begins at Auto, but at Idle if it is a resumed mission, because the machine may have been
    changed in the meantime, and without ``begin``.  ``begun`` says whether it was ever at Auto.
    """

    def __init__(self, manager: ActivityManager, mission: ForwardingMission, begin: bool = True) -> None:
        self._manager = manager
        self._ended_ns = self._now_ns = 0
        self._publisher = MissionPublisher(manager, mission)
        self.begun = begin and not manager.resumed
        self._command, self._refusal, self._refusal_code = 0, "", ""
        if self.begun:
            manager.auto()

    @property
    def idle(self) -> bool:
        """Whether the mission has ended and crane and machine are at standstill."""
        manager = self._manager
        if manager.state not in FINAL_STATES:
            return False
        at_rest = manager.world.is_standing() and (manager.activity is None or manager.activity.idle)
        return at_rest or self._now_ns - self._ended_ns > STOPPING_TIMEOUT_NS

    @property
    def done(self) -> bool:
        """Whether the mission is finished."""
        return self._manager.state is State.DONE

    @property
    def failure(self) -> str | None:
        """Why the mission has failed, None otherwise."""
        return self._manager.failure or None

    def step(
        self,
        now_ns: int,
        report: StateReport | None,
        vehicle: VehicleReport | None,
        logs: tuple[LogObservation, ...] | None,
    ) -> list[bytes]:
        """Take one step of the manager; with memory the logs are in the plane."""
        self._now_ns = now_ns
        if self.drives and logs is not None:
            logs = self._in_base(now_ns, logs)
        sent = self._manager.step(now_ns, report, vehicle, logs)
        self.begun |= self._manager.is_auto
        if self._manager.state not in FINAL_STATES:
            self._ended_ns = now_ns
        return sent

    @property
    def drives(self) -> bool:
        """Whether the crane works from memory of what a camera ahead has seen."""
        return self._manager.log_memory is not None

    def standpoint(self, now_ns: int) -> Standpoint | None:
        """Tell where the next picture is taken."""
        return self._manager.standpoint(now_ns)

    def _in_base(self, now_ns: int, logs: tuple[LogObservation, ...]) -> tuple[LogObservation, ...] | None:
        """Return a list that was asked for while the machine drove; one that comes when the crane works already is
        dropped, because a log in the grapple does not lie on the ground.
        """
        if self.standpoint(now_ns) is None:
            return None
        base = self._manager.world.base_at(now_ns)
        return tuple(in_base(log, base) for log in logs)

    def abort(self, reason: str) -> None:
        """Fail the mission; crane and machine stop smoothly."""
        self._manager.abort(reason)

    def events(self) -> Iterator[JobEvent]:
        """Yield state, load, remarks on it, grasp, crane phase and pause reason."""
        manager, activity = self._manager, self._manager.activity
        yield "state", {"state": manager.state.name, "words": manager.description}
        yield "load", {"logs": manager.tally.loaded}
        if remarks := manager.tally.remarks:
            yield "remark", {"count": len(remarks), "texts": [remark.text for remark in remarks[-MAX_TOLD:]]}
        if activity is not None:
            yield from _crane_events(activity.grasp, activity.phase.name)
        yield _pause_event(manager.paused or None)

    def outcome(self) -> dict[str, Any]:
        """Return the counts of the mission."""
        tally = self._manager.tally
        given_up = [{"log": number, "reason": reason} for number, reason in tally.given_up.items()]
        return {
            "loaded": tally.loaded,
            "driven_m": round(self._manager.route.driven_m, 1),
            "given_up": given_up,
            "loads": msgspec.to_builtins(tally.loads),
            "remarks": [remark.text for remark in tally.remarks],
        }

    def execute(self, command: MissionCommand) -> str:
        """Execute an operator command; an ended mission accepts none, and the mode switch may forbid Auto."""
        refused = self._executed(command.action)
        code, sentence = refused if isinstance(refused, Problem) else ("", refused)
        self._command, self._refusal, self._refusal_code = command.sequence, sentence, code
        return sentence

    def _executed(self, action: MissionAction) -> str | Problem:
        manager = self._manager
        if manager.state in FINAL_STATES:
            return MISSION_ENDED
        match action:
            case MissionAction.AUTO:
                if (hold := manager.switch.hold) is not None:
                    return hold
                self.begun = True
                manager.auto()
            case MissionAction.PAUSE:
                manager.idle()
            case MissionAction.SINGLE_STEP:
                manager.single_step = True
            case MissionAction.RUN_THROUGH:
                manager.single_step = False
            case MissionAction.NEXT_STEP:
                if manager.pending_event is None:
                    return NO_PENDING_STEP
                manager.next_step()
            case MissionAction.ABORT:
                manager.abort(ABORTED)
        return ""

    def report(self, now_ns: int) -> MissionReport:
        """Return the mission report."""
        manager = self._manager
        return self._publisher.report(now_ns, manager.is_auto, self._command, self._refusal, self._refusal_code)

    def chosen_grasp(self) -> ChosenGrasp | None:
        """Return the grasp of the present crane job."""
        return chosen_grasp(self._manager.activity)

    def progress(self) -> Checkpoint:
        """Return the checkpoint of the mission."""
        return self._manager.progress()


def _crane_events(grasp: Grasp | None, phase: str) -> Iterator[JobEvent]:
    if grasp is not None:
        logs = [log.id for log in grasp.logs]
        yield "grasp", {"logs": logs, "probability": grasp.probability, "reason": grasp.reason}
    yield "phase", {"phase": phase}


def _pause_event(reason: str | None) -> JobEvent:
    return "paused", {"reason": reason}
