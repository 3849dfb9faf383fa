"""The step of a joint on the plant, through the controller: what it shows, and what ends it."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest

from autonomy.commissioning.step_test import StepTest, largest_step, profile_margins
from can_dbc.dbc.codec import load
from can_dbc.frame import Frame
from can_dbc.messages.crane import StateReport
from controller.config import Settings
from controller.guard.__main__ import build as build_guard
from controller.guard.__main__ import profile_path
from hil.harness.lockstep import Lockstep, Observer
from hil.harness.operator import Operator
from hil.wire.inprocess import InProcessBus
from machine.joints import JOINTS, Joint
from machine.loading.profile_file import load_profile, profile_hash
from machine.status.modes import Mode
from machine.status.reasons import Reason
from runtime.errors import InputRefused
from sim.plant import Plant
from tests.codes import coded

PROFILE = load_profile("palms_471")
HASH = profile_hash(PROFILE)


class _Planner:
    """The test as the planner of a lockstep run."""

    def __init__(self, test: StepTest) -> None:
        self.test, self.bus, self.modes = test, None, set()

    def step(self, now_ns: int, report: StateReport | None, logs: object) -> bytes | None:
        frames: list[Frame] = []
        if self.bus is not None:
            self.bus.drain(frames)
        if report is not None:
            self.modes.add(report.mode)
        return self.test.step(now_ns, report, frames)


def run(test: StepTest, seconds: float = 30.0, each: Callable[[Lockstep], None] = lambda system: None) -> _Planner:
    """On the nominal plant, with an operator who arms once."""
    plant = Plant(PROFILE, seed=1, truth="nominal", logs=0)
    try:
        planner = _Planner(test)
        operator = Operator(HASH, lambda action, report: None, max_stops=0)
        system = Lockstep(
            Settings(PROFILE, HASH, PROFILE.rate_hz),
            build_guard(profile_path("palms_471")),
            plant,
            planner,
            operator,
            Observer(None, []),
        )
        planner.bus = InProcessBus(system.core, "step")
        end_ns = system.now_ns + int(seconds * 1e9)
        while system.now_ns < end_ns and not test.idle:
            system.advance()
            each(system)
        return planner
    finally:
        plant.close()


@pytest.mark.long
@pytest.mark.parametrize(("which", "amount"), [(Joint.SLEW, 0.3), (Joint.LIFT, 0.12), (Joint.EXT, 0.2)])
def test_a_joint_steps_out_and_back_and_all_of_it_is_seen(which: Joint, amount: float) -> None:
    test = StepTest(PROFILE, HASH, which, amount, load("crane"))
    assert test.waiting
    run(test)
    assert test.done and test.failure is None and test.progress == 1.0
    found = test.result()
    position, reference = found.series["position"], found.series["reference"]
    assert np.ptp(reference) == pytest.approx(amount, rel=0.02)
    assert np.ptp(position) == pytest.approx(amount, rel=0.1)
    assert 0.0 < found.rest_error < 0.05 * amount < found.largest_error + 0.05 * amount
    assert 0.0 <= found.overshoot < 0.1 * amount and 0.0 <= found.delay_s < 0.6
    assert 12.0 < found.largest_command_pct <= 100.0, "beyond the dead-band"
    assert np.nanmax(np.abs(found.series["spool"] - found.series["command"])) < 60.0
    assert np.ptp(found.series["pressure_a"]) > 1.0, "its pressures move with it"


@pytest.mark.long
def test_an_abort_brakes_on_the_path_and_a_stop_ends_it() -> None:
    test = StepTest(PROFILE, HASH, Joint.SLEW, 0.5, load("crane"))

    def end(system: Lockstep) -> None:
        if test.progress > 0.2:
            test.abort("the page is gone")

    planner = run(test, each=end)
    assert test.failure == "the page is gone" and test.idle and not test.done
    assert not planner.modes & {Mode.STOP, Mode.FAULT}, "braked, not stopped"


def test_a_test_waits_for_armed_and_ends_with_the_controller() -> None:
    test = StepTest(PROFILE, HASH, Joint.SLEW, 0.2, load("crane"))
    q = (0.0, 0.5, -1.5, 0.5, 0.0)

    def report(mode: Mode, refused: int = 0, refusal: Reason = Reason.WRONG_PROFILE) -> StateReport:
        return StateReport(1, HASH, 1, mode, 0, 0, 1, refusal, refused, 0, q, (0.0,) * 5, q, 0.0, 0.0, 0.0, 0, 0, 0, 0)

    assert test.step(10**9, report(Mode.STANDBY)) is None and "STANDBY" in str(test.waiting)
    assert test.step(2 * 10**9, report(Mode.ACTIVE)) is None and "ACTIVE" in str(test.waiting), "a planner drives"
    assert test.step(3 * 10**9, report(Mode.ARMED)) is not None and test.waiting is None
    assert test.step(3 * 10**9 + 400_000_000, None) is None
    assert test.idle and test._failure is not None and test._failure.code == "step.controller-silent"
    again = StepTest(PROFILE, HASH, Joint.SLEW, 0.2, load("crane"))
    again.step(10**9, report(Mode.ARMED))
    again.step(10**9 + 5 * 10**7, report(Mode.ACTIVE, 1, Reason.DATAGRAM_AUTHENTICATION))
    assert not again.idle, "a stranger's datagram"
    assert again.step(10**9 + 10**8, report(Mode.ACTIVE, refused=1)) is None and again.idle and again.failure
    last = StepTest(PROFILE, HASH, Joint.SLEW, -0.2, load("crane"))
    q = (-1.65, *q[1:])
    assert last.step(10**9, report(Mode.ARMED)) is None and last.idle
    assert last._failure is not None and last._failure.code == "step.range"


@pytest.mark.parametrize("amount", [0.0, math.nan, math.inf, 10.0, -10.0])
def test_an_amount_that_is_none_or_too_large_is_refused(amount: float) -> None:
    with pytest.raises(InputRefused, check=coded("step.amount")):
        StepTest(PROFILE, HASH, Joint.LIFT, amount, load("crane"))


def test_a_joint_without_an_encoder_is_refused() -> None:
    forwarder = load_profile("aoro_fc8")
    with pytest.raises(InputRefused, check=coded("step.no-encoder")):
        StepTest(forwarder, 1, Joint.ROT, 0.1, load("crane"))


def test_the_profile_s_margins_are_those_of_the_loop_design() -> None:
    for j in JOINTS:
        phase_deg, gain_db = profile_margins(PROFILE, j)
        assert phase_deg > 40.0 and gain_db > 6.0 and largest_step(PROFILE, j) > 0.1
