"""The ground truth: complete files, bounded individuals, the same individual for the same seed."""

from __future__ import annotations

import math
import re
import statistics
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import sim.truth
from machine.loading.profile_file import load_profile
from sim.errors import PlantError
from sim.individual import another_for_every_seed, beside
from sim.truth.load import FILES, load_truth
from tests.codes import coded

MACHINES = ("palms_471", "aoro_fc8")
SEEDS = st.integers(0, 2**31)
machines = pytest.mark.parametrize("machine", MACHINES)


def ratios(one, other) -> dict[str, float]:
    """The ratios one / other, field by field; zeros and fields that are not numbers are left out."""
    fields = {f: (getattr(one, f), getattr(other, f)) for f in one.__struct_fields__}
    return {f: a / b for f, (a, b) in fields.items() if isinstance(a, float) and b}


@machines
def test_the_truth_has_the_profiles_joints(machine):
    truth, profile = load_truth("nominal", 0, machine), load_profile(machine)
    assert truth.machine == machine and list(truth.functions)[:6] == [*profile.joints, "grapple"]
    assert (truth.carrier is None) == (profile.carrier is None) == (len(truth.functions) == 6)
    encoders = {n for n, j in profile.joints.items() if j.encoder} | ({"articulation"} if profile.carrier else set())
    assert set(truth.encoders) == encoders and set(truth.cameras) == set(profile.cameras)
    for name, joint in profile.joints.items():
        f = truth.functions[name]
        assert f.cylinder.arm_at[0] < joint.lower and f.cylinder.arm_at[-1] > joint.upper
        assert f.valve.full_speed_plus == pytest.approx(joint.valve.full_speed_plus, rel=0.05)
        assert f.valve.full_speed_minus == pytest.approx(joint.valve.full_speed_minus, rel=0.05)
        assert 100 * f.valve.deadband_plus == pytest.approx(joint.valve.deadband_plus_pct, abs=1.0)
        assert f.valve != joint.valve


@machines
@settings(max_examples=40, deadline=None)
@given(seed=SEEDS)
def test_every_individual_lies_within_the_bounds(machine, seed):
    nominal, one = load_truth("nominal", 0, machine), load_truth("sampled", seed, machine)
    s = nominal.spread
    for name, link in one.links.items():
        factor = link.mass_kg / nominal.links[name].mass_kg
        assert abs(factor - 1.0) <= s.mass + 1e-9 <= 0.15 + 1e-9
        assert link.inertia_kg_m2 == pytest.approx([factor * i for i in nominal.links[name].inertia_kg_m2])
    for name, function in one.functions.items():
        v, ratio = function.valve, ratios(function.valve, nominal.functions[name].valve)
        assert 0.040 <= v.delay_s <= 0.150
        assert all(abs(ratio[k] - 1.0) <= 0.20 + 1e-9 for k in ratio if k.startswith(("full_speed", "deadband")))
        assert 0.008 <= v.hysteresis <= 0.04
        c, ratio = function.cylinder, ratios(function.cylinder, nominal.functions[name].cylinder)
        assert all(abs(ratio[k] - 1.0) <= 0.30 + 1e-9 for k in ("coulomb", "stiction", "viscous"))
        assert c.stiction > c.coulomb and ratio["area_a"] == ratio["dead_volume_m3"] == 1.0
    supply = ratios(one.supply, nominal.supply)
    assert abs(supply["pump_flow_m3_s"] - 1.0) <= 0.10 + 1e-9
    assert 0.7e9 <= one.supply.bulk_modulus_pa <= 1.0e9
    structure = ratios(one.structure, nominal.structure)
    assert all(abs(structure[k] - 1.0) <= 0.20 + 1e-9 for k in ("flex_pitch_nm_rad", "flex_roll_nm_rad"))
    for name, encoder in one.encoders.items():
        assert abs(encoder.offset) <= s.offset + 1e-12 and 0.0 <= encoder.phase_rad <= 2 * math.pi
        assert 0.0 <= encoder.eccentricity <= 1.5 * nominal.encoders[name].eccentricity


@machines
@settings(max_examples=20, deadline=None)
@given(seed=SEEDS)
def test_the_same_seed_makes_the_same_individual(machine, seed):
    one = load_truth("sampled", seed, machine)
    assert one == load_truth("sampled", seed, machine) != load_truth("sampled", seed + 1, machine)
    assert load_truth("nominal", seed, machine) == load_truth("nominal", 0, machine) != one


def test_individuals_differ_and_average_near_the_nominal_machine():
    many = [load_truth("sampled", seed, "palms_471").functions["lift"] for seed in range(200)]
    nominal = load_truth("nominal", 0, "palms_471").functions["lift"]
    speeds = [f.valve.full_speed_plus / nominal.valve.full_speed_plus for f in many]
    assert statistics.fmean(speeds) == pytest.approx(1.0, abs=0.03) and statistics.stdev(speeds) > 0.06
    delays = [f.valve.delay_s for f in many]
    assert 0.075 < statistics.fmean(delays) < 0.10 and min(delays) < 0.055 and max(delays) > 0.125


