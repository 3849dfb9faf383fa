"""A problem for every wrong value of a profile: its code, its key path and what its sentence names."""

from __future__ import annotations

import pytest

from tests.machine.changed_profiles import AORO, DELETE, IMU, SAG, problems, the_problem

VALUES = [
    ({"joints.lift.upper": 75.0}, "profile.out-of-range", "joints.lift.upper", ("75", "deg", "-6.28319..6.28319")),
    ({"joints.slew.speed_limit": 0.0}, "profile.out-of-range", "joints.slew.speed_limit", ("0.005..3.5",)),
    ({"joints.slew.speed_limit": -0.1}, "profile.out-of-range", "joints.slew.speed_limit", ("-0.1", "0.005..3.5")),
    (
        {"joints.slew.acceleration_limit": 23.0},
        "profile.out-of-range",
        "joints.slew.acceleration_limit",
        ("23", "deg/s^2", "0.01..20"),
    ),
    (
        {"joints.slew.valve.full_speed_plus": 30.0},
        "profile.out-of-range",
        "joints.slew.valve.full_speed_plus",
        ("30", "deg/s", "0.005..7"),
    ),
    (
        {"joints.slew.valve.full_speed_minus": 0.3},
        "profile.full-speed-too-low",
        "joints.slew.valve.full_speed_minus",
        ("0.3", "0.35"),
    ),
    ({"kinematics.a2_m": 3049.0}, "profile.out-of-range", "kinematics.a2_m", ("3049", "mm", "0.3..15")),
    (
        {"kinematics.theta2_offset_rad": float("nan")},
        "profile.out-of-range",
        "kinematics.theta2_offset_rad",
        ("-6.28319..6.28319",),
    ),
    ({"bunk.center_m": [3470.0, 0.96]}, "profile.out-of-range", "bunk.center_m[0]", ("3470", "mm", "-20..20")),
    ({"bunk.length_m": -1.0}, "profile.out-of-range", "bunk.length_m", ("-1", "0.5..15")),
    (
        {"grapple.hold_pressure_bar": 1.5e7},
        "profile.out-of-range",
        "grapple.hold_pressure_bar",
        ("1.5e+07", "Pa", "10..350"),
    ),
    ({"grapple.close_time_s": 3500.0}, "profile.out-of-range", "grapple.close_time_s", ("3500", "ms", "0.2..20")),
    ({"joints.lift.lower": 1.309}, "profile.limits-reversed", "joints.lift.lower", ("1.309",)),
    ({"joints.ext.lower": 1.9}, "profile.limits-reversed", "joints.ext.lower", ("1.9", "1.8")),
    (
        {"joints.slew.law.kp_1_s": 8.0},
        "profile.gain-too-high",
        "joints.slew.law.kp_1_s",
        ("8.0", "1", "0.08", "0.64", "6.25"),
    ),
    ({"joints.slew.law.kp_1_s": -1.0}, "profile.out-of-range", "joints.slew.law.kp_1_s", ("-1", "1", "0.05..50")),
    (
        {"joints.slew.law.stop_band": 0.17},
        "profile.out-of-range",
        "joints.slew.law.stop_band",
        ("0.17", "deg", "1e-05..0.05"),
    ),
    (
        {"joints.slew.valve.deadband_plus_pct": 50.0},
        "profile.deadband",
        "joints.slew.valve.deadband_plus_pct",
        ("50.0", "0", "50"),
    ),
    (
        {"joints.slew.valve.deadband_minus_pct": -1.0},
        "profile.deadband",
        "joints.slew.valve.deadband_minus_pct",
        ("-1.0", "0", "50"),
    ),
    ({"joints.slew.valve.signal": "Boom"}, "profile.valve-signal", "joints.slew.valve.signal", ('"Boom"',)),
    ({"joints.lift.valve.signal": "Slew"}, "profile.used-twice", "joints.lift.valve.signal", ()),
    ({"joints.tilt.encoder.node": 2}, "profile.used-twice", "joints.tilt.encoder.node", ("2",)),
    ({"joints.tilt.encoder.message": "EncSlew"}, "profile.used-twice", "joints.tilt.encoder.message", ()),
    ({"joints.slew.encoder.node": 128}, "profile.out-of-range", "joints.slew.encoder.node", ("128", "1..127")),
    (
        {"joints.slew.encoder.message": "EncArm"},
        "profile.encoder-message",
        "joints.slew.encoder.message",
        ('"EncArm"',),
    ),
    (
        {"joints.slew.encoder.device_type": 0x00010191},
        "profile.encoder-device-type",
        "joints.slew.encoder.device_type",
        ("0x00010191", "1000h", "0x0196"),
    ),
    (
        {"joints.slew.encoder.zero_counts": 16384},
        "profile.encoder-zero",
        "joints.slew.encoder.zero_counts",
        ("16384", "0..16383"),
    ),
    ({"joints.slew.encoder.noise": 2.0}, "profile.out-of-range", "joints.slew.encoder.noise", ("2", "deg", "0..0.05")),
    (
        {"joints.slew.encoder.total_counts": 8200, "joints.slew.encoder.zero_counts": 4100},
        "profile.encoder-wraps",
        "joints.slew.encoder.total_counts",
        ("8200", "0.000383495", "+-1.572", "-1.74533..1.74533"),
    ),
    (
        {"joints.ext.encoder.total_counts": 204800},
        "profile.encoder-too-short",
        "joints.ext.encoder.total_counts",
        ("204800", "5e-06", "0.13..1.8"),
    ),
    ({"joints.ext.law.kind": "nobody"}, "profile.law-unknown", "joints.ext.law.kind", ('"nobody"', "pid")),
    ({"joints.ext.kind": "revolute"}, "profile.joint-kind", "joints.ext.kind", ('"revolute"',)),
    ({"bunk.floor_z_m": -1.5}, "profile.bunk-below-ground", "bunk.floor_z_m", ("-1.5", "-1.39")),
    ({"timeouts.lease_max_ms": 5000}, "profile.out-of-range", "timeouts.lease_max_ms", ("5000", "20..500")),
    ({"timeouts.operator_link_ms": 1001}, "profile.out-of-range", "timeouts.operator_link_ms", ("1001", "0..1000")),
    ({"timeouts.operator_link_ms": 499}, "profile.link-limit-short", "timeouts.operator_link_ms", ("499", "500", "0")),
    ({"rate_hz": 300}, "profile.rate-not-whole", "rate_hz", ("300", "100", "200", "250")),
    ({"rate_hz": 0}, "profile.out-of-range", "rate_hz", ("50..1000",)),
    ({"crane_bus": "can 0"}, "profile.name-not-plain", "crane_bus", ('"can 0"', "0", "9")),
    ({"machine_bus": "crane0"}, "profile.same-bus", "machine_bus", ('"crane0"',)),
    ({"grapple.tongs.half_gap_m": [0.7, 0.1]}, "profile.jaw-table-length", "grapple.tongs.half_gap_m", ("2", "6")),
    (
        {"grapple.tongs.angle_rad": [0.1, 0.30, 0.60, 1.00, 1.222, 2.234]},
        "profile.jaw-table-start",
        "grapple.tongs.angle_rad",
        ("0.0",),
    ),
    (
        {"grapple.tongs.angle_rad": [0.0, 0.60, 0.30, 1.00, 1.222, 2.234]},
        "profile.jaw-table-order",
        "grapple.tongs.angle_rad",
        (),
    ),
    (
        {"grapple.tongs.half_gap_m": [0.733, 0.577, 0.6, 0.137, 0.001, -0.368]},
        "profile.jaw-table-order",
        "grapple.tongs.half_gap_m",
        ("0",),
    ),
    ({"workspace.pick_center_m": [0.0, 8.0]}, "profile.out-of-reach", "workspace.pick_center_m", ("8.00", "6.95")),
    ({"cameras.stick.link": "front"}, "profile.camera-link", "cameras.stick.link", ('"front"',)),
    ({"cameras.stick.model": " "}, "profile.camera-model", "cameras.stick.model", ()),
    (
        {"cameras.stick.rpy_rad": [0.0, 11.5, 0.0]},
        "profile.out-of-range",
        "cameras.stick.rpy_rad[1]",
        ("11.5", "deg", "-6.28319..6.28319"),
    ),
    ({"cameras.stick.cx_px": 1300.0}, "profile.camera-center", "cameras.stick.cx_px", ("1300", "0..1280")),
    ({"cameras.stick.cy_px": float("nan")}, "profile.camera-center", "cameras.stick.cy_px", ("0..720",)),
    ({"cameras.stick.baseline_m": 120.0}, "profile.out-of-range", "cameras.stick.baseline_m", ("120", "mm", "0.01..2")),
    ({"cameras.stick.depth_min_m": 20.0}, "profile.camera-depths", "cameras.stick.depth_min_m", ("20.0",)),
]
DRIVING = [
    ({"machine_bus": DELETE}, "profile.machine-bus-missing", "machine_bus", ()),
    ({"carrier.trak_width_m": 2.1}, "profile.unknown-key", "carrier.trak_width_m", ('"track_width_m"',)),
    (
        {"carrier.articulation_limit_rad": 35.0},
        "profile.out-of-range",
        "carrier.articulation_limit_rad",
        ("35", "deg", "0.05..1.2"),
    ),
    (
        {"carrier.crane_base_m": [-0.4, float("inf"), 0.68]},
        "profile.out-of-range",
        "carrier.crane_base_m[1]",
        ("-5..5",),
    ),
    ({"carrier.site_lat_deg": 196.0}, "profile.out-of-range", "carrier.site_lat_deg", ("196", "-85..85")),
    (
        {"carrier.antenna_aux_m": [0.5, 0.0, 2.0]},
        "profile.antennas-too-close",
        "carrier.antenna_aux_m",
        ("0.10", "0.3"),
    ),
    (
        {"carrier.arm_travel_m": 1.10},
        "profile.arm-travel",
        "carrier.arm_travel_m",
        ("1.00", "-0.90..0.90", "-0.15..0.95"),
    ),
    ({"carrier.arm_transport_m": 0.7}, "profile.arm-transport", "carrier.arm_transport_m", ("0.7", "0.6")),
    (
        {"carrier.wheel_width_m": 1.4, "carrier.track_width_m": 1.4},
        "profile.wheel-width",
        "carrier.wheel_width_m",
        ("1.4",),
    ),
    (
        {"carrier.front_axle_m": 0.9, "carrier.rear_axle_m": 0.6},
        "profile.wheels-overlap",
        "carrier.articulation_limit_rad",
        ("0.610865", "0.44"),
    ),
    ({"carrier.cruise_speed_m_s": 2.3}, "profile.cruise-speed", "carrier.cruise_speed_m_s", ("2.3", "1.0")),
    ({"carrier.tilt_limit_rad": 17.0}, "profile.out-of-range", "carrier.tilt_limit_rad", ("17", "deg", "0.05..0.6")),
    (
        {"carrier.drive_acceleration_m_s2": 400.0},
        "profile.out-of-range",
        "carrier.drive_acceleration_m_s2",
        ("400", "2", "mm/s^2", "0.05..3"),
    ),
    (
        {"carrier.steer_valve.full_speed_minus": 0.1},
        "profile.full-speed-too-low",
        "carrier.steer_valve.full_speed_minus",
        ("0.1", "0.21"),
    ),
    (
        {"carrier.arm_valve.deadband_plus_pct": 60.0},
        "profile.deadband",
        "carrier.arm_valve.deadband_plus_pct",
        ("60.0", "0", "50"),
    ),
    (
        {"carrier.arm_kp_1_s": 10.0},
        "profile.gain-too-high",
        "carrier.arm_kp_1_s",
        ("10.0", "1", "0.08", "0.80", "6.25"),
    ),
    (
        {"carrier.articulation_encoder.message": "EncRot"},
        "profile.encoder-message",
        "carrier.articulation_encoder.message",
        ('"EncRot"',),
    ),
    ({"carrier.articulation_encoder.node": 3}, "profile.used-twice", "carrier.articulation_encoder.node", ("3",)),
    (
        {"joints.ext.encoder.message": "EncArtic"},
        "profile.encoder-message",
        "joints.ext.encoder.message",
        ('"EncArtic"',),
    ),
]


