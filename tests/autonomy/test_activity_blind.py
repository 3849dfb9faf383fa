"""A machine whose rotator and grapple opening are not measured: the cycle runs on what was last sent."""

from __future__ import annotations

import random
from dataclasses import replace
from math import cos, isfinite, nan, pi, sin

import pytest

from autonomy.crane_job.activity import Activity
from autonomy.grasp.bunk_load import lies_in_bunk
from autonomy.perception.log_list import LogObservation
from can_dbc.messages.crane import StateReport
from machine.joints import Joint
from machine.loading.profile_file import load_profile, profile_hash
from tests.autonomy.crane_stand_in import StandIn

FORWARDER = load_profile("aoro_fc8")
HOME = (0.0, 1.25, -2.39, 0.10, 0.0)


class Blind(StandIn):
    """The stand-in whose controller reports no rotator and no opening."""

    def report(self) -> StateReport:
        said = super().report()
        return replace(said, position=(*said.position[: Joint.ROT], nan), opening_pct=nan)


def birch(seed: int) -> LogObservation:
    rng = random.Random(f"scene {seed}")
    (cx, cy), half = FORWARDER.workspace.pick_center_m, FORWARDER.workspace.pick_half_size_m
    x, y, yaw = cx + rng.uniform(-half, half), cy + rng.uniform(-half, half), rng.uniform(-pi, pi)
    return LogObservation(0, (x, y, FORWARDER.workspace.ground_z_m + 0.125), (cos(yaw), sin(yaw), 0.0), 2.0, 0.25)


@pytest.mark.parametrize("seed", range(10))
def test_a_log_beside_the_forwarder_goes_into_its_bunk(seed: int) -> None:
    crane = Blind(FORWARDER, [birch(seed)], q=HOME)
    planner = Activity(FORWARDER, profile_hash(FORWARDER))
    crane.run(planner)
    assert planner.failure is None and planner.done and planner.missed == 0
    assert lies_in_bunk(FORWARDER.bunk, crane.logs[0])


def test_a_lost_encoder_still_pauses_it() -> None:
    crane = Blind(FORWARDER, [birch(0)], q=HOME)
    planner = Activity(FORWARDER, profile_hash(FORWARDER))
    lost = replace(crane.report(), position=(nan, *crane.report().position[1:]))
    assert planner.step(crane.now_ns, lost, crane.seen()) is None
    assert planner.paused_code == "activity.position-unknown"
    assert crane.step(planner) is not None and planner.paused is None
    assert not isfinite(crane.report().position[Joint.ROT])
