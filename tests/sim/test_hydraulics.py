"""Hydraulics against closed forms: pressures, stiffness, speeds, shared flow, holding, valves, energy."""

from __future__ import annotations

import math
import random
from itertools import pairwise

import msgspec
import numpy as np
import pytest

from experiments.common.pool import Job
from experiments.plant import runs
from sim.errors import PlantError
from sim.hydraulics import layout
from sim.hydraulics.circuit import REST_PA, Hydraulics
from sim.hydraulics.kernel import friction, move_spool
from tests.codes import coded
from tests.sim.oil_rig import AORO, AORO_HEAVY, FRICTIONLESS, PALMS, STEP_S, Rig

HEAVY = {"slew": 5000.0, "lift": 8000.0, "tilt": 1500.0, "ext": 200.0, "rot": 6.0, "grapple": 7.2}
EVERY = [(PALMS, n, i) for n, i in HEAVY.items()] + [(AORO, n, i) for n, i in AORO_HEAVY.items()]
NAMES = [f"{t.machine}-{n}" for t, n, _ in EVERY]
STOPPED = [function for function in EVERY if not function[0].functions[function[1]].cylinder.endless]


def test_pressure_times_area_balances_a_load_at_rest():
    rig = Rig(PALMS, {"lift": 8000.0}, {"lift": -20000.0})
    rig.run(5.0)
    c = rig.truth.functions["lift"].cylinder
    a, b = rig.oil.pressures_pa["lift"]
    assert a * c.area_a - b * c.area_b == pytest.approx(20000.0 / c.arm_nominal, rel=1e-3)
    assert b == pytest.approx(REST_PA, rel=0.02)


@pytest.mark.parametrize(("truth", "name", "inertia"), EVERY, ids=NAMES)
def test_the_oil_spring_rings_at_the_frequency_of_bulk_modulus_and_volumes(truth, name, inertia):
    rig = Rig(truth, {name: inertia}, cylinder=FRICTIONLESS | {"relaxation_1_s": 0.0})
    c = rig.truth.functions[name].cylinder
    half = c.dead_volume_m3 + abs(c.arm_nominal) * (c.arm_at[1] - c.arm_at[0]) / 2 * np.array([c.area_a, c.area_b])
    spring = c.arm_nominal**2 * truth.supply.bulk_modulus_pa * np.sum(np.array([c.area_a, c.area_b]) ** 2 / half)
    # Gently, so that no chamber becomes empty.
    rig.qd[name] = speed = 0.2 * REST_PA * c.area_b * abs(c.arm_nominal) / math.sqrt(spring * inertia)
    rest, crossings, before = rig.q[name], [], 0.0
    for k in range(round(60 / math.sqrt(spring / inertia) / STEP_S)):
        rig.step()
        away = rig.q[name] - rest
        if before < 0.0 <= away:
            crossings.append(STEP_S * (k - away / (away - before)))
        before = away
    periods = [b - a for a, b in pairwise(crossings)]
    assert len(periods) > 4
    assert np.mean(periods[:4]) == pytest.approx(2 * math.pi / math.sqrt(spring / inertia), rel=0.05)
    assert abs(rig.qd[name]) < 1.05 * speed  # no energy from nowhere


