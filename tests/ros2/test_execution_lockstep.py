"""Goals executed by the whole machine in lockstep: physics, controller, guard, and the bridge's core as the planner."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from autonomy.motion.setpoint_stream import SetpointStream
from can_dbc.messages.crane import StateReport
from controller.config import load as load_settings
from controller.guard.__main__ import build as build_guard
from controller.guard.__main__ import profile_path
from hil.harness.lockstep import Lockstep, Observer
from hil.harness.operator import Operator
from machine.joints import Joint
from machine.status.modes import Mode
from machine.status.reasons import Reason
from ros2.execution.execution import Outcome, TrajectoryExecution
from ros2.interfaces.action import Status
from ros2.interfaces.control import ErrorCode, Goal
from sim.plant import Plant
from tests.ros2.goals import goal

pytestmark = pytest.mark.long
SETTINGS = load_settings("palms_471")
GONE = Outcome(Status.ABORTED, Reason.LEASE_LOST, "gone")


class Bridge:
    """The bridge's core as a lockstep planner."""

    def __init__(self) -> None:
        self.execution = TrajectoryExecution(SETTINGS.profile, SetpointStream(SETTINGS.profile_hash, 200_000_000))
        self.outcome: Outcome | None = None
        self.sent = 0

    def step(self, now_ns: int, report: StateReport | None, logs: tuple) -> bytes | None:
        setpoint, outcome = self.execution.step(now_ns, report)
        self.outcome = outcome or self.outcome
        self.sent += setpoint is not None
        return setpoint


class Machine:
    """The machine with its bridge, armed and at rest."""

    def __init__(self) -> None:
        self.plant, self.bridge = Plant(SETTINGS.profile, seed=3), Bridge()
        self.operator = Operator(SETTINGS.profile_hash, lambda action, _: None)
        guard = build_guard(profile_path("palms_471"))
        self.system = Lockstep(SETTINGS, guard, self.plant, self.bridge, self.operator, Observer())
        while self.report.mode != Mode.ARMED:
            self.system.advance()

    @property
    def report(self) -> StateReport:
        while self.system.report is None:
            self.system.advance()
        return self.system.report

    def run(self, seconds: float) -> None:
        end_ns = self.system.now_ns + round(seconds * 1e9)
        while self.system.now_ns < end_ns and self.bridge.outcome is None:
            self.system.advance()

    def outcome(self, asked: Goal, seconds: float = 20.0) -> Outcome:
        """Of a goal that ends in so much time."""
        self.begin(asked)
        self.run(seconds)
        assert self.bridge.outcome is not None
        return self.bridge.outcome

    def begin(self, asked: Goal) -> None:
        self.bridge.outcome = None
        self.bridge.execution.begin(asked, self.system.now_ns, 0)

    def rest(self, seconds: float) -> float:
        """Let time pass; returns the greatest speed of a joint in the last 0.2 s."""
        for _ in range(round(seconds / 0.00125)):
            self.system.advance()
        fastest = 0.0
        for _ in range(160):
            self.system.advance()
            fastest = max(fastest, *map(abs, self.report.velocity[: Joint.ROT]))
        return fastest


@pytest.fixture
def machine() -> Iterator[Machine]:
    made = Machine()
    yield made
    made.plant.close()


def test_a_goal_moves_the_crane_there_and_it_holds(machine: Machine) -> None:
    start = machine.report.position
    there = (start[0] - 0.4, start[1] + 0.1)
    outcome = machine.outcome(goal((5.0, there), joints=("slew", "lift")))
    assert (outcome.status, outcome.error_code) == (Status.SUCCEEDED, ErrorCode.SUCCESSFUL)
    sent = machine.bridge.sent
    assert machine.rest(1.0) < 0.02 and machine.bridge.sent == sent
    assert machine.report.mode == Mode.ARMED and machine.report.refused == 0
    assert machine.report.position[:2] == pytest.approx(there, abs=0.02)
    assert machine.report.position[2:4] == pytest.approx(start[2:4], abs=0.02)


def test_a_second_goal_begins_where_the_first_ended(machine: Machine) -> None:
    start = machine.report.position
    for offset in (-0.2, 0.0):
        asked = goal((4.0, (start[0] + offset,)), joints=("slew",), final={"slew": 0.03})
        assert machine.outcome(asked).status is Status.SUCCEEDED
    assert machine.report.position[0] == pytest.approx(start[0], abs=0.03) and machine.report.refused == 0


def test_a_goal_that_ends_early_stops_on_its_path_and_holds(machine: Machine) -> None:
    start = machine.report.position[0]
    machine.begin(goal((6.0, (start - 0.6,)), joints=("slew",)))
    machine.run(3.0)
    assert machine.bridge.outcome is None and machine.report.mode == Mode.ACTIVE
    machine.bridge.execution.end(GONE)
    machine.run(5.0)
    assert machine.bridge.outcome == GONE
    assert machine.rest(1.0) < 0.02
    assert machine.report.mode == Mode.ARMED and machine.report.refused == 0
    assert start - 0.55 < machine.report.position[0] < start - 0.15


def test_a_stop_of_the_controller_ends_the_goal_with_its_reason(machine: Machine) -> None:
    start = machine.report.position[0]
    machine.begin(goal((6.0, (start - 0.6,)), joints=("slew",)))
    machine.run(2.0)
    machine.plant.estop.press()
    machine.run(1.0)
    outcome = machine.bridge.outcome
    assert outcome is not None and outcome.status is Status.ABORTED
    assert outcome.error_code == machine.report.reason & 0xFF and outcome.error_code > 0
    assert f"[{Reason(outcome.error_code).name}]" in outcome.sentence
    assert machine.rest(1.0) < 0.02


def test_leaving_the_path_ends_the_goal(machine: Machine) -> None:
    start = machine.report.position[0]
    outcome = machine.outcome(goal((5.0, (start - 0.5,)), joints=("slew",), path={"slew": 1e-4}), 10.0)
    assert outcome.error_code == ErrorCode.PATH_TOLERANCE_VIOLATED
    assert "slew" in outcome.sentence


def test_a_goal_tolerance_that_is_not_reached_in_time_ends_the_goal(machine: Machine) -> None:
    start = machine.report.position[0]
    asked = goal((5.0, (start - 0.5,)), joints=("slew",), final={"slew": 1e-7}, time_tolerance_s=1.0)
    assert machine.outcome(asked).error_code == ErrorCode.GOAL_TOLERANCE_VIOLATED
