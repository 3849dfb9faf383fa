"""A problem for every wrong key, type or value of a profile: its code, its key path and what its sentence names."""

from __future__ import annotations

import pytest

from tests.machine.changed_profiles import AORO, DELETE, IMU, RAW, SAG, problems

NAN = float("nan")
BOX = {"center_m": [5.0, 0.0, 0.0], "half_m": [0.1, 0.1, 0.1]}

# Code and key path of the only problem, the value there that makes it, and the words that its sentence names.
OF_A_CRANE = [
    ("wrong-unit", "joints.slew.speed_limit_deg_s", 20.0, '"speed_limit"'),
    ("unknown-key", "joints.slew.valve.dedband_plus_pct", 3.0, '"deadband_plus_pct"'),
    ("unknown-key", "timeouts.zzz", 1, ""),
    ("wrong-unit", "rate", 200, '"rate_hz"'),
    ("unknown-joint", "joints.boom", RAW["joints"]["lift"], ""),
    ("unknown-joint", "joints.slw", RAW["joints"]["slew"], '"slew"'),
    ("missing-joint", "joints.ext", DELETE, ""),
    ("missing-key", "joints.ext.law", DELETE, ""),
    ("missing-key", "bunk", DELETE, ""),
    ("not-a-table", "bunk", 3, "3"),
    ("not-a-table", "joints", 3, "3"),
    ("wrong-type", "joints.lift.lower", "-22 deg", ""),
    ("wrong-type", "rate_hz", 200.5, ""),
    ("wrong-type", "bunk.center_m", [1.0], "2 1"),
    ("wrong-type", "bunk.center_m[1]", [1.0, "x"], ""),
    ("not-a-table", "cameras", 3, "3"),
    ("missing-key", "cameras.d435.rate_hz", DELETE, ""),
    ("wrong-type", "cameras.d435.rpy_rad", [0.0, 1.57], "3 2"),
    ("not-a-table", "carrier", 3, "3"),
    ("not-allowed", "schema", 2, "2 1"),
    ("not-allowed", "joints.slew.valve.sign", 0, "0 -1 1"),
    ("not-allowed", "joints.slew.valve.sign", True, "-1 1"),
    ("not-allowed", "joints.slew.encoder.kind", "round", ""),
    ("not-allowed", "joints.slew.encoder.direction", [1], "1 -1"),
    ("out-of-range", "joints.lift.upper", 75.0, "75 deg -6.28319..6.28319"),
    ("out-of-range", "joints.slew.speed_limit", 0.0, "0.005..3.5"),
    ("out-of-range", "joints.slew.speed_limit", -0.1, "-0.1 0.005..3.5"),
    ("out-of-range", "joints.slew.acceleration_limit", 23.0, "23 deg/s^2 0.01..20"),
    ("out-of-range", "joints.slew.valve.full_speed_plus", 30.0, "30 deg/s 0.005..7"),
    ("full-speed-too-low", "joints.slew.valve.full_speed_minus", 0.3, "0.3 0.35"),
    ("out-of-range", "kinematics.a2_m", 3049.0, "3049 mm 0.3..15"),
    ("out-of-range", "kinematics.theta2_offset_rad", float("nan"), "-6.28319..6.28319"),
    ("out-of-range", "bunk.center_m[0]", [3470.0, 0.96], "3470 mm -20..20"),
    ("out-of-range", "bunk.length_m", -1.0, "-1 0.5..15"),
    ("out-of-range", "grapple.hold_pressure_bar", 1.5e7, "1.5e+07 Pa 10..350"),
    ("out-of-range", "grapple.close_time_s", 3500.0, "3500 ms 0.2..20"),
    ("limits-reversed", "joints.lift.lower", 1.309, "1.309"),
    ("limits-reversed", "joints.ext.lower", 1.9, "1.9 1.8"),
    ("gain-too-high", "joints.slew.law.kp_1_s", 8.0, "8.0 1 0.08 0.64 6.25"),
    ("out-of-range", "joints.slew.law.kp_1_s", -1.0, "-1 1 0.05..50"),
    ("out-of-range", "joints.slew.law.stop_band", 0.17, "0.17 deg 1e-05..0.05"),
    ("deadband", "joints.slew.valve.deadband_plus_pct", 50.0, "50.0 0 50"),
    ("deadband", "joints.slew.valve.deadband_minus_pct", -1.0, "-1.0 0 50"),
    ("valve-signal", "joints.slew.valve.signal", "Boom", '"Boom"'),
    ("used-twice", "joints.lift.valve.signal", "Slew", ""),
    ("used-twice", "joints.tilt.encoder.node", 2, "2"),
    ("used-twice", "joints.tilt.encoder.message", "EncSlew", ""),
    ("out-of-range", "joints.slew.encoder.node", 128, "128 1..127"),
    ("encoder-message", "joints.slew.encoder.message", "EncArm", '"EncArm"'),
    ("encoder-device-type", "joints.slew.encoder.device_type", 0x00010191, "0x00010191 1000h 0x0196"),
    ("encoder-zero", "joints.slew.encoder.zero_counts", 16384, "16384 0..16383"),
    ("out-of-range", "joints.slew.encoder.noise", 2.0, "2 deg 1e-06..0.05"),
    ("out-of-range", "joints.slew.encoder.noise", 0.0, "0 1e-06..0.05"),
    ("out-of-range", "joints.ext.encoder.total_counts", 2**32, "2..4.29497e+09"),
    ("out-of-range", "joints.lift.valve.lever_at[1]", [-0.384, NAN, 0, 0.3, 0.5, 0.9, 1.2, 1.3], "nan -20..20"),
    ("out-of-range", "joints.lift.valve.lever[1]", [0.8, 1.5, 1, 1, 1, 1, 1, 1], "1.5 0.2..1.4"),
    ("out-of-range", "joints.slew.valve.exponent", 1.7, "1.7 0.5..1.6"),
    ("encoder-too-short", "joints.ext.encoder.total_counts", 204800, "204800 5e-06 0.13..1.8"),
    ("law-unknown", "joints.ext.law.kind", "nobody", '"nobody" pid'),
    ("joint-kind", "joints.ext.kind", "revolute", '"revolute"'),
    ("bunk-below-ground", "bunk.floor_z_m", -1.5, "-1.5 -1.39"),
    ("out-of-range", "timeouts.lease_max_ms", 5000, "5000 20..500"),
    ("out-of-range", "timeouts.stop_ramp_ms", 201, "201 10..200"),
    ("keep-out-boxes", "keep_out", {f"box{i}": BOX for i in range(101)}, "101 100"),
    ("out-of-range", "timeouts.operator_link_ms", 1001, "1001 0..1000"),
    ("link-limit-short", "timeouts.operator_link_ms", 499, "499 500 0"),
    ("rate-not-whole", "rate_hz", 300, "300 100 200 250"),
    ("out-of-range", "rate_hz", 0, "50..1000"),
    ("name-not-plain", "crane_bus", "can 0", '"can 0" 0 9'),
    ("same-bus", "machine_bus", "crane0", '"crane0"'),
    ("jaw-table-length", "grapple.tongs.half_gap_m", [0.7, 0.1], "2 6"),
    ("jaw-table-start", "grapple.tongs.angle_rad", [0.1, 0.3, 0.6, 1.0, 1.222, 2.234], "0.0"),
    ("jaw-table-order", "grapple.tongs.angle_rad", [0.0, 0.6, 0.3, 1.0, 1.222, 2.234], ""),
    ("jaw-table-order", "grapple.tongs.half_gap_m", [0.733, 0.577, 0.6, 0.137, 0.001, -0.368], "0"),
    ("out-of-reach", "workspace.pick_center_m", [0.0, 8.0], "8.00 6.95"),
    ("camera-link", "cameras.stick.link", "front", '"front"'),
    ("camera-model", "cameras.stick.model", " ", ""),
    ("out-of-range", "cameras.stick.rpy_rad[1]", [0.0, 11.5, 0.0], "11.5 deg -6.28319..6.28319"),
    ("camera-center", "cameras.stick.cx_px", 1300.0, "1300 0..1280"),
    ("camera-center", "cameras.stick.cy_px", float("nan"), "0..720"),
    ("out-of-range", "cameras.stick.baseline_m", 120.0, "120 mm 0.01..2"),
    ("camera-depths", "cameras.stick.depth_min_m", 20.0, "20.0"),
]
OF_A_FORWARDER = [
    ("machine-bus-missing", "machine_bus", DELETE, ""),
    ("unknown-key", "carrier.trak_width_m", 2.1, '"track_width_m"'),
    ("out-of-range", "carrier.articulation_limit_rad", 35.0, "35 deg 0.05..1.2"),
    ("out-of-range", "carrier.articulation_limit_rad", float("inf"), "inf 0.05..1.2"),
    ("out-of-range", "carrier.articulation_lag_s", 0.0, "0 0.01..2"),
    ("out-of-range", "carrier.steer_valve.delay_s", 0.0, "0 0.01..0.5"),
    ("out-of-range", "carrier.speed_limit_m_s", 2.1, "2.1 0.05..2"),
    ("out-of-range", "carrier.crane_base_m[1]", [-0.4, float("inf"), 0.68], "-5..5"),
    ("out-of-range", "carrier.site_lat_deg", 196.0, "196 -85..85"),
    ("antennas-too-close", "carrier.antenna_aux_m", [0.5, 0.0, 2.0], "0.10 0.3"),
    ("arm-travel", "carrier.arm_travel_m", 1.1, "1.00 -0.90..0.90 -0.15..0.95"),
    ("arm-transport", "carrier.arm_transport_m", 0.7, "0.7 0.6"),
    ("cruise-speed", "carrier.cruise_speed_m_s", 1.3, "1.3 1.0"),
    ("out-of-range", "carrier.tilt_limit_rad", 17.0, "17 deg 0.05..0.6"),
    ("out-of-range", "carrier.drive_acceleration_m_s2", 400.0, "400 2 mm/s^2 0.05..3"),
    ("full-speed-too-low", "carrier.steer_valve.full_speed_minus", 0.1, "0.1 0.21"),
    ("deadband", "carrier.arm_valve.deadband_plus_pct", 60.0, "60.0 0 50"),
    ("gain-too-high", "carrier.arm_kp_1_s", 10.0, "10.0 1 0.08 0.80 6.25"),
    ("encoder-message", "carrier.articulation_encoder.message", "EncRot", '"EncRot"'),
    ("used-twice", "carrier.articulation_encoder.node", 3, "3"),
    ("encoder-message", "joints.ext.encoder.message", "EncArtic", '"EncArtic"'),
]
OF_ITS_SAG = [
    ("out-of-range", "sag.load_rad_nm", -1e-6, "-1e-06 0..1e-05"),
    ("sag-lean", "sag.pin_rad_m", 0.015, "0.099 0.06"),
]
OF_ITS_IMU = [
    ("out-of-range", "imu.gain", 3.0, "3 0..1.5"),
    ("out-of-range", "imu.pendulum_m", 800.0, "800 0.2..5 mm"),
    ("out-of-range", "imu.pin_speed_m_s", 120.0, "120 mm/s"),
    ("out-of-range", "imu.dead_zone_rad", 0.8, "0.8 deg"),
    ("out-of-range", "imu.node", 0, "0 1..127"),
    ("imu-message", "imu.message", "PressC", '"PressC" GrappleImu'),
    ("used-twice", "imu.node", 3, "joints.lift.encoder.node"),
    ("used-twice", "imu.node", 7, "carrier.articulation_encoder.node"),
]
ONE_CHANGE = [
    (of, *row)
    for of, rows in (
        (RAW, OF_A_CRANE),
        (AORO, OF_A_FORWARDER),
        (RAW | {"sag": SAG}, OF_ITS_SAG),
        (AORO | {"imu": IMU}, OF_ITS_IMU),
    )
    for row in rows
]
OTHER_CHANGES = [
    ("wrong-unit", "joints.lift.lower_deg", {"joints.lift.lower_deg": -22.0, "joints.lift.lower": DELETE}, '"lower"'),
    ("wrong-unit", "kinematics.d1_mm", {"kinematics.d1_mm": 1364.34, "kinematics.d1_m": DELETE}, '"d1_m"'),
    ("wrong-unit", "cameras.stick.fx", {"cameras.stick.fx": 530.0, "cameras.stick.fx_px": DELETE}, '"fx_px"'),
    (
        "encoder-wraps",
        "joints.slew.encoder.total_counts",
        {"joints.slew.encoder.total_counts": 8200, "joints.slew.encoder.zero_counts": 4100},
        "8200 0.000383495 +-1.572 -1.74533..1.74533",
    ),
    ("wheel-width", "carrier.wheel_width_m", {"carrier.wheel_width_m": 1.4, "carrier.track_width_m": 1.4}, "1.4"),
    (
        "wheels-overlap",
        "carrier.articulation_limit_rad",
        {"carrier.front_axle_m": 0.9, "carrier.rear_axle_m": 0.6},
        "0.610865 0.44",
    ),
    ("out-of-range", "sag.head_nm_m", {"sag.head_nm_m": 2e5, "sag.pin_nm_m": 1e3}, "200000 0..100000"),
    ("sag-moment", "sag.head_nm_m", {"sag.pin_nm_m": 2000.0}, "head_nm_m pin_nm_m"),
]


