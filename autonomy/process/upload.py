"""A planner that is started without a mission: it waits for one, and takes an uploaded one while the machine rests.

An upload names a file of the missions folder and its SHA-256 (`can_dbc.messages.mission`).  It is taken when the
controller reports, the machine is neither armed nor moving, and no mission has begun; it is refused otherwise, with a
code and a sentence.  A taken mission does not start by itself: it waits for the command Auto.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Final

from autonomy.manager.checkpoint import Checkpoint
from autonomy.missions.features import Draft
from autonomy.missions.folder import MissionFolder
from autonomy.missions.mission_file import read, verify
from autonomy.missions.model import ForwardingMission
from autonomy.perception.log_list import LogObservation
from autonomy.perception.standpoint import Standpoint
from autonomy.process.command_line import emit
from autonomy.process.jobs import Job, JobEvent
from autonomy.process.operator_commands import CommandRefused
from can_dbc.messages.crane import StateReport
from can_dbc.messages.mission import ChosenGrasp, MissionCommand, MissionReport, MissionUpload
from can_dbc.messages.vehicle import VehicleReport
from machine.status.modes import Mode

REPORT_AGE_NS: Final = 1_000_000_000
STANDING_M_S: Final = 0.05
WAITING: Final = "waits for a mission"
NO_MISSION: Final = "there is no mission yet; upload one"


@dataclass(slots=True)
class MachineAtRest:
    """What is known of the machine: its newest state report, its speed, and when they were reported."""

    report: StateReport | None = None
    speed_m_s: float = math.nan
    mode_ns: int = -REPORT_AGE_NS
    speed_ns: int = -REPORT_AGE_NS

    def on_reports(self, report: StateReport | None, vehicle: VehicleReport | None, now_ns: int) -> None:
        """Take the newest reports."""
        if report is not None:
            self.report, self.mode_ns = report, now_ns
        if vehicle is not None:
            self.speed_m_s, self.speed_ns = vehicle.speed_m_s, now_ns

    @property
    def mode(self) -> int:
        """The mode of the newest report, -1 before the first."""
        return -1 if self.report is None else self.report.mode

    def check(self, now_ns: int) -> None:
        """Check that a mission may be taken now.

        Raises:
            CommandRefused: it may not.
        """
        if now_ns - min(self.mode_ns, self.speed_ns) > REPORT_AGE_NS:
            raise CommandRefused("upload.no-report", "the controller does not report; start it first")
        if self.mode in (Mode.ARMED, Mode.ACTIVE):
            raise CommandRefused("upload.armed", "the machine is armed; disarm it first")
        if not abs(self.speed_m_s) < STANDING_M_S:
            raise CommandRefused("upload.moving", "the machine moves, or its speed is unknown; let it stand first")


@dataclass(frozen=True, slots=True)
class UploadedMissions:
    """Makes jobs of uploaded missions; ``site`` is the latitude and longitude [deg] of the machine's site."""

    folder: MissionFolder
    site: tuple[float, float]
    job_of: Callable[[ForwardingMission], Job]

    def job(self, upload: MissionUpload) -> Job:
        """Make the job of an uploaded mission.

        Raises:
            CommandRefused: the file is not the one that was uploaded.
            MissionError: the mission cannot be read or driven.
        """
        data = self.folder.read(upload.name)
        if hashlib.sha256(data).digest() != upload.digest:
            sentence = f"{upload.name} is not the file that was uploaded; do both use the same folder?"
            raise CommandRefused("upload.other-file", sentence)
        draft = read(data, upload.name)
        verify(draft, route_wanted=True, site=self.site)
        tell_losses(draft)
        return self.job_of(draft.mission)


def tell_losses(draft: Draft) -> None:
    """Emit ``mission``: what of its file the mission does not have, and where it will be driven otherwise."""
    if draft.notes or draft.warnings:
        emit("mission", notes=draft.notes or None, warnings=[str(problem) for problem in draft.warnings] or None)


class WaitingJob:
    """No mission yet: nothing is sent, and every command is refused."""

    done = begun = drives = False

    def __init__(self) -> None:
        self.failure: str | None = None
        self._command, self._refusal = 0, ""

    @property
    def idle(self) -> bool:
        """Whether the process shall end."""
        return self.failure is not None

    def step(
        self,
        now_ns: int,
        report: StateReport | None,
        vehicle: VehicleReport | None,
        logs: tuple[LogObservation, ...] | None,
    ) -> list[bytes]:
        """Do nothing."""
        return []

    def standpoint(self, now_ns: int) -> Standpoint | None:
        """Return None: no picture is wanted."""
        return None

    def abort(self, reason: str) -> None:
        """End the process."""
        self.failure = reason

    def events(self) -> Iterator[JobEvent]:
        """Yield that it waits."""
        yield "state", {"state": "WAITING", "words": WAITING}

    def outcome(self) -> dict[str, Any]:
        """Return no fields."""
        return {}

    def execute(self, command: MissionCommand) -> str:
        """Refuse every command."""
        self._command, self._refusal = command.sequence, NO_MISSION
        return NO_MISSION

    def report(self, now_ns: int) -> MissionReport:
        """Return an empty report."""
        return MissionReport(
            schema=1,
            name="",
            state="WAITING",
            words=WAITING,
            ended=False,
            auto=False,
            single_step=False,
            paused="",
            waits_for="",
            failure="",
            order=self._command,
            refusal=self._refusal,
            loaded=0,
            on_board=0,
            on_board_m3=0.0,
            unloaded=0,
            missed=0,
            given_up=(),
            driven_m=0.0,
            targets=(),
            crane="",
            here=None,
            route=(),
            closed=False,
            fences=(),
            landings=(),
            logs=(),
        )

    def chosen_grasp(self) -> ChosenGrasp | None:
        """Return None: the crane does not work."""
        return None

    def progress(self) -> Checkpoint | None:
        """Return None."""
        return None
