"""A sentence for every wrong value of a profile."""

from __future__ import annotations

import pytest
from changed_profiles import AORO, DELETE, IMU, SAG, problems

VALUES = [
    ({"joints.lift.upper": 75.0},
     "joints.lift.upper: 75 rad is outside -6.28319..6.28319 rad; was it given in deg?"),
    ({"joints.slew.speed_limit": 0.0}, "joints.slew.speed_limit: 0 rad/s is outside 0.005..3.5 rad/s"),
    ({"joints.slew.speed_limit": -0.1}, "joints.slew.speed_limit: -0.1 rad/s is outside 0.005..3.5 rad/s"),
    ({"joints.slew.acceleration_limit": 23.0},
     "joints.slew.acceleration_limit: 23 rad/s^2 is outside 0.01..20 rad/s^2; was it given in deg/s^2?"),
    ({"joints.slew.valve.full_speed_plus": 30.0},
     "joints.slew.valve.full_speed_plus: 30 rad/s is outside 0.005..3.5 rad/s; was it given in deg/s?"),
    ({"joints.slew.valve.full_speed_minus": 0.3},
     "joints.slew.valve.full_speed_minus: 0.3 rad/s is less than speed_limit = 0.35; it cannot follow"),
    ({"kinematics.a2_m": 3049.0}, "kinematics.a2_m: 3049 m is outside 0.3..15 m; was it given in mm?"),
    ({"kinematics.theta2_offset_rad": float("nan")},
     "kinematics.theta2_offset_rad: nan rad is outside -6.28319..6.28319 rad"),
    ({"bunk.center_m": [3470.0, 0.96]},
     "bunk.center_m[0]: 3470 m is outside -20..20 m; was it given in mm?"),
    ({"bunk.length_m": -1.0}, "bunk.length_m: -1 m is outside 0.5..15 m"),
    ({"grapple.hold_pressure_bar": 1.5e7},
     "grapple.hold_pressure_bar: 1.5e+07 bar is outside 10..350 bar; was it given in Pa?"),
    ({"grapple.close_time_s": 3500.0},
     "grapple.close_time_s: 3500 s is outside 0.2..20 s; was it given in ms?"),
    ({"joints.lift.lower": 1.309}, "joints.lift.lower: 1.309 rad is not below upper = 1.309 rad"),
    ({"joints.ext.lower": 1.9}, "joints.ext.lower: 1.9 m is not below upper = 1.8 m"),
    ({"joints.slew.law.kp_1_s": 8.0},
     "joints.slew.law.kp_1_s: 8.0 1/s with delay_s = 0.08 oscillates (gain times delay 0.64); "
     "at most 6.25 1/s"),
    ({"joints.slew.law.kp_1_s": -1.0}, "joints.slew.law.kp_1_s: -1 1/s is outside 0.05..50 1/s"),
    ({"joints.slew.law.stop_band": 0.17},
     "joints.slew.law.stop_band: 0.17 rad is outside 1e-05..0.05 rad; was it given in deg?"),
    ({"joints.slew.valve.deadband_plus_pct": 50.0},
     "joints.slew.valve.deadband_plus_pct: 50.0 % is outside the range from 0 to below 50 %"),
    ({"joints.slew.valve.deadband_minus_pct": -1.0},
     "joints.slew.valve.deadband_minus_pct: -1.0 % is outside the range from 0 to below 50 %"),
    ({"joints.slew.valve.signal": "Boom"},
     'joints.slew.valve.signal: "Boom" is no valve command; use one of Slew, Lift, Tilt, Ext, Rot'),
    ({"joints.lift.valve.signal": "Slew"},
     "joints.lift.valve.signal: Slew is already used by joints.slew.valve.signal; each joint needs its own"),
    ({"joints.tilt.encoder.node": 2},
     "joints.tilt.encoder.node: 2 is already used by joints.slew.encoder.node; each joint needs its own"),
    ({"joints.tilt.encoder.message": "EncSlew"},
     "joints.tilt.encoder.message: EncSlew is already used by joints.slew.encoder.message; "
     "each joint needs its own"),
    ({"joints.slew.encoder.node": 128}, "joints.slew.encoder.node: 128 is outside 1..127"),
    ({"joints.slew.encoder.message": "EncArm"},
     'joints.slew.encoder.message: "EncArm" is no encoder message; '
     'use one of EncSlew, EncLift, EncTilt, EncExt, EncRot'),
    ({"joints.slew.encoder.device_type": 0x00010191},
     "joints.slew.encoder.device_type: 0x00010191 is no CiA 406 encoder; "
     "the low half of object 1000h must be 0x0196"),
    ({"joints.slew.encoder.zero_counts": 16384},
     "joints.slew.encoder.zero_counts: 16384 is outside 0..16383"),
    ({"joints.slew.encoder.noise": 2.0},
     "joints.slew.encoder.noise: 2 rad is outside 0..0.05 rad; was it given in deg?"),
    ({"joints.slew.encoder.total_counts": 8200, "joints.slew.encoder.zero_counts": 4100},
     "joints.slew.encoder.total_counts: 8200 counts of 0.000383495 rad wrap at +-1.572 rad, "
     "inside the joint's limits -1.74533..1.74533 rad"),
    ({"joints.ext.encoder.total_counts": 204800},
     "joints.ext.encoder.total_counts: 204800 counts of 5e-06 m are shorter than "
     "the joint's range 0.13..1.8 m"),
    ({"joints.ext.kind": "revolute"}, 'joints.ext.kind: "revolute" cannot be; this joint is prismatic'),
    ({"bunk.floor_z_m": -1.5},
     "bunk.floor_z_m: -1.5 m is below the ground at -1.39 m; a bunk floor is at or above it"),
    ({"timeouts.lease_max_ms": 5000}, "timeouts.lease_max_ms: 5000 ms is outside 20..500 ms"),
    ({"rate_hz": 300}, "rate_hz: 300 Hz gives no whole microseconds; use for example 100, 200 or 250"),
    ({"rate_hz": 0}, "rate_hz: 0 Hz is outside 50..1000 Hz"),
    ({"crane_bus": "can 0"},
     'crane_bus: "can 0" is not a plain name; use a to z, 0 to 9 and _, a letter first'),
    ({"machine_bus": "crane0"},
     'machine_bus: "crane0" is the crane bus; the two buses need different names'),
    ({"grapple.tongs.half_gap_m": [0.7, 0.1]},
     "grapple.tongs.half_gap_m: 2 values for 6 angles; one for each angle_rad"),
    ({"grapple.tongs.angle_rad": [0.1, 0.30, 0.60, 1.00, 1.222, 2.234]},
     "grapple.tongs.angle_rad: needs at least two angles, starting with 0.0 (fully open)"),
    ({"grapple.tongs.angle_rad": [0.0, 0.60, 0.30, 1.00, 1.222, 2.234]},
     "grapple.tongs.angle_rad: must rise from row to row"),
    ({"grapple.tongs.half_gap_m": [0.733, 0.577, 0.6, 0.137, 0.001, -0.368]},
     "grapple.tongs.half_gap_m: must fall from row to row (angle 0 is fully open)"),
    ({"workspace.pick_center_m": [0.0, 8.0]},
     "workspace.pick_center_m: 8.00 m from the slew axis; the crane reaches 6.95 m"),
    ({"cameras.stick.link": "front"},
     'cameras.stick.link: "front" is no link of this machine; use one of base, boom, stick'),
    ({"cameras.stick.model": " "}, "cameras.stick.model: is empty; write the maker's name of the camera"),
    ({"cameras.stick.rpy_rad": [0.0, 11.5, 0.0]},
     "cameras.stick.rpy_rad[1]: 11.5 rad is outside -6.28319..6.28319 rad; was it given in deg?"),
    ({"cameras.stick.cx_px": 1300.0}, "cameras.stick.cx_px: 1300 px is outside the picture, 0..1280 px"),
    ({"cameras.stick.cy_px": float("nan")}, "cameras.stick.cy_px: nan px is outside the picture, 0..720 px"),
    ({"cameras.stick.baseline_m": 120.0},
     "cameras.stick.baseline_m: 120 m is outside 0.01..2 m; was it given in mm?"),
    ({"cameras.stick.depth_min_m": 20.0},
     "cameras.stick.depth_min_m: 20.0 m is not below depth_max_m = 20.0 m"),
]  # fmt: skip
DRIVING = [
    ({"machine_bus": DELETE}, "machine_bus: missing; a machine with a carrier drives over its machine bus"),
    ({"carrier.trak_width_m": 2.1},
     'carrier.trak_width_m: unknown key; did you mean "track_width_m"?'),
    ({"carrier.articulation_limit_rad": 35.0},
     "carrier.articulation_limit_rad: 35 rad is outside 0.05..1.2 rad; was it given in deg?"),
    ({"carrier.crane_base_m": [-0.4, float("inf"), 0.68]},
     "carrier.crane_base_m[1]: inf m is outside -5..5 m"),
    ({"carrier.site_lat_deg": 196.0}, "carrier.site_lat_deg: 196 deg is outside -85..85 deg"),
    ({"carrier.antenna_aux_m": [0.5, 0.0, 2.0]},
     "carrier.antenna_aux_m: 0.10 m from antenna_main_m gives no heading; at least 0.3 m apart"),
    ({"carrier.arm_travel_m": 1.10},
     "carrier.arm_travel_m: the hub would stand -0.15..0.95 m below its pivot; an arm of 1.00 m reaches "
     "-0.90..0.90 m"),
    ({"carrier.arm_transport_m": 0.7},
     "carrier.arm_transport_m: 0.7 m is above the travel of arm_travel_m = 0.6 m"),
    ({"carrier.wheel_width_m": 1.4, "carrier.track_width_m": 1.4},
     "carrier.wheel_width_m: wheels 1.4 m wide overlap at track_width_m = 1.4 m"),
    ({"carrier.front_axle_m": 0.9, "carrier.rear_axle_m": 0.6},
     "carrier.articulation_limit_rad: at 0.610865 rad the inner wheels overlap by 0.44 m; "
     "bend less or set the axles farther apart"),
    ({"carrier.cruise_speed_m_s": 2.3},
     "carrier.cruise_speed_m_s: 2.3 m/s is above speed_limit_m_s = 1.0 m/s"),
    ({"carrier.tilt_limit_rad": 17.0}, "carrier.tilt_limit_rad: 17 rad is outside 0.05..0.6 rad; was it given in deg?"),
    ({"carrier.drive_acceleration_m_s2": 400.0},
     "carrier.drive_acceleration_m_s2: 400 m/s^2 is outside 0.05..3 m/s^2; was it given in mm/s^2?"),
    ({"carrier.steer_valve.full_speed_minus": 0.1},
     "carrier.steer_valve.full_speed_minus: 0.1 rad/s is less than articulation_rate_limit_rad_s = 0.21; "
     "it cannot follow"),
    ({"carrier.arm_valve.deadband_plus_pct": 60.0},
     "carrier.arm_valve.deadband_plus_pct: 60.0 % is outside the range from 0 to below 50 %"),
    ({"carrier.arm_kp_1_s": 10.0},
     "carrier.arm_kp_1_s: 10.0 1/s with delay_s = 0.08 oscillates (gain times delay 0.80); at most 6.25 1/s"),
    ({"carrier.articulation_encoder.message": "EncRot"},
     'carrier.articulation_encoder.message: "EncRot" is no encoder message; use one of EncArtic'),
    ({"carrier.articulation_encoder.node": 3},
     "carrier.articulation_encoder.node: 3 is already used by joints.lift.encoder.node; "
     "each encoder needs its own"),
    ({"joints.ext.encoder.message": "EncArtic"},
     'joints.ext.encoder.message: "EncArtic" is no encoder message; '
     'use one of EncSlew, EncLift, EncTilt, EncExt, EncRot'),
]  # fmt: skip


