"""The hydraulics on the real linkage: the crane holds, follows the profile's speeds, grips."""

from __future__ import annotations

import math

import numpy as np
import pytest

from experiments.common.worlds import hang, home_at, step_neutral
from machine.loading.profile_file import load_profile
from sim.bullet.client import GRAVITY_M_S2
from sim.kinematic import KinematicWorld
from sim.nodes.valve import FUNCTIONS
from sim.truth.load import load_truth
from sim.world import STEP_S, World, home_pose

PROFILE = load_profile("palms_471")
NOMINAL = load_truth("nominal", 0, "palms_471")


@pytest.fixture
def crane():
    worlds = []

    def make(**home: float) -> World:
        worlds.append(World(PROFILE, NOMINAL, 0, (), home=home_pose(PROFILE) | home))
        return worlds[-1]

    yield make
    for w in worlds:
        w.close()


def run(w: World, seconds: float, **commands: float) -> list[tuple[float, float, float]]:
    """Hanger pin at every step."""
    path = []
    for _ in range(round(seconds / STEP_S)):
        w.step([commands.get(n, 0.0) for n in w.functions])
        path.append(w.tip())
    return path


@pytest.mark.parametrize(
    ("joint", "home"),
    [("slew", {}), ("lift", {"lift": 0.5}), ("tilt", {"tilt": -1.2}), ("ext", {"ext": 0.9}), ("rot", {})],
)
@pytest.mark.parametrize("sign", [1, -1])
def test_half_command_gives_the_speed_of_the_profile(crane, joint, home, sign):
    w, valve = crane(**home), PROFILE.joints[joint].valve
    run(w, 0.8, **{joint: 0.56 * sign})
    before = w.q[joint]
    run(w, 0.8, **{joint: 0.56 * sign})
    full = valve.full_speed_plus if sign > 0 else valve.full_speed_minus
    assert (w.q[joint] - before) / 0.8 == pytest.approx(sign * 0.5 * full, rel=0.2)


def test_the_endless_rotator_turns_on_and_the_one_with_hoses_stops():
    forwarder, turns = load_profile("aoro_fc8"), {}
    worlds = {name: PROFILE if name == "palms_471" else forwarder for name in ("palms_471", "aoro_fc8")}
    for name, profile in worlds.items():
        w = World(profile, load_truth("nominal", 0, name), 0, (), home=home_pose(profile) | {"rot": 3.0})
        run(w, 12.0, rot=1.0)
        turns[name] = w.q["rot"] / math.tau
        w.close()
    assert turns["palms_471"] < 0.51
    assert turns["aoro_fc8"] > 3.5
    kinematic = KinematicWorld(forwarder, load_truth("nominal", 0, "aoro_fc8"), 5_000_000)
    for _ in range(1000):
        kinematic.step([1.0 if name == "rot" else 0.0 for name in FUNCTIONS] + [0.0] * 5)
    assert kinematic.q["rot"] > math.tau + 1.0


def test_a_stretched_crane_stands_still_with_neutral_valves(crane):
    w = crane(lift=0.1, tilt=-0.2, ext=1.6)
    run(w, 4.0)
    joints = [w.q[j] for j in ("slew", "lift", "tilt", "ext")]
    run(w, 6.0)
    assert all(abs(w.q[j] - q) < 1e-3 for j, q in zip(("slew", "lift", "tilt", "ext"), joints, strict=True))


def test_an_extended_crane_needs_more_holding_pressure(crane):
    near, far = crane(lift=0.3, tilt=-1.5), crane(lift=0.3, tilt=-0.3, ext=1.5)
    assert far.hydraulics.pressures_pa["lift"][0] > near.hydraulics.pressures_pa["lift"][0] + 1e6


@pytest.mark.parametrize("kg", [0.0, 250.0])
def test_the_lift_cylinder_carries_what_statics_demand(crane, kg):
    """pA AA - pB AB = moment of all that hangs beyond the boom's pin / lever arm; no chamber is empty."""
    w = crane(**home_at("palms_471", 6.0, 1.2))
    p, body, link = w.client, w.crane.body, w.crane.link
    for part in range(1, 251):
        hang(w, kg * part / 250)
        step_neutral(w, 10)
    run(w, 3.0)
    lift = w.truth.functions["lift"].cylinder
    pin = w.link_poses()["boom"][0]
    ahead = np.subtract(w.link_poses()["hanger"][0], w.base_pose()[0])[:2]
    ahead /= np.hypot(*ahead)
    moment = 0.0
    for name in ("boom", "stick", "telescope", "hanger", "fork", "rotator", "tong_left", "tong_right"):
        com = p.getLinkState(body, link[name], computeForwardKinematics=1)[0]
        moment += p.getDynamicsInfo(body, link[name])[0] * GRAVITY_M_S2 * float(np.subtract(com, pin)[:2] @ ahead)
    a, b = w.hydraulics.pressures_pa["lift"]
    assert a * lift.area_a - b * lift.area_b == pytest.approx(
        moment / np.interp(w.q["lift"], lift.arm_at, lift.arm), rel=0.05
    )
    assert min(min(pair) for pair in w.hydraulics.pressures_pa.values()) > 0.0


def test_the_empty_grapple_closes_with_pressure_stays_closed_and_opens(crane):
    w = crane()
    run(w, 1.0, grapple=-1.0)
    assert w.hydraulics.pressures_pa["grapple"][1] < 3e6
    run(w, 4.0, grapple=-1.0)
    assert w.opening < 0.01 and w.hydraulics.pressures_pa["grapple"][1] > 1.5e7
    run(w, 1.0)
    assert w.opening < 0.01 and w.hydraulics.pressures_pa["grapple"][1] > 1.4e7
    quiet = max(abs(w.qd["tong_left"]), abs(w.qd["ext"]))
    assert quiet < 0.02
    run(w, 5.0, grapple=1.0)
    assert w.opening > 0.99 and math.isfinite(w.q["ext"])