def test_the_oil_spring_of_the_lift_cylinder_follows_its_lever_arm():
    """w^2 = beta r^2 (AA^2 / VA + AB^2 / VB) / I at 0.4 rad, I = 4000 kg m^2."""
    seen = runs.cylinder(Job("cylinder", "cylinder", 1, {"profile": "palms_471", "truth": "nominal"}))["metrics"]
    c = PALMS.functions["lift"].cylinder
    grid = np.linspace(c.arm_at[0], c.arm_at[-1], 2001)
    arms = np.interp(grid, c.arm_at, c.arm)
    steps = (arms[1:] + arms[:-1]) / 2.0 * np.diff(grid)
    travel = float(steps[grid[1:] <= 0.4].sum())
    volume_a, volume_b = c.dead_volume_m3 + np.array([c.area_a * travel, c.area_b * (float(steps.sum()) - travel)])
    stiffness = PALMS.supply.bulk_modulus_pa * (c.area_a**2 / volume_a + c.area_b**2 / volume_b)
    hz = math.sqrt(stiffness / 4000.0) * float(np.interp(0.4, c.arm_at, c.arm)) / (2.0 * math.pi)
    assert seen["cylinder_hz"] == pytest.approx(hz, rel=0.02)


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize(("truth", "name", "inertia"), EVERY, ids=NAMES)
def test_full_and_half_opening_give_the_speed_of_the_valve(truth, name, inertia, sign):
    turn = math.copysign(1.0, truth.functions[name].cylinder.arm_nominal) * sign
    ends = truth.functions[name].cylinder.arm_at
    for opening in (1.0, 0.5):
        rig = Rig(truth, {name: inertia}, q={name: ends[0] + 0.05 if turn > 0 else ends[-1] - 0.05})
        v = rig.truth.functions[name].valve
        band, full = (v.deadband_plus, v.full_speed_plus) if sign > 0 else (v.deadband_minus, v.full_speed_minus)
        share = opening if opening == 1.0 else opening ** (1 / v.exponent)
        command = 1.0 if opening == 1.0 else band + v.hysteresis / 2 + (1.0 - band - v.hysteresis / 2) * share
        rig.run(0.6 * (ends[-1] - ends[0]) / full, **{name: sign * command})
        mean = 0.0
        for _ in range(160):
            rig.step(**{name: sign * command})
            mean += rig.qd[name] / 160
        assert mean == pytest.approx(turn * opening * full, rel=0.08)


def busy(sharing: str, load: float) -> tuple[Rig, dict[str, float]]:
    """Speed over full speed of lift (loaded) and tilt with all four large functions at full command."""
    rig = Rig(
        PALMS, {n: HEAVY[n] for n in ("slew", "lift", "tilt", "ext")}, {"lift": -load}, supply={"sharing": sharing}
    )
    rig.run(1.2, slew=1.0, lift=1.0, tilt=1.0, ext=1.0)
    start = dict(rig.q)
    rig.run(0.8, slew=1.0, lift=1.0, tilt=1.0, ext=1.0)
    full = {n: f.valve.full_speed_plus for n, f in rig.truth.functions.items()}
    return rig, {n: (rig.q[n] - start[n]) / 0.8 / full[n] for n in rig.q}


def test_functions_slow_each_other_when_the_pump_is_the_limit():
    for sharing in ("pre_compensated", "post_compensated"):
        rig, speeds = busy(sharing, 25000.0)
        flow = sum(
            speeds[n] * f.valve.full_speed_plus * f.cylinder.arm_nominal * f.cylinder.area_a
            for n, f in rig.truth.functions.items()
        )
        assert rig.oil.flow_limited and flow == pytest.approx(PALMS.supply.pump_flow_m3_s, rel=0.06)
        assert min(speeds.values()) < 0.8


def test_the_heaviest_load_stops_first_unless_the_valve_shares_the_flow():
    _, starving = busy("pre_compensated", 25000.0)
    _, sharing = busy("post_compensated", 25000.0)
    assert starving["lift"] < 0.02 and min(starving[n] for n in ("slew", "tilt", "ext")) > 0.3
    assert max(sharing.values()) - min(sharing.values()) < 0.1 and 0.4 < sharing["lift"] < 0.6


def test_crane_and_steering_share_one_pump():
    alone, shared = Rig(AORO, AORO_HEAVY), Rig(AORO, AORO_HEAVY)
    alone.run(1.5, steer=1.0)
    shared.run(1.5, steer=1.0, slew=1.0, lift=1.0, tilt=1.0, ext=1.0)
    assert not alone.oil.flow_limited and shared.oil.flow_limited
    assert shared.q["steer"] < 0.7 * alone.q["steer"]


