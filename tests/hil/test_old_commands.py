"""Whole machines in lockstep behind a bus that holds their commands up: nothing old is executed, and they stop in time.

Catalogue entries 7, 12, 13 and 15 of docs/reference/safety.md section 5, as the nodes see them.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import pytest

from autonomy.crane_job.activity import Activity
from can_dbc.messages.vehicle import Steering
from can_dbc.protocols.punctuality import MAX_DELAY_NS
from hil.harness.lockstep import START_NS, Observer
from hil.wire.faults import Fault, Kind
from hil.wire.node import Flight, Segment
from machine.loading.profile_file import load_profile, profile_hash
from machine.status.modes import Mode
from sim.kinematic import KinematicMachine
from sim.plant import Plant
from tests.hil.stand_ins import Blind, Drives, advance, in_lockstep

pytestmark = pytest.mark.long

MS = 1_000_000
S = 1_000 * MS
PROMISE_NS = 100 * MS
ABOVE_ALL, BELOW_SENSORS = 0x000, 0x201
"""Priorities of a babbling node: over every frame, and between those of the sensors and the valve commands."""


class Crane:
    """A crane at work; every ValveCmdA that the valve node accepts is known with its age."""

    def __init__(self) -> None:
        profile = load_profile("palms_471")
        self.plant = Plant(profile, 3)
        self.system = in_lockstep("palms_471", self.plant, Activity(profile, profile_hash(profile)), max_stops=0)
        self.executed: list[tuple[int, int]] = []
        """When a command was accepted, and its age then [ns]."""
        self._ages_ns: dict[int, int] = {}
        """Of the controller's frames, by the end of their transmission: how long ago they were queued."""
        self._watch_bus()
        self._watch_node()

    def _watch_bus(self) -> None:
        core = self.system.core
        finish = core._finish

        def noting(segment: Segment, flight: Flight) -> None:
            if flight.sender.name == "controller":
                self._ages_ns[flight.end_ns] = flight.end_ns - flight.frame.ready_ns
            finish(segment, flight)

        core._finish = noting  # type: ignore[method-assign]

    def _watch_node(self) -> None:
        commands = self.plant.valve._a
        accept = commands.accept

        def noting(data: bytes, now_ns: int) -> bool:
            accepted = accept(data, now_ns)
            if accepted:
                self.executed.append((now_ns, self._ages_ns[now_ns]))
            return accepted

        commands.accept = noting  # type: ignore[method-assign]

    @property
    def moving(self) -> bool:
        return any(self.plant.valve.outputs_pct)

    def start(self) -> None:
        """Until the crane has moved for a second."""
        while not self.moving:
            self.system.advance()
            assert self.system.now_ns < START_NS + 30 * S
        advance(self.system, 1.0)
        assert self.moving

    def neutral_after_ns(self, limit_ns: int) -> int:
        """How long the valves take to be neutral from now on."""
        began_ns = self.system.now_ns
        while self.moving and self.system.now_ns < began_ns + limit_ns:
            self.system.advance()
        return self.system.now_ns - began_ns


@pytest.fixture
def crane() -> Iterator[Crane]:
    made = Crane()
    yield made
    made.plant.close()


@pytest.mark.parametrize(
    ("fault", "length_ms", "modes"),
    [
        pytest.param(Fault(Kind.BABBLE, key=ABOVE_ALL), 600, (Mode.STOP, Mode.FAULT), id="babble above all"),
        pytest.param(Fault(Kind.BABBLE, key=BELOW_SENSORS), 600, (Mode.STOP, Mode.FAULT), id="babble below sensors"),
        pytest.param(Fault(Kind.CUT, node="controller"), 300, (Mode.STOP, Mode.FAULT), id="an open cable"),
        pytest.param(Fault(Kind.ERROR, node="controller"), 50, (Mode.FAULT,), id="bus-off"),
    ],
)
def test_valves_are_neutral_within_100_ms_of_a_fault_of_the_bus_and_stay_so_when_it_is_gone(
    crane: Crane, fault: Fault, length_ms: int, modes: tuple[Mode, ...]
) -> None:
    """Of a bus-off, whose frames fail 32 times, the controller recovers by itself after 0.1 s, and does not go on."""
    crane.start()
    now_ns = crane.system.now_ns
    crane.system.core.inject(replace(fault, start_ns=now_ns, end_ns=now_ns + length_ms * MS))
    assert crane.neutral_after_ns(S) <= PROMISE_NS
    crane.executed.clear()
    advance(crane.system, 2.0)
    assert not crane.moving and crane.system.report is not None
    assert crane.system.report.mode in modes
    assert max(age_ns for _, age_ns in crane.executed) <= 30 * MS, "nothing old has left the queue"


@pytest.mark.parametrize("pause_us", [150, 200, 250, 300, 400])
def test_commands_that_a_busy_bus_lets_through_slowly_are_never_executed_late(crane: Crane, pause_us: int) -> None:
    """Between two of its frames the babbling node lets others pass: the queue fills slowly, and no time-out expires."""
    crane.start()
    crane.executed.clear()
    now_ns = crane.system.now_ns
    crane.system.core.inject(Fault(Kind.BABBLE, now_ns, now_ns + 2 * S, key=BELOW_SENSORS, shift_ns=1000 * pause_us))
    late_ns = None
    for _ in range(1600):
        crane.system.advance()
        if late_ns is None and crane.executed and crane.executed[-1][1] > MAX_DELAY_NS:
            late_ns = crane.system.now_ns
        if late_ns is not None and crane.system.now_ns > late_ns + PROMISE_NS:
            assert not crane.moving
    assert max(age_ns for _, age_ns in crane.executed) <= MAX_DELAY_NS + 5 * MS


def test_the_carrier_brakes_when_its_commands_come_60_ms_late_in_order() -> None:
    plant = KinematicMachine(load_profile("aoro_fc8"), 3, step_ns=2_500_000)
    planner = Drives(lambda *_: {"steering": Steering.ARTICULATION, "speed_m_s": 0.5})
    observer = Observer(None, [], [planner.hear])
    system = in_lockstep("aoro_fc8", plant, planner, observer=observer, eyes=Blind(), max_stops=0)
    node, arms = plant.vehicle_node, plant.arms
    assert node is not None and arms is not None
    while node.drive_m_s == 0.0:
        system.advance()
        assert system.now_ns < START_NS + 30 * S
    began_ns = system.now_ns
    system.cores[1].inject(Fault(Kind.DELAY, began_ns, node="controller", shift_ns=60 * MS))
    while not node.brake and system.now_ns < began_ns + S:
        system.advance()
    assert system.now_ns - began_ns <= PROMISE_NS
    until_ns = system.now_ns + S
    while system.now_ns < until_ns:
        system.advance()
        assert node.brake and node.drive_m_s == 0.0 and not any(arms.spools)
