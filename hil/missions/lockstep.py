"""A whole mission in lockstep: the forwarder on its site, controller, guard and activity manager on virtual buses.

Logs are replaced for every lap, as in paper B.  A detector that makes no mistakes sees what is near the crane or before
the machine.  The same seed leaves the same bytes.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path

from rich.console import Console

from autonomy.grasp.selection import Planned
from autonomy.grasp.pile_planner import Press
from autonomy.grasp.sampling_planner import Search
from autonomy.manager.activity_manager import Manager
from autonomy.manager.transition_table import ENDS, WAYS, State
from autonomy.missions.model import ForwardingMission
from autonomy.perception.log_list.observation import LogObservation
from can_dbc.messages.crane import OperatorAction, StateReport, VehicleReport
from controller.config import Settings
from controller.guard.__main__ import build as build_guard
from controller.guard.__main__ import profile_path
from hil.harness.display import Display
from hil.missions.forwarded_report import report_loads
from hil.harness.lockstep import START_NS, Lockstep, Observer
from hil.missions.detectors import eyes_of
from hil.missions.site import site_of
from hil.harness.operator import Operator
from host.exit_codes import Exit, Stopped
from machine.faults import describe
from machine.load import load_profile, profile_hash
from machine.modes import Mode
from machine.profile import Profile
from recorder.manifest import describe as describe_run
from recorder.recorder import Recorder, RecordingRefused
from sim.plant import Plant
from sim.site.log_supply import Layer
from sim.site_file import Site

EPOCH = datetime(2000, 1, 1, tzinfo=UTC)
"""When a run in virtual time begins, for what has to carry a date."""
SETTLE_S = 3.0
LOOKS = 200


@dataclass(frozen=True, slots=True)
class MissionSummary:
    """What a mission came to; ``in_bunk`` is the plant's word, everything else the manager's or the controller's."""

    finished: bool
    failure: str
    logs: int
    in_bunk: int
    loaded: int
    given_up: dict[int, str]
    seconds: float
    driven_m: float
    stops: int
    refused: int
    states: tuple[tuple[float, str], ...]
    directory: str

    @property
    def exit(self) -> Exit:
        """Fine when the mission came to its end and all that was said to be loaded lies in the bunk."""
        if self.finished and self.in_bunk == self.loaded:
            return Exit.FINE
        return Exit.SAFETY if self.stops else Exit.FIGURE

    def show(self, console: Console) -> None:
        """Print it for a person."""
        mark = "[green]✔[/green]" if self.exit is Exit.FINE else "[red]✘[/red]"
        end = "The mission is finished" if self.finished else f"The mission ended early: {self.failure}"
        console.print(f"{mark} {end}. {self.in_bunk} of {self.logs} logs lie in the bunk.", highlight=False)
        for number, why in self.given_up.items():
            console.print(f"  log {number} was given up: {why}", highlight=False, soft_wrap=True)
        console.print(
            f"  {self.seconds:.0f} s, {self.driven_m:.0f} m, {self.stops} stops, {self.refused} setpoints refused",
            highlight=False,
        )
        console.print(f"  logs: {self.directory}", highlight=False, soft_wrap=True)

    def save(self, path: Path) -> None:
        """Write it as JSON."""
        path.write_text(json.dumps(asdict(self), indent=2) + "\n")


def run_mission(
    mission: ForwardingMission,
    name: str,
    seed: int,
    truth: str,
    way: str,
    logs: int,
    directory: Path,
    limit_s: float,
    console: Console,
    eyes: str = "perfect",
) -> MissionSummary:
    """The mission on virtual time; ``logs`` more than 0: so many along the route instead of those of the mission.

    Raises:
        Stopped: profile, truth or mission cannot be used.
    """
    profile = load_profile(name)
    try:
        site = site_of(mission, profile, seed, truth, logs)
        plant = site.plant(profile, truth, seed)
        buses = tuple(bus for bus in (profile.crane_bus, profile.machine_bus) if bus)
        recorder = Recorder(directory, profile, describe_run(profile, buses, seed))
    except (ValueError, RecordingRefused) as error:
        raise Stopped(Exit.CONFIGURATION, str(error)) from None
    try:
        with Display(console, f"{profile.title}: {mission.name or 'a mission'}, lockstep, seed {seed}") as display:
            run = MissionRun(mission, name, profile, plant, recorder, display, way, site, eyes, seed)
            summary = run.run(limit_s, str(directory))
        report_loads(directory, run.manager.tally.loads, mission, profile, EPOCH, START_NS)
        return summary
    finally:
        recorder.close()


