"""Scenes and logs as pure geometry: sizes, arrangements, mass properties, and impossible requests."""

from __future__ import annotations

import math
from itertools import combinations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from machine.loading.profile_file import load_profile
from sim.errors import PlantError
from sim.scenes.arrangements import CONFIGURATIONS, KINDS, arrangement, configuration, random_scene
from sim.truth.load import load_truth
from sim.wood.log_shape import LogSpec, log_segments, mass_of, quaternion_of
from sim.wood.stacking import clearance, footprint_gap
from tests.codes import coded

MACHINES = ("palms_471", "aoro_fc8")
PROFILES = {name: load_profile(name) for name in MACHINES}
WOOD = {name: load_truth("nominal", 0, name).wood for name in MACHINES}
PALMS, PINE = PROFILES["palms_471"], WOOD["palms_471"]


def scene(kind: str, machine: str = "palms_471", seed: int = 0, logs: int = 1, **options) -> tuple[LogSpec, ...]:
    return arrangement(kind, PROFILES[machine], WOOD[machine], seed, logs, **options)


@pytest.mark.parametrize("machine", MACHINES)
def test_log_sizes_follow_the_truth_and_only_the_seed_changes_them(machine):
    w = WOOD[machine]
    logs = [log for seed in range(40) for log in scene("separate", machine, seed, 2)]
    for name in ("length_m", "diameter_m", "taper_m_m"):
        low, high = getattr(w, name)
        values = [getattr(log, name) for log in logs]
        assert low <= min(values) < max(values) <= high and max(values) - min(values) > 0.5 * (high - low)
    assert min(log.sweep for log in logs) >= 0.0 and max(log.sweep for log in logs) <= w.sweep_max <= 0.03
    assert abs(sum(log.density_kg_m3 for log in logs) / len(logs) / w.density_kg_m3 - 1.0) < 0.05
    assert scene("separate", machine, 3, 2) == scene("separate", machine, 3, 2) != scene("separate", machine, 4, 2)


def test_random_logs_lie_apart_in_the_pick_area():
    (cx, cy), half = PALMS.workspace.pick_center_m, PALMS.workspace.pick_half_size_m
    for seed in range(10):
        logs = random_scene(PALMS, PINE, seed, 3)
        assert all(abs(log.x_m - cx) <= half and abs(log.y_m - cy) <= half for log in logs)
        assert all(footprint_gap(a, b) > 0.1 for a, b in combinations(logs, 2))


def test_the_carriers_pick_area_is_beside_the_machine_where_it_starts():
    for log in scene("separate", "aoro_fc8", 0, 3):
        assert -5.5 < log.x_m < -3.3 and -4.5 < log.y_m < -2.3


@pytest.mark.parametrize("kind", ["parallel", "skewed", "crossed", "pile", "bunk"])
def test_logs_are_clear_of_each_other_at_release(kind):
    for seed in range(5):
        logs = scene(kind, seed=seed, logs=min(6, KINDS[kind][1]) if kind != "crossed" else 3)
        assert all(clearance(a, b) > 0.0 for a, b in combinations(logs, 2))


def test_each_arrangement_matches_its_name():
    at, yaw = (2.0, 5.0), 0.7
    (one,) = scene("single", at=at, yaw_rad=yaw)
    assert math.dist((one.x_m, one.y_m), at) < 0.3 and abs(math.sin(one.yaw_rad - yaw)) < 0.05
    assert all(abs(math.sin(s.yaw_rad - yaw)) < 0.05 for s in scene("parallel", logs=4, at=at, yaw_rad=yaw))
    below, top = scene("crossed", logs=2, at=at, yaw_rad=yaw)
    assert abs(math.sin(top.yaw_rad - below.yaw_rad)) > 0.6 and top.z_m > 0.5 * below.diameter_m
    heights = [s.z_m for s in scene("pile", logs=6)]
    assert max(heights[:3]) < 0.02 < min(heights[3:5]) and max(heights[3:5]) < heights[5] + 0.1
    assert all(s.in_bunk and abs(s.y_m) < PALMS.bunk.width_m / 2 for s in scene("bunk", logs=20))
    route = ((0.0, 0.0), (20.0, 0.0), (20.0, 20.0))
    row = scene("row", "aoro_fc8", 1, 12, route=route)
    for s in row:
        ends = [(s.x_m + k * math.cos(s.yaw_rad), s.y_m + k * math.sin(s.yaw_rad)) for k in (-1.0, 0.0, 1.0)]
        assert all(min(abs(y) if x <= 20.0 else 9.0, abs(x - 20.0) if y >= 0.0 else 9.0) > 1.5 for x, y in ends)
    assert len({s.y_m > 0.5 for s in row if s.x_m < 15.0}) == 2  # on both sides


