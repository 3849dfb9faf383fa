"""Flexibility and swing: the column under load and after a stop, the pendulum's period and decay."""

from __future__ import annotations

import itertools
import math

import msgspec
import pytest

from machine.geometry.kinematics import solve
from machine.loading.profile_file import load_profile
from sim.bullet.client import GRAVITY_M_S2
from sim.scenes.arrangements import random_scene
from sim.truth.load import load_truth
from sim.world import STEP_S, World
from tests.sim.crane_driver import Driver

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


def test_250_kg_at_6_m_move_the_tip_a_decimetre_unseen_by_the_encoders():
    w = make(pin=(0.0, 6.0, 1.0))
    before = unseen(w)
    hang(w, 250.0, 5.0)
    assert 0.080 < math.dist(unseen(w), before) < 0.120
    assert unseen(w)[2] < before[2] < 0.0
    w.close()


def test_the_column_bends_equally_at_every_slew_and_in_inverse_proportion_to_its_stiffness():
    for truth, least, most in ((NOMINAL, 0.080, 0.120), (STIFF, 0.027, 0.040)):
        w = make(truth, pin=(6.0, 0.0, 1.0))
        before = unseen(w)
        hang(w, 250.0, 5.0)
        assert least <= math.dist(unseen(w), before) < most
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


def pendulum(w: World, log: int | None = None) -> tuple[float, float]:
    """Period [s] and damping ratio by theory: all that hangs on the hanger pin as one rigid body about its axis."""
    p, pin = w.client, w.tip()
    hanging = [("hanger", 1), ("fork", 1), ("rotator", 1), ("tong_left", 1), ("tong_right", 1)]
    about, moment = 0.0, 0.0
    for name, _ in hanging:
        link = NOMINAL.links["tong" if name.startswith("tong") else name]
        com = p.getLinkState(w.crane.body, w.crane.link[name], computeForwardKinematics=1)[0]
        r = math.dist(com[1:], pin[1:])
        about += link.inertia_kg_m2[0] + link.mass_kg * r * r
        moment += link.mass_kg * GRAVITY_M_S2 * (pin[2] - com[2])
    if log is not None:
        state = w.log_bodies.states()[log]
        along = state.axis[1] ** 2 + state.axis[2] ** 2  # how much of the log turns about x
        r = math.dist(state.position_m[1:], pin[1:])
        about += state.mass_kg * (r * r + along * state.length_m**2 / 12)
        moment += state.mass_kg * GRAVITY_M_S2 * (pin[2] - state.position_m[2])
    omega = math.sqrt(moment / about)
    return 2 * math.pi / omega, NOMINAL.structure.hanger_damping_nm_s_rad / (2 * about * omega)


def swing(w: World, step) -> tuple[float, float]:
    """Period [s] and damping ratio of the hanger after a push, from its turning points."""
    link = w.crane.link["rotator"]
    for _ in range(round(0.4 / STEP_S)):
        at = w.link_poses()["rotator"][0]
        w.client.applyExternalForce(w.crane.body, link, [0.0, 200.0, 0.0], at, w.client.WORLD_FRAME)
        step()
    angles = []
    for _ in range(round(8.0 / STEP_S)):
        step()
        angles.append(w.q["hanger"] + w.q["lift"] + w.q["tilt"] + w.q["flex_pitch"])
    turns = [(i, b) for i, (a, b, c) in enumerate(zip(angles, angles[1:], angles[2:], strict=False)) if a < b >= c]
    turns = [t for t in turns if t[1] > 0.004]
    (i, first), (j, last), n = turns[0], turns[-1], len(turns) - 1
    decrement = math.log(first / last) / n
    return (j - i) * STEP_S / n, decrement / math.hypot(2 * math.pi, decrement)


def test_the_empty_grapple_swings_with_the_period_and_damping_of_its_mass():
    w = make()
    period, zeta = pendulum(w)
    seen = swing(w, lambda: w.step([0.0] * len(w.functions)))
    assert seen[0] == pytest.approx(period, rel=0.10) and 1.3 < period < 1.9
    assert seen[1] == pytest.approx(zeta, rel=0.25)
    w.close()


@pytest.mark.long
def test_a_held_log_lengthens_the_pendulum():
    scene = random_scene(PROFILE, NOMINAL.wood, 403, 1)
    w = World(PROFILE, NOMINAL, 403, scene)
    driver = Driver(w)
    log = w.log_bodies.states()[0]
    driver.pick(*log.position_m[:2], math.atan2(log.axis[1], log.axis[0]))
    driver.move({"slew": 0.0})
    driver.wait(4.0)
    period, _ = pendulum(w, 0)
    seen, _ = swing(w, lambda: driver.tick({}))
    assert seen == pytest.approx(period, rel=0.10) and period > 1.5
    w.close()