def test_a_heavy_load_is_lowered_at_valve_speed_and_stops():
    rig = Rig(PALMS, {"lift": 12000.0}, {"lift": -40000.0}, q={"lift": 1.0})
    rig.run(0.8, lift=-1.0)
    full = PALMS.functions["lift"].valve.full_speed_minus
    for _ in range(500):
        rig.step(lift=-1.0)
        assert -1.6 * full < rig.qd["lift"]
    start = rig.q["lift"]
    rig.run(1.0, lift=-1.0)
    assert rig.q["lift"] - start == pytest.approx(-full * layout.METER_OUT_FACTOR, rel=0.05)
    rig.run(3.0)
    assert abs(rig.qd["lift"]) < 1e-3


def test_a_neutral_valve_holds_the_load():
    rig = Rig(PALMS, {"lift": 8000.0}, {"lift": -25000.0})
    rig.run(2.0)
    start = rig.q["lift"]
    rig.run(60.0)
    tip_m = 6.0 * abs(rig.q["lift"] - start)
    assert tip_m < 1e-3


def test_nothing_moves_before_the_dead_time():
    rig = Rig(PALMS, {"slew": 5000.0}, valve={"delay_s": 0.1})
    steps = 0
    while rig.oil.spools["slew"] == 0.0:
        rig.step(slew=1.0)
        steps += 1
    assert steps - 1 == round(0.1 / STEP_S)


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("name", list(HEAVY))
def test_only_a_command_beyond_the_dead_band_moves(name, sign):
    v = PALMS.functions[name].valve
    edge = (v.deadband_plus if sign > 0 else v.deadband_minus) + v.hysteresis / 2
    inside, outside = Rig(PALMS, {name: HEAVY[name]}), Rig(PALMS, {name: HEAVY[name]})
    start = inside.q[name]
    inside.run(2.0, **{name: sign * (edge - 0.01)})
    outside.run(2.0, **{name: sign * (edge + 0.03)})
    assert abs(inside.q[name] - start) < 1e-4
    assert abs(outside.q[name] - start) > 5e-3


def test_the_spool_lags_by_its_hysteresis():
    constants, _ = layout.functions(PALMS, STEP_S)
    states = np.zeros(len(constants), layout.STATE)
    c, s = np.rec.array(constants)[0], np.rec.array(states)[0]
    opening = {}
    for way, start, end in (("up", 0.0, 0.5), ("top", 0.5, 1.1), ("down", 1.1, 0.5)):
        for command in np.linspace(start, end, 4000):
            move_spool(c, s, command, 1e-3)
        for _ in range(1000):
            move_spool(c, s, end, 1e-3)
        opening[way] = s.opening
    linear = {way: y ** (1 / c.exponent) for way, y in opening.items()}
    slope = 1.0 / (1.0 - c.deadband_plus - c.half_play)
    assert opening["top"] == pytest.approx(1.0)
    assert linear["down"] - linear["up"] == pytest.approx(2 * c.half_play * slope, rel=0.01)


def test_friction_sticks_then_falls_then_grows():
    c = np.rec.array(layout.functions(PALMS, STEP_S)[0])[3]
    at = {share: friction(c, share * c.stribeck_speed)[0] for share in (0.0, 1.0, 4.0, 400.0)}
    assert at[0.0] == 0.0 and at[1.0] > c.coulomb
    assert at[4.0] < at[1.0] < at[400.0]
    assert friction(c, -0.3)[0] == -friction(c, 0.3)[0]
    step = 1e-4 * c.stribeck_speed
    assert friction(c, 0.0)[1] == pytest.approx((friction(c, step)[0] - friction(c, 0.0)[0]) / step, rel=0.01)


def test_the_grapple_squeezes_to_its_limit_locks_and_opens_with_more():
    rig = Rig(PALMS, {"grapple": 7.2}, stops={"grapple": (0.0, 0.9)}, q={"grapple": 0.4})
    v = rig.truth.functions["grapple"].valve
    rig.run(2.0, grapple=-1.0)
    squeeze = rig.torque["grapple"]
    assert rig.oil.pressures_pa["grapple"][1] == pytest.approx(v.limit_minus_pa, rel=0.02) and squeeze > 3500.0
    rig.run(1.0)
    held = rig.torque["grapple"]
    rig.run(20.0)
    assert rig.torque["grapple"] == pytest.approx(held, rel=0.01) and held > 0.9 * squeeze
    rig.stops["grapple"] = (0.9, 0.9)  # a thick log is wedged between the jaws
    rig.run(2.0, grapple=1.0)
    assert -rig.torque["grapple"] > 1.1 * squeeze
    del rig.stops["grapple"]
    rig.run(1.0, grapple=1.0)
    assert rig.q["grapple"] < 0.5


