"""Before the machine drives the crane goes over its bunk; what cannot be carried on is put back where it lay."""

from __future__ import annotations

import numpy as np
import pytest

from autonomy.crane_job.activity import Activity, Phase
from autonomy.grasp.grapple_heights import retreat_height_m
from autonomy.grasp.planner import NoGrasp
from autonomy.motion.arm_kinematics import Arm
from can_dbc.messages.crane import GrappleCommand
from can_dbc.messages.datagrams import decode
from machine.geometry.kinematics import Unreachable
from machine.loading.profile_file import profile_hash
from tests.autonomy.crane_stand_in import GROUND_LOG, StandIn
from tests.autonomy.test_activity import PROFILE, activity, phases, run_until

ARM = Arm(PROFILE)
BUNK = PROFILE.bunk


def stow(crane: StandIn) -> Activity:
    planner = Activity(PROFILE, profile_hash(PROFILE), stow_only=True)
    while not planner.idle:
        data = crane.step(planner)
        assert data is None or decode(data).grapple is GrappleCommand.HOLD  # type: ignore[union-attr]
    assert planner.done and planner.idle, planner.failure
    assert planner.grasp is None
    return planner


def over_the_bunk(q: tuple[float, ...]) -> bool:
    pin = ARM.pose(q)
    x, y = ARM.xy(pin)
    near = abs(x - BUNK.center_m[0]) < BUNK.width_m and abs(y - BUNK.center_m[1]) < BUNK.width_m
    return near and pin.z_m > retreat_height_m(PROFILE) - 0.02


def test_from_beside_a_log_it_goes_over_the_bunk_and_keeps_its_jaws_as_they_are() -> None:
    crane = StandIn(PROFILE, [GROUND_LOG])
    planner = activity()
    run_until(crane, planner, Phase.DESCEND)
    planner.abort("that will do")
    crane.run(planner)
    assert not over_the_bunk(crane.q)
    stow(crane)
    assert over_the_bunk(crane.q)


def test_where_it_already_rests_there_nothing_moves() -> None:
    crane = StandIn(PROFILE, [])
    over = ARM.pose_above(*BUNK.center_m, retreat_height_m(PROFILE) + 0.2, retreat_height_m(PROFILE) + 0.2)
    crane.q = tuple(ARM.joints(np.array([over]))[0].tolist())
    before = crane.q
    stow(crane)
    assert crane.q == pytest.approx(before, abs=1e-6)


@pytest.mark.parametrize("trouble", [Unreachable("no way is clear"), NoGrasp("grasp.bunk-full", "the bunk is full")])
def test_a_log_without_a_path_on_is_released_where_it_lay(trouble: Exception, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise trouble

    monkeypatch.setattr("autonomy.crane_job.cycle.carry_motion", refuse)
    crane, planner = StandIn(PROFILE, [GROUND_LOG]), activity()
    crane.run(planner)
    assert planner.failure == str(trouble) and planner.idle
    assert phases(crane)[-3:] == ["LOWER", "OPEN", "FAILED"]
    (log,) = crane.logs
    assert crane.held is None
    assert log.center_m == pytest.approx(GROUND_LOG.center_m, abs=0.1)


def test_a_lifted_log_without_a_path_on_goes_down_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """Lifted alone first, it hangs over where it lay when there turns out to be no room."""
    monkeypatch.setattr("autonomy.crane_job.cycle.plan_place", refuse_room)
    crane, planner = StandIn(PROFILE, [GROUND_LOG]), activity(direct=False)
    crane.run(planner)
    assert planner.failure_code == "grasp.bunk-full"
    assert "LIFT" in phases(crane) and phases(crane)[-3:] == ["LOWER", "OPEN", "FAILED"]
    (log,) = crane.logs
    assert crane.held is None and log.center_m == pytest.approx(GROUND_LOG.center_m, abs=0.1)


def refuse_room(*_: object, **__: object) -> None:
    raise NoGrasp("grasp.bunk-full", "no room")
