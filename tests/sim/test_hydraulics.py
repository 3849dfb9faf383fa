"""Hydraulic behaviour of the crane: speeds, holding, ringing, pressures, and safe lowering."""

from __future__ import annotations

import math
import random

import pytest

from machine.load import load_profile
from sim.truth import load_truth
from sim.world import HOME, STEP_S, Spools, World

PROFILE = load_profile("palms_471")
NOMINAL = load_truth("nominal", 0)


def make(home=None):
    return World(PROFILE, NOMINAL, seed=0, logs=1, home=HOME | (home or {}))


def run(w: World, seconds: float, **spools: float) -> list[tuple[float, ...]]:
    """Hanger pin at every step."""
    s, path = Spools(**spools), []
    for _ in range(round(seconds / STEP_S)):
        w.step(s)
        path.append(w.tip())
    return path


@pytest.mark.parametrize(
    ("joint", "home"), [("slew", {}), ("lift", {"lift": 0.5}), ("tilt", {"tilt": -1.2}), ("ext", {"ext": 0.9})]
)
@pytest.mark.parametrize("sign", [1, -1])
def test_half_command_gives_the_speed_the_profile_expects(joint, home, sign):
    w = make(home)
    valve = PROFILE.joints[joint].valve
    run(w, 0.8, **{joint: 0.56 * sign})
    before = w.q[joint]
    run(w, 0.8, **{joint: 0.56 * sign})
    full = valve.full_speed_plus if sign > 0 else valve.full_speed_minus
    assert (w.q[joint] - before) / 0.8 == pytest.approx(sign * 0.5 * full, rel=0.2)
    w.close()


def test_a_command_inside_the_dead_band_moves_nothing():
    w = make()
    before = w.tip()
    run(w, 1.0, slew=0.1, lift=0.1, tilt=-0.1, ext=0.1, rot=0.08)
    assert math.dist(before, w.tip()) < 2e-3
    w.close()


def test_a_neutral_valve_holds_the_stretched_crane():
    w = make({"lift": 0.1, "tilt": -0.2, "ext": 1.6})
    run(w, 1.0)
    before = w.tip()
    run(w, 2.0)
    assert math.dist(before, w.tip()) / 2.0 < 2e-3
    w.close()


def test_a_boom_stop_rings_and_decays():
    w = make({"lift": 0.2, "tilt": -0.3, "ext": 1.2})
    run(w, 1.5, lift=0.6)
    heights = [p[2] for p in run(w, 3.0)]
    early, late = heights[120:400], heights[-280:]
    turns = sum((b - a) * (c - b) < 0.0 for a, b, c in zip(early, early[1:], early[2:], strict=False))
    assert max(early) - min(early) > 0.02 and turns >= 2
    assert max(late) - min(late) < 0.25 * (max(early) - min(early))
    w.close()


def test_pressures_are_never_negative_and_never_beyond_the_shock_limit():
    w = make()
    rng = random.Random(3)
    limit = 1.25 * NOMINAL.supply.relief_pa
    for _ in range(12):
        s = Spools(*(rng.choice((-1.0, 0.0, 1.0)) for _ in range(6)))
        for _ in range(round(0.5 / STEP_S)):
            w.step(s)
            for a in w.hydraulics.actuators:
                assert 0.0 <= a.pressure_a <= limit and 0.0 <= a.pressure_b <= limit
    assert all(math.isfinite(v) for v in w.q.values())
    w.close()


def test_lowering_at_full_command_keeps_valve_speed_and_stops():
    w = make({"lift": 0.9, "tilt": -0.3, "ext": 1.2})
    run(w, 1.0, lift=-1.0)
    for _ in range(400):
        w.step(Spools(lift=-1.0))
        assert w.qd["lift"] > -1.3 * PROFILE.joints["lift"].valve.full_speed_minus
    run(w, 1.0)
    assert abs(w.qd["lift"]) < 0.02
    w.close()


def test_a_reaching_crane_needs_more_holding_pressure():
    near, far = make({"lift": 0.3, "tilt": -1.5}), make({"lift": 0.3, "tilt": -0.3, "ext": 1.5})
    lift_near, lift_far = (w.hydraulics.actuators[1].pressure_a for w in (near, far))
    assert lift_far > lift_near + 1e6
    near.close()
    far.close()


def test_the_shared_pump_limits_combined_motion():
    w = make()
    run(w, 0.6, slew=1.0, lift=1.0, tilt=1.0, ext=1.0)
    assert w.hydraulics.flow_limited
    assert abs(w.qd["tilt"]) < 0.85 * PROFILE.joints["tilt"].valve.full_speed_plus
    assert w.hydraulics.energy_j > 0.0
    w.close()


def test_the_empty_grapple_closes_shows_its_pressure_and_stays_closed():
    w = make()
    run(w, 1.0, grapple=-1.0)
    assert w.grapple_pressures_pa[0] < 3e6
    run(w, 4.0, grapple=-1.0)
    assert w.opening < 0.01 and w.grapple_pressures_pa[0] > 1.5e7
    run(w, 1.0)
    assert w.opening < 0.01
    run(w, 5.0, grapple=1.0)
    assert w.opening > 0.99
    w.close()
