"""A whole mission in lockstep: the forwarder on its site, controller, guard and activity manager on virtual buses.

New logs are laid for every lap, as in paper B.  `hil.missions.detectors` has the detectors.  The same seed leaves the
same bytes.
"""

from __future__ import annotations

from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path

from rich.console import Console

from autonomy.grasp.pile_planner import PilePlanner
from autonomy.grasp.planner import GraspPlanner
from autonomy.grasp.planners import OUR_PLANNER, PlannerChoice
from autonomy.grasp.sampling_planner import SamplingPlanner
from autonomy.grasp.selection import PlannerSelection
from autonomy.manager.activity_manager import ActivityManager
from autonomy.manager.transition_table import FINAL_STATES, TABLES, State
from autonomy.missions.model import ForwardingMission
from autonomy.perception.log_list import LogObservation
from autonomy.process.mission_publisher import MissionPublisher
from autonomy.process.planner_process import REPORT_PERIOD_NS
from can_dbc.messages.crane import OperatorAction, StateReport
from can_dbc.messages.mission import encode_mission
from can_dbc.messages.vehicle import VehicleReport
from controller.config import Settings
from controller.guard.__main__ import build as build_guard
from controller.guard.__main__ import profile_path
from hil.harness.display import Display
from hil.harness.lockstep import START_NS, Lockstep, Observer
from hil.harness.operator import Operator
from hil.missions.detectors import make_detector
from hil.missions.site import site_of
from hil.missions.summary import MissionSummary, report_loads
from host.exit_codes import CommandFailed, ExitCode
from machine.loading.profile_file import load_profile, profile_hash
from machine.profile import Profile
from machine.status.explanation import describe
from machine.status.modes import Mode
from recorder.manifest import describe as describe_run
from recorder.recorder import Recorder
from sim.plant import Plant
from sim.site.log_supply import LogSupplier
from sim.site.site_file import Site

EPOCH = datetime(2000, 1, 1, tzinfo=UTC)
"""The date at which virtual time begins, for documents that carry one."""
SETTLE_S = 3.0
SUPPLY_TICKS = 200
"""New logs are laid at most this often."""


def run_mission(
    mission: ForwardingMission,
    name: str,
    seed: int,
    truth: str,
    manager: str,
    logs: int,
    directory: Path,
    limit_s: float,
    console: Console,
    detector: str = "perfect",
    terrain: str = "flat",
    planner: PlannerChoice = OUR_PLANNER,
) -> MissionSummary:
    """Run the mission on virtual time; ``logs`` > 0 lays that many along the route instead of those of the mission.

    ``manager`` names a transition table, ``detector`` a detector of `hil.missions.detectors`, ``terrain`` a kind of
    ground of `sim.ground.terrain`, ``planner`` the planner of grasps from the ground.

    Raises:
        CommandFailed: profile, truth or mission cannot be used.
    """
    profile = load_profile(name)
    try:
        site = site_of(mission, profile, seed, truth, logs, terrain)
        grasp_planner = planner.make()
        plant = site.plant(profile, truth, seed)
        buses = tuple(bus for bus in (profile.crane_bus, profile.machine_bus) if bus)
        recorder = Recorder(directory, profile, describe_run(profile, buses, seed))
    except ValueError as error:
        raise CommandFailed.from_error(error, ExitCode.CONFIGURATION) from None
    try:
        with Display(console, f"{profile.title}: {mission.name or 'a mission'}, lockstep, seed {seed}") as display:
            run = MissionRun(
                mission, name, profile, plant, recorder, display, manager, site, detector, seed, grasp_planner
            )
            summary = run.run(limit_s, str(directory))
        report_loads(directory, run.manager.tally.loads, mission, profile, EPOCH, START_NS)
        return summary
    finally:
        recorder.close()


