"""The one-log job in lockstep: one log from the ground into the bunk of the PALMS 4.71 test-bed (paper A)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Final, Protocol

from rich.console import Console

from autonomy.crane_job.activity import Activity
from autonomy.crane_job.phases import Phase
from autonomy.grasp.planners import OUR_PLANNER, PlannerChoice
from autonomy.grasp.selection import PlannerSelection
from autonomy.perception.log_list import LogObservation
from autonomy.process.jobs import SingleLogJob
from can_dbc.messages.crane import OperatorAction, StateReport
from controller.config import Settings
from controller.guard.__main__ import build as build_guard
from controller.guard.__main__ import profile_path
from controller.tick import Outputs
from hil.demo.summary import Summary, is_settled, outcome_sentence
from hil.faults.injector import Injector
from hil.faults.table import Order
from hil.harness.display import Display
from hil.harness.lockstep import START_NS, Lockstep, LogDetector, Observer
from hil.harness.operator import MAX_STOPS, Operator
from hil.plc import BridgedPlant
from host.exit_codes import CommandFailed, ExitCode
from machine.loading.profile_file import load_profile, profile_hash
from machine.profile import Profile
from machine.status.explanation import describe
from machine.status.modes import Mode
from recorder.manifest import describe as describe_run
from recorder.recorder import Recorder
from sim.plant import Plant

SETTLE_NS: Final = 10_000_000_000
"""A bowed log rocks in the bunk for up to five seconds; the evaluation waits for rest, at most this long."""


class Companion(Protocol):
    """What goes along with a run and changes nothing of it by itself; `hil.demo.paced` is one."""

    def begin(self, system: Lockstep, activity: Activity, display: Display) -> None:
        """Prepare for the run that is about to begin."""

    def go_along(self, system: Lockstep) -> None:
        """Act before a slice; called before every slice."""

    def on_outputs(self, outputs: Outputs, now_ns: int) -> None:
        """Act on the outputs of a tick; called after every tick."""


def run_lockstep(
    name: str,
    seed: int,
    truth: str,
    directory: Path,
    limit_s: float,
    console: Console,
    camera: str = "",
    orders: Sequence[Order] = (),
    max_stops: int = MAX_STOPS,
    companion: Companion | None = None,
    planner: PlannerChoice = OUR_PLANNER,
) -> Summary:
    """Run the job in one process on virtual time; the same seed leaves the same bytes in ``directory``.

    With ``camera`` the planner gets the logs detected through it, without it their true poses.  ``orders``:
    faults to inject.  ``max_stops``: as in `Operator`.  ``planner`` chooses the grasp planner.

    Raises:
        CommandFailed: profile, truth, camera or directory cannot be used.
        InputRefused: this machine has no such fault.
    """
    profile = load_profile(name)
    try:
        plant = Plant(profile, seed, truth) if profile.plc is None else BridgedPlant(profile, seed, truth)
        buses = tuple(name for name in (profile.crane_bus, profile.machine_bus) if name)
        detector = _camera_detector(plant, profile, camera, seed) if camera else None
        selector = PlannerSelection(planner.make())
        recorder = Recorder(directory, profile, describe_run(profile, buses, seed))
    except ValueError as error:
        raise CommandFailed.from_error(error, ExitCode.CONFIGURATION) from None
    try:
        time = "lockstep" if companion is None else "paced"
        with Display(console, f"{profile.title}: one log into the bunk, {time}, seed {seed}") as display:
            job = _Job(name, profile, plant, recorder, display, detector, max_stops, companion, selector)
            if orders:
                job.system.operator.watches = any(order.fault == "operator-off" for order in orders)
                Injector(job.system, orders)
            return job.run(limit_s, str(directory))
    finally:
        recorder.close()


def _camera_detector(plant: Plant, profile: Profile, camera: str, seed: int) -> LogDetector:
    from hil.plant.camera import camera_detector  # loads a network, which a run without a camera does not need

    return camera_detector(plant, profile, camera, seed)


class _Job:
    """Lockstep run with a display: shows every change, ends with the planner.  `step` makes it the run's planner."""

    def __init__(
        self,
        name: str,
        profile: Profile,
        plant: Plant,
        recorder: Recorder | None,
        display: Display,
        detector: LogDetector | None,
        max_stops: int,
        companion: Companion | None,
        selector: PlannerSelection,
    ) -> None:
        settings = Settings(profile, profile_hash(profile), profile.rate_hz)
        self._display, self._companion = display, companion
        self._mode: int = -1
        self._phase = self._grasp = ""
        self._closings = 0
        self.activity = Activity(profile, profile_hash(profile), grasp_selector=selector)
        self._job = SingleLogJob(self.activity)
        self.system = Lockstep(
            settings,
            build_guard(profile_path(name)),
            plant,
            self,
            Operator(profile_hash(profile), self._on_press, max_stops),
            Observer(recorder, [self._on_report], on_outputs=[] if companion is None else [companion.on_outputs]),
            detector,
        )

    def step(self, now_ns: int, report: StateReport | None, logs: tuple[LogObservation, ...] | None) -> list[bytes]:
        """Pass the inputs of the tick to the job, which obeys the mode switch; its datagrams to the controller."""
        return self._job.step(now_ns, report, None, logs)

    def run(self, limit_s: float, directory: str) -> Summary:
        system, activity = self.system, self.activity
        limit_ns = START_NS + int(limit_s * 1e9)
        if self._companion is not None:
            self._companion.begin(system, activity, self._display)
        while not activity.done and not activity.failure and system.now_ns < limit_ns:
            self._advance()
            if system.operator.gave_up:
                break
            if activity.grasp is not None and activity.grasp.reason != self._grasp:
                self._grasp = activity.grasp.reason
                self._display.event(f"grasp: {self._grasp}")
            if activity.phase.name != self._phase:
                self._phase = activity.phase.name
                self._closings += activity.phase is Phase.CLOSE
                self._display.phase(self._phase)
        finished_ns = system.now_ns
        verdict = system.plant.evaluate()
        while not is_settled(asdict(verdict)) and system.now_ns < finished_ns + SETTLE_NS:
            self._advance()
            verdict = system.plant.evaluate()
        report, late = system.report, "" if activity.done else f"not done within {limit_s:.0f} s"
        return Summary(
            in_bunk=verdict.success,
            verdict=outcome_sentence(asdict(verdict)),
            failure=activity.failure or system.operator.complaint or late,
            seconds=(finished_ns - START_NS) / 1e9,
            stops=system.operator.stops,
            ticks=system.ticks,
            missed_ticks=0,
            frames=system.frames,
            refused_setpoints=report.refused if report else 0,
            grasp=self._grasp,
            closings=self._closings,
            directory=directory,
        )

    def _advance(self) -> None:
        if self._companion is not None:
            self._companion.go_along(self.system)
        self.system.advance()

    def _on_report(self, report: StateReport) -> None:
        if report.mode != self._mode:
            self._mode = report.mode
            mode = Mode(report.mode)
            if mode in (Mode.STOP, Mode.FAULT):
                self._display.event(f"{mode.name}: {describe(report.reason, numbers=report.numbers)}", "yellow")
            else:
                self._display.event(f"controller {mode.name}")
        self._display.report(report)

    def _on_press(self, action: OperatorAction, _: StateReport) -> None:
        self._display.event(f"operator presses {action.name}", "magenta")
