"""The hydraulics on the real linkage: the crane holds, rings after a stop, follows the profile's speeds, grips."""

from __future__ import annotations

import math

import pytest

from machine.loading.profile_file import load_profile
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


def test_a_stretched_crane_stands_still_with_neutral_valves(crane):
    w = crane(lift=0.1, tilt=-0.2, ext=1.6)
    run(w, 4.0)
    joints = [w.q[j] for j in ("slew", "lift", "tilt", "ext")]
    run(w, 6.0)
    assert all(abs(w.q[j] - q) < 1e-3 for j, q in zip(("slew", "lift", "tilt", "ext"), joints, strict=True))


def test_a_boom_stop_rings_and_decays(crane):
    w = crane(lift=0.2, tilt=-0.3, ext=1.2)
    run(w, 1.5, lift=0.6)
    heights = [p[2] for p in run(w, 4.0)]
    early, late = heights[120:520], heights[-280:]
    turns = sum((b - a) * (c - b) < 0.0 for a, b, c in zip(early, early[1:], early[2:], strict=False))
    assert max(early) - min(early) > 0.02 and turns >= 2
    assert max(late) - min(late) < 0.35 * (max(early) - min(early))


def test_an_extended_crane_needs_more_holding_pressure(crane):
    near, far = crane(lift=0.3, tilt=-1.5), crane(lift=0.3, tilt=-0.3, ext=1.5)
    assert far.hydraulics.pressures_pa["lift"][0] > near.hydraulics.pressures_pa["lift"][0] + 1e6


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
