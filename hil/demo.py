"""The first job, live or in lockstep: one log from the ground into the bunk of the PALMS 4.71 test-bed (paper A)."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Final

from rich.console import Console

from autonomy.crane_job.activity import Activity
from autonomy.grasp.direct import Planned
from autonomy.grasp.search import Search
from can_dbc.setpoint import OperatorAction, StateReport
from controller.config import Settings
from controller.guard.__main__ import build as build_guard
from controller.guard.__main__ import profile_path
from hil.display import Display
from hil.live import LiveOptions
from hil.live_demo import OneLogRun
from hil.lockstep import START_NS, Eyes, Lockstep, Observer
from hil.operator import Operator
from hil.plc_path import BridgedPlant
from hil.summary import Summary, verdict_sentence
from host.exits import Exit, Stopped
from machine.faults import describe
from machine.load import load_profile, profile_hash
from machine.modes import Mode
from machine.profile import Profile
from recorder.manifest import describe as describe_run
from recorder.recorder import Recorder, RecordingRefused
from sim.plant import Plant

SETTLE_NS: Final = 3_000_000_000


def run_live(
    name: str,
    seed: int,
    truth: str,
    bus: str,
    directory: Path,
    page: int,
    limit_s: float,
    patience: int,
    console: Console,
    plc_link: str = "modbus",
    camera: str = "",
) -> Summary:
    """The job as separate processes in real time."""
    profile = load_profile(name)
    directory.mkdir(parents=True, exist_ok=True)
    options = LiveOptions(name, profile, seed, truth, bus, directory, page, limit_s, patience, plc_link, camera)
    with Display(console, f"{profile.title}: one log into the bunk, live, seed {seed}") as display:
        return OneLogRun(options, display).run()


def run_lockstep(
    name: str, seed: int, truth: str, directory: Path, limit_s: float, console: Console, camera: str = ""
) -> Summary:
    """The job in one process on virtual time; the same seed leaves the same bytes in ``directory``.

    With ``camera`` the planner sees the logs through it; without, it is told where they lie.
    """
    profile = load_profile(name)
    try:
        plant = Plant(profile, seed, truth) if profile.plc is None else BridgedPlant(profile, seed, truth)
        buses = tuple(name for name in (profile.crane_bus, profile.machine_bus) if name)
        eyes = _eyes(plant, profile, camera, seed) if camera else None
        recorder = Recorder(directory, profile, describe_run(profile, buses, seed))
    except (ValueError, RecordingRefused) as error:
        raise Stopped(Exit.CONFIGURATION, str(error)) from None
    try:
        with Display(console, f"{profile.title}: one log into the bunk, lockstep, seed {seed}") as display:
            return _Job(name, profile, plant, recorder, display, eyes).run(limit_s, str(directory))
    finally:
        recorder.close()


def _eyes(plant: Plant, profile: Profile, camera: str, seed: int) -> Eyes:
    from hil.rig_camera import eyes_of  # a network and what runs it: not for a job that needs none

    return eyes_of(plant, profile, camera, seed)


class _Job:
    """Lockstep run with a display: says what changes, ends when the planner does."""

    def __init__(
        self,
        name: str,
        profile: Profile,
        plant: Plant,
        recorder: Recorder | None,
        display: Display,
        eyes: Eyes | None,
    ) -> None:
        settings = Settings(profile, profile_hash(profile), profile.rate_hz)
        self._display = display
        self._mode: int = -1
        self._phase = self._grasp = ""
        self.activity = Activity(profile, profile_hash(profile), chooser=Planned(Search()))
        self.system = Lockstep(
            settings,
            build_guard(profile_path(name)),
            plant,
            self.activity,
            Operator(profile_hash(profile), self._pressed),
            Observer(recorder, [self._reported]),
            eyes,
        )

    def run(self, limit_s: float, directory: str) -> Summary:
        system, activity = self.system, self.activity
        limit_ns = START_NS + int(limit_s * 1e9)
        while not activity.done and not activity.failure and system.now_ns < limit_ns:
            system.advance()
            if system.operator.gave_up:
                break
            if activity.grasp is not None and activity.grasp.reason != self._grasp:
                self._grasp = activity.grasp.reason
                self._display.event(f"grasp: {self._grasp}")
            if activity.phase.name != self._phase:
                self._phase = activity.phase.name
                self._display.phase(self._phase)
        finished_ns = system.now_ns
        verdict = system.plant.judge()
        while not verdict.success and system.now_ns < finished_ns + SETTLE_NS:
            system.advance()
            verdict = system.plant.judge()
        report = system.report
        return Summary(
            in_bunk=verdict.success,
            verdict=verdict_sentence(asdict(verdict)),
            failure=activity.failure or ("" if activity.done else f"not done within {limit_s:.0f} s"),
            seconds=(finished_ns - START_NS) / 1e9,
            stops=system.operator.stops,
            ticks=system.ticks,
            missed_ticks=0,
            frames=system.frames,
            refused_setpoints=report.refused if report else 0,
            grasp=self._grasp,
            directory=directory,
        )

    def _reported(self, report: StateReport) -> None:
        if report.mode != self._mode:
            self._mode = report.mode
            mode = Mode(report.mode)
            stopped = mode in (Mode.STOP, Mode.FAULT)
            self._display.event(
                f"{mode.name}: {describe(report.reason)}" if stopped else f"controller {mode.name}",
                "yellow" if stopped else "",
            )
        self._display.report(report)

    def _pressed(self, action: OperatorAction, _: StateReport) -> None:
        self._display.event(f"operator presses {action.name}", "magenta")