class MissionRun:
    """Lockstep with a display: says what changes, ends when the manager does."""

    def __init__(
        self,
        mission: ForwardingMission,
        name: str,
        profile: Profile,
        plant: Plant,
        recorder: Recorder | None,
        display: Display,
        way: str,
        site: Site,
        eyes: str = "perfect",
        seed: int = 0,
    ) -> None:
        self._display, self._mode, self._vehicle = display, -1, None
        self._told: tuple[State | None, str, str, str] = (None, "", "", "")
        self.states: list[tuple[float, str]] = []
        code = profile_hash(profile)
        remembers = eyes != "perfect"
        self.manager = Manager(
            profile, code, mission, WAYS[way], chooser=Planned(Search()), remembers=remembers,
            emptier=Planned(Press(Search())),
        )  # fmt: skip
        self.manager.auto()
        self.plant = plant
        self._layer = Layer(plant, site.places, site.rounds)
        self.system = Lockstep(
            Settings(profile, code, profile.rate_hz),
            build_guard(profile_path(name)),
            plant,
            self,
            Operator(code, self._pressed),
            Observer(recorder, [self._reported], [self._heard]),
            eyes_of(eyes, plant, profile, self.manager, seed),
        )

    def step(
        self, now_ns: int, report: StateReport | None, logs: tuple[LogObservation, ...]
    ) -> bytes | list[bytes] | None:
        """As a planner of the lockstep: everything goes to the manager."""
        vehicle, self._vehicle = self._vehicle, None
        return self.manager.step(now_ns, report, vehicle, logs)

    def run(self, limit_s: float, directory: str, watch: Callable[[], None] = lambda: None) -> MissionSummary:
        """Until the manager has ended, and a little longer for what still moves; ``watch`` is called every slice."""
        system, manager = self.system, self.manager
        limit_ns = START_NS + int(limit_s * 1e9)
        while manager.state not in ENDS and system.now_ns < limit_ns and not system.operator.gave_up:
            system.advance()
            if system.ticks % LOOKS == 0 and (laid := self._layer.step()):
                self._display.event(f"{laid} new logs are laid")
            self._tell()
            watch()
        ended_ns = system.now_ns
        while system.now_ns < ended_ns + int(SETTLE_S * 1e9):
            system.advance()
        verdict = self.plant.judge()
        report, vehicle = system.report, system.vehicle_report
        failure = manager.failure or ("" if manager.state is State.DONE else f"not finished within {limit_s:.0f} s")
        return MissionSummary(
            finished=manager.state is State.DONE,
            failure=failure,
            logs=len(verdict.logs),
            in_bunk=sum(log.in_bunk for log in verdict.logs),
            loaded=manager.tally.loaded,
            given_up=manager.tally.given_up,
            seconds=(ended_ns - START_NS) / 1e9,
            driven_m=manager.ride.driven_m,
            stops=system.operator.stops,
            refused=(report.refused if report else 0) + (vehicle.refused if vehicle else 0),
            states=tuple(self.states),
            directory=directory,
        )

    def _tell(self) -> None:
        """Say what is not as it was."""
        manager = self.manager
        job = manager.activity
        phase, failure = (job.phase.name, job.failure or "") if job is not None else ("", "")
        told = (manager.state, manager.paused, phase, failure)
        if told == self._told:
            return
        before, self._told = self._told, told
        if manager.state is not before[0]:
            seconds = (self.system.now_ns - START_NS) / 1e9
            self.states.append((round(seconds, 2), manager.state.name))
            self._display.phase(manager.state.name)
            self._display.event(f"  {manager.words}; {manager.tally.loaded} logs on board")
        if manager.paused != before[1]:
            self._display.event(f"paused: {manager.paused}" if manager.paused else "goes on", "yellow")
        if failure and failure != before[3]:
            self._display.event(f"the crane gives up: {failure}", "yellow")

    def _heard(self, vehicle: VehicleReport) -> None:
        self._vehicle = vehicle

    def _reported(self, report: StateReport) -> None:
        if report.mode != self._mode:
            self._mode = report.mode
            if report.mode in (Mode.STOP, Mode.FAULT):
                self._display.event(f"{Mode(report.mode).name}: {describe(report.reason)}", "yellow")
        self._display.report(report)

    def _pressed(self, action: OperatorAction, _: StateReport) -> None:
        self._display.event(f"operator presses {action.name}", "magenta")