@pytest.mark.parametrize(("changes", "code", "path", "named"), VALUES, ids=lambda v: "")
def test_wrong_values(tmp_path, changes, code, path, named):
    found, sentence = the_problem(tmp_path, changes)
    assert found == (code, path)
    assert all(word in sentence for word in named)


@pytest.mark.parametrize(("changes", "code", "path", "named"), DRIVING, ids=lambda v: "")
def test_wrong_carriers(tmp_path, changes, code, path, named):
    found, sentence = the_problem(tmp_path, changes, AORO)
    assert found == (code, path)
    assert all(word in sentence for word in named)


@pytest.mark.parametrize(
    ("changes", "code", "path", "named"),
    [
        ({"head_nm_m": 2e5, "pin_nm_m": 1e3}, "profile.out-of-range", "sag.head_nm_m", ("200000", "0..100000")),
        ({"load_rad_nm": -1e-6}, "profile.out-of-range", "sag.load_rad_nm", ("-1e-06", "0..1e-05")),
        ({"pin_rad_m": 0.015}, "profile.sag-lean", "sag.pin_rad_m", ("0.099", "0.06")),
        ({"pin_nm_m": 2000.0}, "profile.sag-moment", "sag.head_nm_m", ("head_nm_m", "pin_nm_m")),
    ],
    ids=lambda v: "",
)
def test_an_implausible_sag_is_refused(tmp_path, changes, code, path, named):
    found, sentence = the_problem(tmp_path, {"sag": {**SAG, **changes}})
    assert found == (code, path)
    assert all(word in sentence for word in named)