def test_a_weak_pump_does_not_unlock_the_grapple():
    rig = Rig(PALMS, {"grapple": 7.2}, stops={"grapple": (0.0, 0.9)}, q={"grapple": 0.4})
    rig.run(2.0, grapple=-1.0)
    rig.run(1.0)
    held = rig.oil.pressures_pa["grapple"][1]
    rig.oil = _with_pressures_of(rig, {"relief_pa": 3.0e6})
    rig.run(2.0, grapple=1.0)
    assert rig.oil.pressures_pa["grapple"][1] > 0.9 * held > 3.5 * 3.0e6


def _with_pressures_of(rig: Rig, supply: dict[str, float]) -> Hydraulics:
    """The same grapple, squeezing as now, on another pump."""
    truth = msgspec.structs.replace(rig.truth, supply=msgspec.structs.replace(rig.truth.supply, **supply))
    oil = Hydraulics(truth, STEP_S)
    oil.hold([rig.torque["grapple"]], [rig.q["grapple"]])
    return oil


def test_a_crash_makes_no_chamber_pressure_negative():
    oil = Hydraulics(PALMS, STEP_S)
    q = [sum(f.cylinder.arm_at[:: len(f.cylinder.arm_at) - 1]) / 2 for f in PALMS.functions.values()]
    oil.hold([0.0] * 6, q)
    for k in range(40):
        speed = 8.0 if k % 4 < 2 else -8.0
        q = [x + STEP_S * speed for x in q]
        oil.step([1.0] * 6, q, [speed] * 6)
        assert all(math.isfinite(p) and p >= 0.0 for pair in oil.pressures_pa.values() for p in pair)


@pytest.mark.parametrize("factor", [0.9, 3.0, 10.0])
def test_light_joints_stay_calm_with_any_inertia(factor):
    inertias = {"rot": factor * 4.0, "grapple": factor * 7.0}
    rig = Rig(PALMS, inertias, stops={"grapple": (0.0, 1.2)}, q={"grapple": 0.6})
    rng, loudest = random.Random(5), 0.0
    for _ in range(40):
        commands = {n: rng.choice((-1.0, 0.0, 1.0)) for n in inertias}
        rig.run(0.2, **commands)
        loudest = max(loudest, *(abs(v) for v in rig.qd.values()))
    rig.run(6.0)
    assert loudest < 6.0 and all(abs(v) < 1e-3 for v in rig.qd.values())


@pytest.mark.parametrize(("truth", "inertias"), [(PALMS, HEAVY), (AORO, AORO_HEAVY)], ids=["palms", "aoro"])
def test_pressures_stay_physical_and_energy_is_conserved(truth, inertias):
    stops = {n: (f.cylinder.arm_at[0], f.cylinder.arm_at[-1]) for n, f in truth.functions.items()}
    rig = Rig(truth, inertias, {"lift": -20000.0}, stops=stops)
    rng, start = random.Random(3), rig.oil.stored_j
    worked = lost = 0.0
    for _ in range(200):
        commands = {n: rng.choice((-1.0, -0.4, 0.0, 0.4, 1.0)) for n in inertias}
        for _ in range(20):
            before = dict(rig.q)
            rig.step(**commands)
            worked += sum(rig.torque[n] * (rig.q[n] - before[n]) for n in inertias)
        for a, b in rig.oil.pressures_pa.values():
            assert min(a, b) >= 0.0 and max(a, b) < truth.supply.shock_pa + 2e6
        assert 0.0 <= rig.oil.supply_pa <= truth.supply.relief_pa
        assert rig.oil.loss_j >= lost
        lost = rig.oil.loss_j
    oil = rig.oil
    # The counter adds the last step's work with the next state.
    assert oil.energy_out_j == pytest.approx(worked, abs=0.01 * oil.energy_j)
    missing = oil.energy_j - oil.energy_out_j - oil.loss_j - (oil.stored_j - start)
    assert oil.energy_j > 1e4 and abs(missing) < 0.02 * oil.energy_j
    assert oil.peak_pa >= max(max(p) for p in oil.pressures_pa.values())


