"""A machine without sensors for rotator and opening: the controller starts, moves and never reads them."""

from __future__ import annotations

from math import isnan

import pytest

from can_dbc.messages.crane import GrappleCommand
from controller.config import load
from controller.guard.__main__ import build, profile_path
from controller.laws.grapple import GrappleState
from machine.joints import JOINTS, Joint
from machine.profile import joint
from machine.status.modes import Mode
from tests.controller import bench
from tests.controller.bench import Bench

SETTINGS = load("aoro_fc8")


@pytest.fixture
def forwarder(monkeypatch) -> Bench:
    monkeypatch.setattr(bench, "SPECS", [joint(SETTINGS.profile, j) for j in JOINTS])
    return Bench(settings=SETTINGS, home=(0.0, 0.9, -2.0, 0.5, 0.0))


@pytest.mark.parametrize("which", [Joint.SLEW, Joint.EXT, Joint.ROT])
def test_controller_arms_and_moves_without_a_rotator_encoder(forwarder, which):
    forwarder.active(which, 0.1, 200)
    report = forwarder.reports[-1]
    assert forwarder.mode is Mode.ACTIVE and report.refused == 0
    assert forwarder.q[which] > 0.07
    assert isnan(report.position[Joint.ROT]) and not any(map(isnan, report.position[: Joint.ROT]))
    if which is Joint.ROT:
        assert report.reference[Joint.ROT] == pytest.approx(forwarder.q[Joint.ROT], abs=0.05)


def test_opening_on_the_bus_is_ignored_without_a_sensor(forwarder):
    forwarder.changed["GrappleStat"] = {"Opening": 100.0}
    forwarder.armed()
    for k in range(700):
        forwarder.tick([forwarder.hold(grapple=GrappleCommand.OPEN)] if k % 10 == 0 else ())
        if k == 300:
            assert forwarder.controller.crane.grapple.state is GrappleState.OPENING, "100 % open means nothing here"
    assert isnan(forwarder.reports[-1].opening_pct)
    assert forwarder.controller.crane.grapple.state is GrappleState.OPEN


def test_guard_enables_the_forwarder(monkeypatch):
    monkeypatch.setattr(bench, "SPECS", [joint(SETTINGS.profile, j) for j in JOINTS])
    watched = Bench(settings=SETTINGS, home=(0.0, 0.9, -2.0, 0.5, 0.0), guard=build(profile_path("aoro_fc8")))
    watched.active(Joint.ROT, 0.1, 200)
    assert watched.mode is Mode.ACTIVE and watched.q[Joint.ROT] > 0.07