def check(folder, of, changes, code, path, named):
    (problem,) = problems(folder, changes, of)
    assert (problem.code, problem.path) == (f"profile.{code}", path)
    assert all(word in problem.sentence for word in named.split())


@pytest.mark.parametrize(
    ("of", "code", "path", "value", "named"), ONE_CHANGE, ids=[f"{row[1]} {row[2]}" for row in ONE_CHANGE]
)
def test_a_wrong_key_type_or_value_is_the_only_problem(tmp_path, of, code, path, value, named):
    check(tmp_path, of, {path.partition("[")[0]: value}, code, path, named)


@pytest.mark.parametrize(("code", "path", "changes", "named"), OTHER_CHANGES, ids=[row[1] for row in OTHER_CHANGES])
def test_values_that_are_wrong_together_are_one_problem(tmp_path, code, path, changes, named):
    of = (AORO if "carrier" in path else RAW) | ({"sag": SAG} if path.startswith("sag.") else {})
    check(tmp_path, of, changes, code, path, named)


def test_a_speed_in_degrees_is_reported_with_its_consequences(tmp_path):
    found = problems(tmp_path, {"joints.slew.speed_limit": 20.0})
    assert [(problem.code, problem.path) for problem in found] == [
        ("profile.out-of-range", "joints.slew.speed_limit"),
        ("profile.full-speed-too-low", "joints.slew.valve.full_speed_plus"),
        ("profile.full-speed-too-low", "joints.slew.valve.full_speed_minus"),
    ]
    assert "deg/s" in found[0].sentence and "20.0" in found[1].sentence


def test_encoder_kind_must_match_message_and_joint(tmp_path):
    def codes(changes):
        return {(problem.code, problem.path) for problem in problems(tmp_path, changes)}

    found = codes({"joints.ext.encoder.kind": "rotary"})
    assert ("profile.encoder-message-kind", "joints.ext.encoder.message") in found
    assert ("profile.encoder-kind", "joints.ext.encoder.kind") in found
    assert ("profile.encoder-kind", "joints.slew.encoder.kind") in codes({"joints.slew.encoder.kind": "linear"})


def test_a_delay_in_ms_is_reported_before_its_gain(tmp_path):
    found = problems(tmp_path, {"joints.slew.valve.delay_s": 80.0})
    assert (found[0].code, found[0].path) == ("profile.out-of-range", "joints.slew.valve.delay_s")
    assert " ms" in found[0].sentence


def test_all_problems_are_reported_at_once(tmp_path):
    found = problems(
        tmp_path,
        {"timeouts.lease_max_ms": 5000, "rate_hz": 300, "joints.lift.lower": 2.0, "name": "My crane"},
    )
    assert [problem.path for problem in found] == ["timeouts.lease_max_ms", "name", "rate_hz", "joints.lift.lower"]