def test_a_float_valve_lets_the_arms_of_an_axle_swing_against_each_other():
    arms = dict.fromkeys(("arm_fl", "arm_fr", "arm_rl", "arm_rr"), 2500.0)
    even_load = dict.fromkeys(arms, -25000.0)
    rig = Rig(AORO, arms, even_load, stops=dict.fromkeys(arms, (-0.15, 0.47)))
    start = dict(rig.q)
    rig.load |= {"arm_fl": -28000.0, "arm_fr": -22000.0}
    rig.run(1.0)
    assert abs(rig.q["arm_fl"] - start["arm_fl"]) < 0.02
    rig.oil.float_front = True
    rig.run(1.0)
    left, right = (rig.q[n] - start[n] for n in ("arm_fl", "arm_fr"))
    assert left < -0.05 and left == pytest.approx(-right, rel=0.1)
    assert abs(rig.q["arm_rl"] - start["arm_rl"]) < 1e-3


def test_both_axles_never_float_and_a_machine_without_arms_cannot():
    oil = Hydraulics(AORO, STEP_S)
    oil.float_rear = True
    with pytest.raises(PlantError, check=coded("hydraulics.other-axle-floats")):
        oil.float_front = True
    oil.float_rear = False
    oil.float_front = True
    assert oil.float_front and not oil.float_rear
    with pytest.raises(PlantError, check=coded("hydraulics.no-swing-arms")):
        Hydraulics(PALMS, STEP_S).float_front = True


def test_substeps_do_not_change_the_motion():
    coarse, fine = Rig(PALMS, HEAVY), Rig(PALMS, HEAVY)
    fine.oil = Hydraulics(fine.truth, STEP_S, substeps=32)
    fine.oil.hold([0.0] * len(HEAVY), list(fine.q.values()))
    for rig in (coarse, fine):
        rig.run(1.0, slew=0.6, lift=0.5, tilt=-0.5, ext=0.7, rot=1.0, grapple=-0.8)
    for n in HEAVY:
        assert coarse.q[n] == pytest.approx(fine.q[n], abs=5e-3)


def test_a_pump_with_no_flow_moves_nothing_against_a_load():
    rig = Rig(PALMS, {"lift": 8000.0}, {"lift": -20000.0}, supply={"pump_flow_m3_s": 1e-9})
    start = rig.q["lift"]
    rig.run(2.0, lift=1.0)
    # The unloaded side drains, and the load settles a hair higher.
    assert abs(rig.q["lift"] - start) < 5e-3 and rig.oil.flow_limited


@pytest.mark.parametrize(("truth", "name", "inertia"), STOPPED, ids=[f"{t.machine}-{n}" for t, n, _ in STOPPED])
def test_the_end_stops_hold_full_pressure_before_the_hard_ones(truth, name, inertia):
    rig = Rig(truth, {name: inertia})
    low, high = rig.truth.functions[name].cylinder.arm_at
    for end, sign in ((high, 1.0), (low, -1.0)):
        command = math.copysign(sign, sign * rig.truth.functions[name].cylinder.arm_nominal)
        rig.q[name] = end - sign * 0.05
        rig.oil.hold([0.0], [rig.q[name]])
        rig.run(5.0, **{name: command})
        rest = rig.q[name]
        assert low < rest < high and abs(end - rest) < 0.021
        rig.run(1.0, **{name: command})
        assert abs(rig.q[name] - rest) < 1e-3 and abs(rig.qd[name]) < 1e-3