@pytest.mark.parametrize(("changes", "sentence"), VALUES, ids=lambda v: "")
def test_wrong_values(tmp_path, changes, sentence):
    assert problems(tmp_path, changes) == [sentence]


@pytest.mark.parametrize(("changes", "sentence"), DRIVING, ids=lambda v: "")
def test_wrong_carriers(tmp_path, changes, sentence):
    assert problems(tmp_path, changes, AORO) == [sentence]


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"head_nm_m": 2e5, "pin_nm_m": 1e3}, "sag.head_nm_m: 200000 Nm/m is outside 0..100000 Nm/m"),
        ({"load_rad_nm": -1e-6}, "sag.load_rad_nm: -1e-06 rad/Nm is outside 0..1e-05 rad/Nm"),
        (
            {"pin_rad_m": 0.015},
            "sag.pin_rad_m: the empty crane would lean 0.099 rad at full reach, with head_rad_m and rest_rad; at most "
            "0.06 rad; survey it anew",
        ),
        (
            {"pin_nm_m": 2000.0},
            "sag.head_nm_m: the moment of the empty crane needs head_nm_m and pin_nm_m; give both or neither",
        ),
    ],
    ids=lambda v: "",
)
def test_a_sag_that_no_column_has_is_refused(tmp_path, changes, sentence):
    assert problems(tmp_path, {"sag": {**SAG, **changes}}) == [sentence]


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"gain": 3.0}, "imu.gain: 3 is outside 0..1.5"),
        ({"pendulum_m": 800.0}, "imu.pendulum_m: 800 m is outside 0.2..5 m; was it given in mm?"),
        ({"pin_speed_m_s": 120.0}, "imu.pin_speed_m_s: 120 m/s is outside 0.01..0.5 m/s; was it given in mm/s?"),
        ({"dead_zone_rad": 0.8}, "imu.dead_zone_rad: 0.8 rad is outside 0.003..0.1 rad; was it given in deg?"),
        ({"node": 0}, "imu.node: 0 is outside 1..127"),
        ({"message": "PressC"}, 'imu.message: "PressC" is no message of a sensor on the grapple; use GrappleImu'),
        ({"node": 3}, "imu.node: 3 is already used by joints.lift.encoder.node; the sensor needs its own"),
        ({"node": 7}, "imu.node: 7 is already used by carrier.articulation_encoder.node; the sensor needs its own"),
    ],
    ids=lambda v: "",
)
def test_an_imu_that_no_grapple_has_is_refused(tmp_path, changes, sentence):
    assert problems(tmp_path, {"imu": {**IMU, **changes}}, AORO) == [sentence]


