"""Flexibility and swing: the column under load and after a stop, the pendulum's period and decay."""

from __future__ import annotations

import itertools
import math

import msgspec
import numpy as np
import pytest

from experiments.common.worlds import home_at, step_neutral, trial_world
from experiments.plant.grasps import Driver, pick_logs
from experiments.plant.runs import SAMPLE_S, released, ringing, stopped
from machine.geometry.kinematics import solve
from machine.loading.profile_file import load_profile
from sim.bullet.client import GRAVITY_M_S2
from sim.truth.load import load_truth
from sim.wood.log_shape import LogSpec
from sim.world import STEP_S, World

PROFILE = load_profile("palms_471")
NOMINAL = load_truth("nominal", 0, "palms_471")
STIFF = msgspec.structs.replace(
    NOMINAL, structure=msgspec.structs.replace(NOMINAL.structure, flex_pitch_nm_rad=2.7e6, flex_roll_nm_rad=2.7e6)
)


def make(truth=NOMINAL, pin=None, **home):
    if pin:
        home |= zip(("slew", "lift", "tilt", "ext"), solve(PROFILE, *pin), strict=True)
    return World(PROFILE, truth, 0, (), home=home)


def hang(w: World, kg: float, seconds: float) -> None:
    """Lower a weight onto the hanger pin."""
    n = round(seconds / STEP_S)
    link = w.crane.link["hanger"]
    for i in range(n):
        down = [0.0, 0.0, -kg * GRAVITY_M_S2 * min(1.0, 2.0 * i / n)]
        w.client.applyExternalForce(w.crane.body, link, down, w.tip(), w.client.WORLD_FRAME)
        w.step([0.0] * len(w.functions))


def unseen(w: World) -> tuple[float, ...]:
    """The tip relative to the encoders' reading."""
    return tuple(a - b for a, b in zip(w.tip(), w.rigid_tip(), strict=True))


@pytest.mark.parametrize(
    ("truth", "pin", "least_m", "most_m"),
    [
        pytest.param(NOMINAL, (0.0, 6.0, 1.0), 0.080, 0.120, id="ahead"),
        pytest.param(NOMINAL, (6.0, 0.0, 1.0), 0.080, 0.120, id="aside"),
        pytest.param(STIFF, (6.0, 0.0, 1.0), 0.027, 0.040, id="three times as stiff"),
    ],
)
def test_250_kg_at_6_m_move_the_tip_unseen_by_the_encoders(truth, pin, least_m, most_m):
    w = make(truth, pin=pin)
    before = unseen(w)
    hang(w, 250.0, 5.0)
    assert least_m < math.dist(unseen(w), before) < most_m
    assert unseen(w)[2] < before[2] < 0.0
    w.close()


def test_after_a_boom_stop_the_tip_rings_at_1_to_2_hz_and_comes_to_rest():
    w = make(lift=0.2, tilt=-0.3, ext=1.2)
    commands = [0.6 if name == "lift" else 0.0 for name in w.functions]
    for _ in range(round(1.5 / STEP_S)):
        w.step(commands)
    heights, sag = [], []
    for _ in range(round(6.0 / STEP_S)):
        w.step([0.0] * len(commands))
        heights.append(w.tip()[2])
        sag.append(unseen(w)[2])
    early, late = slice(120, 800), slice(-800, None)
    middle = (max(sag[early]) + min(sag[early])) / 2
    ups = [i for i, (a, b) in enumerate(itertools.pairwise(sag[early])) if a <= middle < b]
    assert len(ups) >= 2
    frequency = (len(ups) - 1) / ((ups[-1] - ups[0]) * STEP_S)
    assert 1.0 < frequency < 2.0
    swing = [max(heights[s]) - min(heights[s]) for s in (early, late)]
    assert swing[0] > 0.02 and swing[1] < 0.1 * swing[0]
    w.close()


def compound(w: World, hinge: str, logs: tuple[int, ...] = ()) -> tuple[float, float]:
    """Natural frequency [Hz] and inertia [kg m^2] about a hinge of the parts below it, as one rigid body."""
    p, body = w.client, w.crane.body
    hanging = ("hanger", "fork", "rotator", "tong_left", "tong_right")
    pivot, turn = p.getLinkState(body, w.crane.link[hinge], computeForwardKinematics=1)[4:6]
    axis = np.array(p.getMatrixFromQuaternion(turn)).reshape(3, 3) @ p.getJointInfo(body, w.crane.index[hinge])[13]
    links = [w.crane.link[name] for name in hanging[hanging.index(hinge) :]]
    parts = [(p.getDynamicsInfo(body, i), *p.getLinkState(body, i, computeForwardKinematics=1)[:2]) for i in links] + [
        (p.getDynamicsInfo(log, -1), *p.getBasePositionAndOrientation(log)) for log in logs
    ]
    inertia = moment = 0.0
    for (mass, _, principal, *_), com, orientation in parts:
        r = np.array(com) - pivot
        local = np.array(p.getMatrixFromQuaternion(orientation)).reshape(3, 3).T @ axis
        inertia += float(np.dot(local * local, principal) + mass * (r @ r - (r @ axis) ** 2))
        moment -= mass * GRAVITY_M_S2 * r[2]
    return math.sqrt(moment / inertia) / (2.0 * math.pi), inertia


@pytest.mark.parametrize("hinge", ["hanger", "fork"])
def test_the_empty_grapple_swings_with_the_period_and_damping_of_its_mass(hinge):
    """Period 2 pi sqrt(I / (m g d)), damping ratio c / (2 I w)."""
    with trial_world("palms_471", "nominal", 1, home=home_at("palms_471", 4.0, 1.2)) as w:
        step_neutral(w, round(1.0 / STEP_S))
        hz, inertia = compound(w, hinge)
        zeta = getattr(w.truth.structure, f"{hinge}_damping_nm_s_rad") / (2.0 * inertia * 2.0 * math.pi * hz)
        seen = ringing(released(w, hinge), SAMPLE_S, floor=2e-3)
    assert seen.hz == pytest.approx(hz * math.sqrt(1.0 - zeta * zeta), rel=0.05) and 1.3 < 1.0 / seen.hz < 2.2
    assert seen.zeta == pytest.approx(zeta, rel=0.15)


@pytest.mark.long
def test_a_held_log_swings_after_a_slew_stop_with_the_period_of_all_that_hangs():
    x, y = PROFILE.workspace.pick_center_m
    with trial_world("palms_471", "nominal", 1, (LogSpec(x, y, 0.4, 2.5, 0.30, 600.0),)) as w:
        driver = Driver(w)
        pick_logs(w, driver)
        driver.wait(3.0)
        assert w.touched() == [True]
        empty_hz, _ = compound(w, "fork")
        hz, _ = compound(w, "fork", w.log_bodies.body_ids)
        _, seen = stopped(w)
    assert seen.hz == pytest.approx(hz, rel=0.10) and seen.hz < 0.95 * empty_hz
    assert seen.peak_to_peak / 2.0 > 0.01
