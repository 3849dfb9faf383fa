"""The operator turns the emulated safety module's mode switch during work: the machine holds smoothly and goes on."""

from __future__ import annotations

from collections.abc import Sequence

import pytest

from autonomy.crane_job.activity import Activity
from autonomy.crane_job.phases import Phase
from autonomy.crane_job.trajectory_tracker import BRAKE_S
from autonomy.localization.local_plane import LocalPlane
from autonomy.manager.activity_manager import ActivityManager
from autonomy.manager.transition_table import OURS
from autonomy.missions.model import ForwardingMission, Point
from autonomy.perception.log_list import LogObservation
from autonomy.process.jobs import ForwardingJob, Job, SingleLogJob
from can_dbc.messages.crane import ModeSwitch, StateReport
from can_dbc.messages.vehicle import VehicleReport
from hil.harness.lockstep import Observer
from machine.joints import Joint
from machine.loading.profile_file import load_profile, profile_hash
from machine.profile import joint
from machine.status.modes import Mode
from machine.status.reasons import Reason
from sim.kinematic import KinematicMachine
from tests.autonomy.crane_stand_in import GROUND_LOG
from tests.hil.stand_ins import advance, in_lockstep

REPORT_S = 0.02
SITE = LocalPlane(63.657853, 19.895562)


class Run:
    """A job on a machine without physics, in lockstep; ``reports`` are those since the last `advance`."""

    def __init__(self, name: str, job_of, logs: tuple[LogObservation, ...] = ()) -> None:  # type: ignore[no-untyped-def]
        self.profile = load_profile(name)
        self.job: Job = job_of(self.profile, profile_hash(self.profile))
        self.plant = KinematicMachine(self.profile, 1, step_ns=2_500_000)
        self.reports: list[StateReport] = []
        self._vehicle: VehicleReport | None = None
        self._logs = logs
        observer = Observer(None, [self.reports.append], [self._hear])
        self.system = in_lockstep(name, self.plant, self, observer=observer, eyes=self)

    def _hear(self, report: VehicleReport) -> None:
        self._vehicle = report

    def step(self, now_ns: int, report: StateReport | None, logs: tuple[LogObservation, ...]) -> list[bytes]:
        vehicle, self._vehicle = self._vehicle, None
        return self.job.step(now_ns, report, vehicle, logs)

    def detect(self, q: Sequence[float], now_ns: int) -> tuple[LogObservation, ...]:
        return self._logs

    def advance(self, seconds: float, until=lambda: False) -> bool:  # type: ignore[no-untyped-def]
        self.reports.clear()
        return advance(self.system, seconds, until)

    def paused(self) -> object:
        return dict(self.job.events())["paused"]["reason"]

    def assert_no_stop(self) -> None:
        """The controller neither stops nor refuses: the planner alone holds."""
        assert {r.mode for r in self.reports} <= {Mode.ARMED, Mode.ACTIVE}
        assert {r.reason for r in self.reports} == {Reason.NONE} and self.reports[-1].refused == 0
        assert self.system.operator.stops == 0


def test_a_crane_holds_on_its_path_while_the_switch_is_at_idle() -> None:
    run = Run("palms_471", lambda profile, code: SingleLogJob(Activity(profile, code)), (GROUND_LOG,))
    activity = run.job._activity  # type: ignore[attr-defined]
    slewing = joint(run.profile, Joint.SLEW).speed_limit / 3.0
    assert run.advance(20.0, lambda: bool(run.reports) and abs(run.reports[-1].velocity[Joint.SLEW]) > slewing)
    assert activity.phase is Phase.ABOVE
    run.plant.estop.turn(ModeSwitch.IDLE)
    run.advance(3.0)
    run.assert_no_stop()
    told = [r.mode_switch for r in run.reports]
    assert told[-1] == ModeSwitch.IDLE and told.index(ModeSwitch.IDLE) <= 2, "in the second report at the latest"
    stands = run.reports[-1]
    moving = sum(r.reference != stands.reference for r in run.reports)
    assert 0.5 * BRAKE_S < moving * REPORT_S < 1.5 * BRAKE_S, "smoothly on its path, and soon"
    assert max(map(abs, stands.velocity)) < 0.01 and stands.mode == Mode.ACTIVE and run.paused()
    run.advance(2.0)
    assert run.reports[-1].reference == stands.reference and activity.phase is Phase.ABOVE
    run.plant.estop.turn(ModeSwitch.AUTO)
    assert run.advance(20.0, lambda: activity.phase is Phase.DESCEND) and run.paused() is None
    run.assert_no_stop()


@pytest.mark.long
def test_a_forwarder_stands_while_the_switch_is_at_idle_and_drives_on_at_auto() -> None:
    mission = ForwardingMission("test", tuple(Point(*SITE.geodetic(x, 0.0)[:2]) for x in (8.0, 40.0)))
    run = Run(
        "aoro_fc8",
        lambda profile, code: ForwardingJob(ActivityManager(profile, code, mission, OURS), mission, begin=False),
    )
    carrier = run.plant.world.carrier
    run.plant.estop.turn(ModeSwitch.AUTO)
    assert not run.advance(5.0, lambda: carrier.speed_m_s > 0.0), "a planner that finds it at Auto waits"
    for position in (ModeSwitch.IDLE, ModeSwitch.AUTO):
        run.plant.estop.turn(position)
        run.advance(0.5)
    assert run.advance(20.0, lambda: carrier.speed_m_s > 0.4)
    run.plant.estop.turn(ModeSwitch.IDLE)
    run.advance(3.0)
    run.assert_no_stop()
    assert carrier.speed_m_s == 0.0 and run.paused()
    assert not run.advance(5.0, lambda: carrier.speed_m_s > 0.0)
    run.plant.estop.turn(ModeSwitch.AUTO)
    assert run.advance(10.0, lambda: carrier.speed_m_s > 0.4)
    run.assert_no_stop()