class MissionRun:
    """Lockstep run with a display: shows every change, ends with the manager.  `step` makes it the run's planner."""

    def __init__(
        self,
        mission: ForwardingMission,
        name: str,
        profile: Profile,
        plant: Plant,
        recorder: Recorder | None,
        display: Display,
        manager: str,
        site: Site,
        detector: str = "perfect",
        seed: int = 0,
        planner: GraspPlanner | None = None,
    ) -> None:
        self._display, self._mode = display, -1
        self._vehicle: VehicleReport | None = None
        self._shown: tuple[State | None, str, str, str] = (None, "", "", "")
        self._told = 0
        """Remarks on the load that were shown."""
        self.states: list[tuple[float, str]] = []
        code = profile_hash(profile)
        uses_memory = detector != "perfect"
        self.manager = ActivityManager(
            profile,
            code,
            mission,
            TABLES[manager],
            selector=PlannerSelection(planner or SamplingPlanner()),
            uses_memory=uses_memory,
            unloading_selector=PlannerSelection(PilePlanner(SamplingPlanner())),
        )
        self.manager.auto()
        self.plant = plant
        self._recorder, self._code = recorder, code
        self._publisher = MissionPublisher(self.manager, mission)
        self._published = 0
        """Mission reports so far: the recorder gets them as those of a live run, and draws their log map."""
        self._publish_ns = START_NS
        self._layer = LogSupplier(plant, site.places, site.rounds)
        self.system = Lockstep(
            Settings(profile, code, profile.rate_hz),
            build_guard(profile_path(name)),
            plant,
            self,
            Operator(code, self._on_press),
            Observer(recorder, [self._on_report], [self._on_vehicle]),
            make_detector(detector, plant, profile, self.manager, seed),
        )

    def step(
        self, now_ns: int, report: StateReport | None, logs: tuple[LogObservation, ...] | None
    ) -> bytes | list[bytes] | None:
        """Pass the inputs of the tick to the manager; its datagrams to the controller."""
        vehicle, self._vehicle = self._vehicle, None
        sent = self.manager.step(now_ns, report, vehicle, logs)
        if self._recorder is not None and now_ns >= self._publish_ns:
            self._publish_ns = now_ns + REPORT_PERIOD_NS
            self._published += 1
            mission_report = self._publisher.report(now_ns, auto=True)
            self._recorder.on_report(encode_mission(mission_report, self._published, self._code, now_ns))
        return sent

    def run(self, limit_s: float, directory: str, watch: Callable[[], None] = lambda: None) -> MissionSummary:
        """Run until the manager ends, and `SETTLE_S` longer; ``watch`` is called after every slice."""
        system, manager = self.system, self.manager
        limit_ns = START_NS + int(limit_s * 1e9)
        while manager.state not in FINAL_STATES and system.now_ns < limit_ns and not system.operator.gave_up:
            system.advance()
            if system.ticks % SUPPLY_TICKS == 0 and (laid := self._layer.step()):
                self._display.event(f"{laid} new logs laid")
            self._show_changes()
            watch()
        ended_ns = system.now_ns
        while system.now_ns < ended_ns + int(SETTLE_S * 1e9):
            system.advance()
        verdict = self.plant.evaluate()
        report, vehicle = system.report, system.vehicle_report
        late = "" if manager.state is State.DONE else f"not finished within {limit_s:.0f} s"
        failure = manager.failure or system.operator.complaint or late
        return MissionSummary(
            finished=manager.state is State.DONE,
            failure=failure,
            logs=len(verdict.logs),
            in_bunk=sum(log.in_bunk for log in verdict.logs),
            loaded=manager.tally.loaded,
            given_up=manager.tally.given_up,
            seconds=(ended_ns - START_NS) / 1e9,
            driven_m=manager.route.driven_m,
            stops=system.operator.stops,
            refused=(report.refused if report else 0) + (vehicle.refused if vehicle else 0),
            states=tuple(self.states),
            directory=directory,
            remarks=tuple(remark.text for remark in manager.tally.remarks),
        )

    def _show_changes(self) -> None:
        """Show what differs from the last call: state, pause, failure of the crane job."""
        manager = self.manager
        for remark in manager.tally.remarks[self._told :]:
            self._told += 1
            self._display.event(remark.text, "yellow")
        job = manager.activity
        phase, failure = (job.phase.name, job.failure or "") if job is not None else ("", "")
        shown = (manager.state, manager.paused, phase, failure)
        if shown == self._shown:
            return
        before, self._shown = self._shown, shown
        if manager.state is not before[0]:
            seconds = (self.system.now_ns - START_NS) / 1e9
            self.states.append((round(seconds, 2), manager.state.name))
            self._display.phase(manager.state.name)
            self._display.event(f"  {manager.description}; {manager.tally.loaded} logs on board")
        if manager.paused != before[1]:
            self._display.event(f"paused: {manager.paused}" if manager.paused else "resumed", "yellow")
        if failure and failure != before[3]:
            self._display.event(f"the crane job failed: {failure}", "yellow")

    def _on_vehicle(self, vehicle: VehicleReport) -> None:
        self._vehicle = vehicle

    def _on_report(self, report: StateReport) -> None:
        if report.mode != self._mode:
            self._mode = report.mode
            if report.mode in (Mode.STOP, Mode.FAULT):
                self._display.event(
                    f"{Mode(report.mode).name}: {describe(report.reason, numbers=report.numbers)}", "yellow"
                )
        self._display.report(report)

    def _on_press(self, action: OperatorAction, _: StateReport) -> None:
        self._display.event(f"operator presses {action.name}", "magenta")