def test_paper_a_has_twelve_configurations_of_one_to_six_logs():
    counts = [len(configuration(n, PALMS, PINE, 0)) for n in CONFIGURATIONS]
    assert len(counts) == 12 and counts[0] == 1 and max(counts) == 6


@pytest.mark.parametrize(
    ("make", "code"),
    [
        (lambda: scene("heap"), "scene.unknown-kind"),
        (lambda: scene("pile", logs=7), "scene.log-count"),
        (lambda: random_scene(PALMS, PINE, 5, 60), "scene.pick-area-full"),
        (lambda: scene("row", logs=60, route=((0.0, 0.0), (20.0, 0.0))), "scene.route-too-short"),
        (lambda: scene("bunk", logs=60), "scene.bunk-full"),
        (lambda: configuration(13, PALMS, PINE, 0), "scene.unknown-configuration"),
    ],
)
def test_impossible_scenes_are_refused(make, code):
    with pytest.raises(PlantError, check=coded(code)):
        make()


def test_a_straight_log_has_the_inertia_of_a_cylinder():
    m = mass_of(LogSpec(0, 0, 0, 2.6, 0.2, 600.0))
    assert m.mass_kg == pytest.approx(600.0 * math.pi * 0.01 * 2.6)
    assert m.com_m == pytest.approx((0.0, 0.0, 0.0), abs=1e-12) and m.turn_rad == 0.0
    across = m.mass_kg * (3 * 0.01 + 2.6**2) / 12
    assert m.inertia_kg_m2 == pytest.approx((across, across, m.mass_kg * 0.01 / 2), rel=1e-3)


@given(st.floats(0.002, 0.012), st.floats(0.0, 0.03), st.floats(0.12, 0.3))
def test_a_tapered_bowed_log_has_the_mass_of_its_frustum_and_a_centre_nearer_the_butt(taper, sweep, diameter):
    spec = LogSpec(0, 0, 0, 2.6, diameter, 600.0, taper, sweep)
    a, b = spec.radius(-0.5), spec.radius(0.5)
    frustum = math.pi * 2.6 / 3 * (a * a + a * b + b * b)
    m = mass_of(spec)
    assert m.mass_kg == pytest.approx(600.0 * frustum, rel=1e-3)
    x, _, z = m.com_m
    assert z < 0.0 and -0.5 * spec.sweep_m - 1e-9 <= x <= -0.25 * spec.sweep_m + 1e-9  # a parabola's third
    i = m.inertia_kg_m2
    assert i[0] > i[2] and i[1] > i[2] and max(i) <= sum(i) - max(i) + 1e-9  # a body's inertia
    pieces = log_segments(spec)
    assert pieces[0][0] == spec.axis_point(-0.5) and pieces[-1][1] == spec.axis_point(0.5)
    for p, q, _, _ in pieces:  # the body is never far beside the true bow
        s = (p[2] + q[2]) / 2 / 2.6
        assert abs((p[0] + q[0]) / 2 - spec.axis_point(s)[0]) < 0.004


@given(st.floats(-3, 3), st.floats(-1, 1), st.floats(-3, 3))
def test_the_axes_at_release_match_the_quaternion(yaw, pitch, roll):
    spec = LogSpec(0, 0, yaw, 2.6, 0.2, 600.0, pitch_rad=pitch, roll_rad=roll)
    x, y, z, w = quaternion_of(spec)
    bow, along = spec.directions()
    assert bow == pytest.approx((1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)), abs=1e-9)
    assert along == pytest.approx((2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)), abs=1e-9)
    assert along[2] == pytest.approx(math.sin(pitch), abs=1e-9)