def test_a_speed_in_degrees_is_named_and_so_is_what_the_valve_gives(tmp_path):
    found = problems(tmp_path, {"joints.slew.speed_limit": 20.0})
    assert found == [
        "joints.slew.speed_limit: 20 rad/s is outside 0.005..3.5 rad/s; was it given in deg/s?",
        "joints.slew.valve.full_speed_plus: 0.5 rad/s is less than speed_limit = 20.0; it cannot follow",
        "joints.slew.valve.full_speed_minus: 0.5 rad/s is less than speed_limit = 20.0; it cannot follow",
    ]


def test_encoder_kind_must_match_message_and_joint(tmp_path):
    found = problems(tmp_path, {"joints.ext.encoder.kind": "rotary"})
    assert 'joints.ext.encoder.message: "EncExt" carries a linear position but kind is "rotary"' in found
    assert 'joints.ext.encoder.kind: "rotary" on a prismatic joint; it needs a linear encoder' in found
    found = problems(tmp_path, {"joints.slew.encoder.kind": "linear"})
    assert 'joints.slew.encoder.kind: "linear" on a revolute joint; it needs a rotary encoder' in found


def test_a_delay_in_ms_is_named_before_its_gain(tmp_path):
    found = problems(tmp_path, {"joints.slew.valve.delay_s": 80.0})
    assert "joints.slew.valve.delay_s: 80 s is outside 0..0.5 s; was it given in ms?" in found


def test_all_problems_come_at_once(tmp_path):
    found = problems(
        tmp_path,
        {"timeouts.lease_max_ms": 5000, "rate_hz": 300, "joints.lift.lower": 2.0, "name": "My crane"},
    )
    assert [line.split(":")[0] for line in found] == [
        "timeouts.lease_max_ms", "name", "rate_hz", "joints.lift.lower",
    ]  # fmt: skip