@pytest.mark.parametrize(
    ("changes", "code", "path", "named"),
    [
        ({"gain": 3.0}, "profile.out-of-range", "imu.gain", ("3", "0..1.5")),
        ({"pendulum_m": 800.0}, "profile.out-of-range", "imu.pendulum_m", ("800", "0.2..5", "mm")),
        ({"pin_speed_m_s": 120.0}, "profile.out-of-range", "imu.pin_speed_m_s", ("120", "mm/s")),
        ({"dead_zone_rad": 0.8}, "profile.out-of-range", "imu.dead_zone_rad", ("0.8", "deg")),
        ({"node": 0}, "profile.out-of-range", "imu.node", ("0", "1..127")),
        ({"message": "PressC"}, "profile.imu-message", "imu.message", ('"PressC"', "GrappleImu")),
        ({"node": 3}, "profile.used-twice", "imu.node", ("joints.lift.encoder.node",)),
        ({"node": 7}, "profile.used-twice", "imu.node", ("carrier.articulation_encoder.node",)),
    ],
    ids=lambda v: "",
)
def test_an_implausible_imu_is_refused(tmp_path, changes, code, path, named):
    found, sentence = the_problem(tmp_path, {"imu": {**IMU, **changes}}, AORO)
    assert found == (code, path)
    assert all(word in sentence for word in named)


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
