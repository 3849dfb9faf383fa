"""A pile too wide for the jaws: these stall at its sides, and keep closing while they lift it."""

from __future__ import annotations

from itertools import pairwise

from autonomy.crane_job.activity import Activity
from autonomy.crane_job.grasp_verification import MAX_RESTARTS
from autonomy.crane_job.phases import Phase
from autonomy.grasp.sampling_planner import SamplingPlanner
from autonomy.grasp.selection import PlannerSelection
from autonomy.grasp.weight import bearable_kg
from autonomy.perception.log_list import LogObservation
from can_dbc.messages.crane import GrappleCommand
from machine.geometry.grapple import tip_below_pin_m
from machine.geometry.kinematics import pin_position
from machine.loading.profile_file import profile_hash
from tests.autonomy.crane_stand_in import StandIn
from tests.autonomy.grasp_scenes import GROUND, PROFILE, measured, small_pile
from tests.codes import numbers_in

STALL_RAD = 0.5  # of 2.25: opened by four fifths


class Heap(StandIn):
    """Tongs that come down deeper than ``shoulder_m`` meet logs on both sides."""

    shoulder_m = GROUND + 0.12
    gives_rad = 0.0  # in a tick
    heavy_kg = 0.0
    """What hangs in the tongs that clasp, in full once the pin has risen by 0.3 m."""

    @property
    def load_kg(self) -> float:
        risen_m = self.pin_m() - self.clasped_m
        return self.heavy_kg * min(max(risen_m / 0.3, 0.0), 1.0) if self.gripped else 0.0

    clasped_m = 9.0

    def pin_m(self) -> float:
        """Height of the pin by the joints."""
        return pin_position(self.profile.kinematics, self.q)[2]

    def seen(self) -> tuple[LogObservation, ...]:
        return tuple(measured(log) for log in self.logs)

    def _grapple(self, command: GrappleCommand) -> None:
        before, tip_m = self.gripped, self.pin()[2] - tip_below_pin_m(self.profile.grapple.jaws, self.tong_rad)
        if command is GrappleCommand.CLOSE and self.tong_rad >= STALL_RAD and tip_m < self.shoulder_m:
            self.gripped = True
            self.tong_rad += self.gives_rad
        else:
            self.gripped = self.held is not None or (self.heavy_kg > 0.0 and self.gripped)
            super()._grapple(command)
        if self.gripped and not before:
            self.clasped_m = self.pin_m()


def lifting(heap: Heap) -> tuple[Activity, list[Phase]]:
    """The job at the beginning of its lift, and its phases since the first descent."""
    planner = Activity(PROFILE, profile_hash(PROFILE), grasp_selector=PlannerSelection(SamplingPlanner()))
    phases = heap.until(planner, Phase.LIFT)
    return planner, phases[phases.index(Phase.DESCEND) :]


def test_jaws_that_stall_at_the_sides_of_a_pile_close_on_while_they_lift_it() -> None:
    heap = Heap(PROFILE, small_pile())
    planner, phases = lifting(heap)
    assert phases == [Phase.DESCEND, Phase.CLOSE, Phase.LIFT] and heap.tong_rad < STALL_RAD + 0.1
    while planner.phase is Phase.LIFT and heap.tong_rad < STALL_RAD + 0.5:
        heap.step(planner)
    assert planner.phase is Phase.LIFT


def test_a_pile_that_yields_slowly_is_waited_for() -> None:
    heap = Heap(PROFILE, small_pile())
    heap.gives_rad = 0.002
    assert lifting(heap)[1] == [Phase.DESCEND, Phase.CLOSE, Phase.LIFT]
    assert heap.tong_rad > STALL_RAD + 0.1


def test_what_is_too_heavy_is_released_before_the_machine_stops_and_gripped_anew() -> None:
    heap = Heap(PROFILE, small_pile())
    heap.heavy_kg = 600.0
    planner, _ = lifting(heap)
    begun_m, loads = heap.pin_m(), []
    phases = [planner.phase]
    while planner.phase is not Phase.FAILED and len(phases) < 40:
        heap.step(planner)
        loads.append(heap.load_kg / bearable_kg(planner._cycle.arm, heap.q))
        if planner.phase is not phases[-1]:
            phases.append(planner.phase)
            begun_m = heap.pin_m() if planner.phase is Phase.LIFT else begun_m
        assert planner.phase is not Phase.LIFT or heap.pin_m() < begun_m + 0.3
    assert max(loads) < 1.0
    assert phases.count(Phase.LIFT) == 1 + MAX_RESTARTS and planner.failure_code == "activity.too-heavy"
    assert planner.failure is not None and 350.0 < numbers_in(planner.failure)[0] <= 600.0
    assert Phase.LIFT not in {b for a, b in pairwise(phases) if a is Phase.OPEN}


def test_a_heavy_load_is_lifted_more_slowly() -> None:
    heap, light = Heap(PROFILE, small_pile()), Heap(PROFILE, small_pile())
    heap.heavy_kg, light.heavy_kg = 360.0, 10.0
    risen_m = []
    for each in (heap, light):
        planner, _ = lifting(each)
        begun_m = each.pin_m()
        for _ in range(120):
            each.step(planner)
        assert planner.phase is Phase.LIFT
        risen_m.append(each.pin_m() - begun_m)
    assert 0.2 < risen_m[0] < 0.8 * risen_m[1]