def test_parts_draw_independently():
    one, nominal = load_truth("sampled", 3, "palms_471"), load_truth("nominal", 0, "palms_471")
    speeds = [f.valve.full_speed_plus / nominal.functions[n].valve.full_speed_plus for n, f in one.functions.items()]
    assert len({round(s, 9) for s in speeds}) == len(speeds)


@pytest.fixture
def own(tmp_path):
    """The truth file of a user."""
    path = tmp_path / "mine.toml"
    text = Path(sim.truth.__file__).with_name("nominal.toml").read_text()
    path.write_text(text.replace("relief_pa = 19.0e6", "relief_pa = 18.0e6"))
    return path


def test_a_users_truth_file_is_read_and_a_bad_one_refused(own, tmp_path):
    mine = load_truth(str(own), 0, "palms_471")
    assert mine.supply.relief_pa == 18.0e6
    assert mine.functions == load_truth("nominal", 0, "palms_471").functions
    with pytest.raises(PlantError, check=coded("truth.other-machine")):
        load_truth(str(own), 0, "aoro_fc8")
    own.write_text(own.read_text().replace("relief_pa", "relieve_pa"))
    with pytest.raises(PlantError, check=coded("truth.unreadable")) as refused:
        load_truth(str(own), 0, "palms_471")
    assert "mine.toml" in str(refused.value) and "relie" in str(refused.value)
    with pytest.raises(PlantError, check=coded("truth.unknown-machine")):
        load_truth("nominal", 0, "tractor")
    with pytest.raises(PlantError, check=coded("truth.unreadable")) as refused:
        load_truth(str(tmp_path / "missing.toml"), 0, "palms_471")
    assert "missing.toml" in str(refused.value)


@machines
def test_a_truth_file_of_a_shipped_machine_need_not_repeat_its_steel_and_home(machine, tmp_path):
    shipped = Path(sim.truth.__file__).with_name(FILES[machine]).read_text()
    without = re.sub(r"\[(home|steel)\]\n(?:.+\n)*", "", shipped)
    assert "[home]" not in without and "[steel]" not in without
    file = tmp_path / "old.toml"
    file.write_text(without)
    assert load_truth(str(file), 0, machine) == load_truth("nominal", 0, machine)
    file.write_text(without.replace(f'machine = "{machine}"', 'machine = "mine"'))
    with pytest.raises(PlantError, match="home"):
        load_truth(str(file), 0, "mine")


def test_individuals_are_drawn_around_a_users_truth_file(own):
    one = load_truth(f"sampled:{own}", 5, "palms_471")
    assert one.supply.relief_pa == 18.0e6 and one.functions == load_truth("sampled", 5, "palms_471").functions
    assert one != load_truth(f"sampled:{own}", 6, "palms_471")
    assert load_truth(f"nominal:{own}", 5, "palms_471") == load_truth(str(own), 0, "palms_471")


def test_the_truth_beside_a_profile_of_ones_own_is_chosen_by_itself(tmp_path):
    profile, own = str(tmp_path / "changed.toml"), tmp_path / "loader.truth.toml"
    assert beside(profile, "loader", "nominal") == "nominal", "there is no such file"
    own.touch()
    assert beside(profile, "loader", "nominal") == f"nominal:{own}"
    assert beside(profile, "loader", "sampled") == f"sampled:{own}"
    assert beside(profile, "loader", "other.toml") == "other.toml"
    assert beside("palms_471", "palms_471", "nominal") == "nominal", "a shipped machine has no folder"


def test_trials_on_many_machines_draw_each_unless_the_caller_named_one():
    assert [another_for_every_seed(text) for text in ("nominal", "wide_valves", "nominal:a.toml", "a.toml")] == [
        "sampled",
        "wide_valves",
        "sampled:a.toml",
        "a.toml",
    ]


@machines
@settings(max_examples=40, deadline=None)
@given(seed=SEEDS)
def test_wide_valves_are_any_valve_on_an_ordinary_individual(machine, seed):
    nominal, one = load_truth("nominal", 0, machine), load_truth("wide_valves", seed, machine)
    ordinary = load_truth("sampled", seed, machine)
    assert one.links == ordinary.links and one.encoders == ordinary.encoders
    assert one.functions["grapple"] == ordinary.functions["grapple"]
    for name in ("slew", "lift", "tilt", "ext", "rot"):
        v, ratio = one.functions[name].valve, ratios(one.functions[name].valve, nominal.functions[name].valve)
        assert 0.020 <= v.delay_s <= 0.250
        assert min(v.deadband_plus, v.deadband_minus) >= 0.03 and max(v.deadband_plus, v.deadband_minus) <= 0.30
        assert all(1.0 / 3.0 - 1e-9 <= ratio[f"full_speed_{side}"] <= 3.0 + 1e-9 for side in ("plus", "minus"))


def test_wide_valves_fill_their_range_evenly_by_ratio():
    valves = [load_truth("wide_valves", seed, "palms_471").functions["lift"].valve for seed in range(300)]
    edges = [math.log(v.deadband_plus / 0.03) / math.log(10.0) for v in valves]
    assert statistics.mean(edges) == pytest.approx(0.5, abs=0.06) and min(edges) < 0.05 and max(edges) > 0.95
    apart = [abs(math.log(v.deadband_plus / v.deadband_minus)) for v in valves]
    assert max(apart) > 1.5, "each side is drawn for itself"
