"""Calibration of a virtual machine in lockstep: the same procedure as on a real one, faster than real time.

Controller, guard, procedure and plant run in one process on virtual time and real CAN bytes (`hil.lockstep`).  The
procedure sees what it would see at a machine: state reports, the crane's bus, and the surveyor's readings.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from autonomy.calibration.plan import NoRoom, Plan, make_plan
from autonomy.calibration.procedure import Calibration
from autonomy.perception.logs import LogObservation
from can_dbc.codec import load
from can_dbc.frame import Frame
from can_dbc.setpoint import OperatorAction, StateReport
from controller.config import Settings
from controller.guard.__main__ import build as build_guard
from controller.guard.__main__ import profile_path
from hil.lockstep import START_NS, Lockstep, Observer
from hil.operator import Operator
from hil.wire.inprocess import InProcessBus
from machine.load import load_profile, profile_hash
from machine.modes import Mode
from machine.profile import Profile
from recorder.recorder import Recorder
from sim.plant import Plant
from sim.survey import TotalStation, grapple_yaw

LONGEST_S: Final = 420.0
AFTER_NS: Final = 500_000_000
"""A run goes on this long after its end, so that its last frames are on record."""
READY: Final = (Mode.STANDBY, Mode.ARMED)


@dataclass(slots=True)
class Outcome:
    """How a lockstep run ended: the procedure with what it found, and the virtual seconds from arming to its end."""

    calibration: Calibration | None
    plan: Plan | None
    failure: str | None
    seconds: float
    now_ns: int


class _Calibrator:
    """The procedure in the planner's seat; it plans when the machine first says where it stands."""

    def __init__(self, profile: Profile, plant: Plant, seed: int, surveyed: bool, show: Callable[[Plan], None]) -> None:
        self.calibration: Calibration | None = None
        self.plan: Plan | None = None
        self.refused: str | None = None
        self.bus: InProcessBus | None = None
        self._profile, self._plant, self._surveyed, self._show = profile, plant, surveyed, show
        self._station = TotalStation(seed)
        self._frames: list[Frame] = []

    def step(self, now_ns: int, report: StateReport | None, logs: tuple[LogObservation, ...]) -> bytes | None:
        if self.calibration is None:
            if report is not None and report.mode in READY and self.refused is None:
                self._plan(report)
            return None
        self._frames.clear()
        if self.bus is not None:
            self.bus.drain(self._frames)
        reading = self._station.read(self._plant.tip()) if self.calibration.wants_reading else None
        yaw_rad = self._station.read_yaw(grapple_yaw(self._plant)) if self.calibration.wants_yaw else None
        return self.calibration.step(now_ns, report, self._frames, reading, yaw_rad)

    def _plan(self, report: StateReport) -> None:
        try:
            self.plan = make_plan(self._profile, report.position, self._surveyed)
        except NoRoom as error:
            self.refused = str(error)
            return
        self._show(self.plan)
        self.calibration = Calibration(self._profile, profile_hash(self._profile), self.plan, load("crane"))


def run_lockstep(
    name: str,
    truth: str,
    seed: int,
    *,
    surveyed: bool,
    recorder: Recorder | None = None,
    show: Callable[[Plan], None] = lambda plan: None,
    watch: Callable[[Calibration], None] = lambda calibration: None,
    aborted: Callable[[], bool] = lambda: False,
) -> Outcome:
    """Calibrates the virtual machine of a profile; ``watch`` is called with the procedure some times a second.

    Raises:
        ValueError: the truth cannot be used.
    """
    profile = load_profile(name)
    plant = Plant(profile, seed=seed, truth=truth, logs=0)
    try:
        seat = _Calibrator(profile, plant, seed, surveyed, show)
        settings = Settings(profile, profile_hash(profile), profile.rate_hz)
        operator = Operator(profile_hash(profile), _pressed, patience=0)
        system = Lockstep(settings, build_guard(profile_path(name)), plant, seat, operator, Observer(recorder, []))
        seat.bus = InProcessBus(system.core, "calibrator")
        return _run(system, seat, watch, aborted)
    finally:
        plant.close()


def _pressed(action: OperatorAction, report: StateReport) -> None:
    """The human who arms says nothing."""


def _run(
    system: Lockstep, seat: _Calibrator, watch: Callable[[Calibration], None], aborted: Callable[[], bool]
) -> Outcome:
    limit_ns = START_NS + int(LONGEST_S * 1e9)
    turns = 0
    while system.now_ns < limit_ns and seat.refused is None:
        system.advance()
        calibration = seat.calibration
        turns += 1
        if calibration is not None and turns % 64 == 0:
            watch(calibration)
            if aborted():
                calibration.abort("interrupted")
        if calibration is not None and (calibration.idle or calibration.done):
            break
        if system.operator.gave_up and (calibration is None or calibration.begun_ns is None):
            break
    end_ns = system.now_ns
    while system.now_ns < end_ns + AFTER_NS:
        system.advance()
    calibration = seat.calibration
    failure = seat.refused or (calibration.failure if calibration else "the machine did not come to STANDBY")
    if calibration is not None and failure is None and not calibration.done:
        failure = f"not done within {LONGEST_S:.0f} s, at {calibration.task}"
    return Outcome(calibration, seat.plan, failure, calibration.elapsed_s if calibration else 0.0, system.now_ns)
