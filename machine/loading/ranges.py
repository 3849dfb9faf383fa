"""The range of every number in a profile, and the problem of a number outside its range.

The ranges are generous physical bounds of loader and forwarder cranes: they catch a wrong unit or a slipped digit,
never a real machine.  NaN and infinity are outside every range.
"""

from __future__ import annotations

from collections.abc import Iterator
from math import pi, radians
from typing import Any, Final

import msgspec

from machine.loading.structure import Problem
from machine.profile import (
    Bunk,
    Camera,
    Carrier,
    CarrierValve,
    Encoder,
    Grapple,
    Hydraulics,
    Imu,
    JawTable,
    KeepOut,
    Kinematics,
    Law,
    Plc,
    Profile,
    Sag,
    Stability,
    Timeouts,
    Valve,
    Workspace,
)

TURN_RAD: Final = 2.0 * pi

Range = tuple[float, float, str]
"""Lowest value, highest value, unit."""
DEPTH_SCALE_RANGE: Final[Range] = (0.9, 1.1, "")
_LENGTH_RANGE: Final[Range] = (0.3, 15.0, "m")
_OFFSET_RANGE: Final[Range] = (-2.0, 2.0, "m")
ANGLE_RANGE: Final[Range] = (-TURN_RAD, TURN_RAD, "rad")
_PLACE_RANGE: Final[Range] = (-20.0, 20.0, "m")
_HEIGHT_RANGE: Final[Range] = (-5.0, 5.0, "m")

_RANGES: Final[dict[type[msgspec.Struct], dict[str, Range]]] = {
    Profile: {"rate_hz": (50, 1000, "Hz")},
    Kinematics: {
        "d1_m": (0.0, 10.0, "m"),
        "a1_m": _OFFSET_RANGE,
        "theta1_offset_rad": ANGLE_RANGE,
        "a2_m": _LENGTH_RANGE,
        "theta2_offset_rad": ANGLE_RANGE,
        "a3_m": _OFFSET_RANGE,
        "theta3_offset_rad": ANGLE_RANGE,
        "d4_m": _LENGTH_RANGE,
        "hanger_to_fork_m": (0.0, 2.0, "m"),
        "fork_to_rotator_m": (0.0, 2.0, "m"),
        "rotator_to_tong_pivot_m": (0.0, 2.0, "m"),
    },
    Encoder: {
        "node": (1, 127, ""),
        "device_type": (0, 2**32 - 1, ""),
        "total_counts": (2, 2**32 - 1, "counts"),
        "unit_per_count": (1e-9, 0.1, "per count"),
        "zero_counts": (-(2**31), 2**32 - 1, "counts"),
    },
    Valve: {
        "delay_s": (0.0, 0.5, "s"),
        "lag_s": (0.0, 0.3, "s"),
        "oil_s": (0.0, 0.5, "s"),
        "flow_plus": (1e-6, 0.1, "m^3 per unit"),
        "flow_minus": (1e-6, 0.1, "m^3 per unit"),
        "exponent": (0.5, 1.6, ""),
        "hysteresis_pct": (0.0, 10.0, "%"),
        "lever_at": (-20.0, 20.0, ""),
        "lever": (0.2, 1.4, ""),
    },
    Law: {
        "kp_1_s": (0.05, 50.0, "1/s"),
        "kd": (0.0, 1.0, ""),
        "damping_per_bar": (0.0, 0.01, "unit/s per bar"),
        "velocity_filter_s": (0.001, 0.5, "s"),
    },
    Hydraulics: {"pump_flow_m3_s": (1e-4, 2e-2, "m^3/s")},
    Sag: {
        "head_rad_m": (-0.02, 0.02, "rad/m"),
        "pin_rad_m": (-0.02, 0.02, "rad/m"),
        "rest_rad": (-0.1, 0.1, "rad"),
        "load_rad_nm": (0.0, 1e-5, "rad/Nm"),
        "head_nm_m": (0.0, 1e5, "Nm/m"),
        "pin_nm_m": (0.0, 1e5, "Nm/m"),
    },
    KeepOut: {"center_m": _PLACE_RANGE, "half_m": (0.0, 20.0, "m"), "yaw_rad": ANGLE_RANGE},
    Stability: {
        "head_kg": (0.0, 5000.0, "kg"),
        "pin_kg": (0.0, 5000.0, "kg"),
        "edge_m": _OFFSET_RANGE,
        "stabilising_nm": (1e3, 1e6, "Nm"),
        "slope_nm_rad": (0.0, 1e6, "Nm/rad"),
        "share": (0.1, 1.0, ""),
    },
    Imu: {
        "node": (1, 127, ""),
        "gain": (0.0, 1.5, ""),
        "pendulum_m": (0.2, 5.0, "m"),
        "pin_speed_m_s": (0.01, 0.5, "m/s"),
        "dead_zone_rad": (0.003, 0.1, "rad"),
    },
    Grapple: {
        "close_time_s": (0.2, 20.0, "s"),
        "open_time_s": (0.2, 20.0, "s"),
        "hold_pressure_bar": (10.0, 350.0, "bar"),
    },
    JawTable: {
        "angle_rad": (0.0, TURN_RAD, "rad"),
        "half_gap_m": _OFFSET_RANGE,
        "tip_below_pin_m": (0.0, 3.0, "m"),
    },
    Bunk: {
        "center_m": _PLACE_RANGE,
        "yaw_rad": ANGLE_RANGE,
        "length_m": (0.5, 15.0, "m"),
        "width_m": (0.3, 5.0, "m"),
        "floor_z_m": _HEIGHT_RANGE,
        "stake_height_m": (0.0, 4.0, "m"),
    },
    Plc: {"sample_ms": (1.0, 10.0, "ms")},
    Workspace: {"ground_z_m": _HEIGHT_RANGE, "pick_center_m": _PLACE_RANGE, "pick_half_size_m": (0.1, 10.0, "m")},
    Camera: {
        "position_m": _PLACE_RANGE,
        "rpy_rad": ANGLE_RANGE,
        "width_px": (16, 8192, "px"),
        "height_px": (16, 8192, "px"),
        "fx_px": (10.0, 20000.0, "px"),
        "fy_px": (10.0, 20000.0, "px"),
        "baseline_m": (0.01, 2.0, "m"),
        "rate_hz": (0.1, 240.0, "Hz"),
        "depth_min_m": (0.01, 100.0, "m"),
        "depth_max_m": (0.01, 100.0, "m"),
        "depth_scale": DEPTH_SCALE_RANGE,
    },
    Carrier: {
        "front_axle_m": (0.5, 6.0, "m"),
        "rear_axle_m": (0.5, 6.0, "m"),
        "track_width_m": (0.8, 4.0, "m"),
        "wheel_radius_m": (0.2, 1.5, "m"),
        "wheel_width_m": (0.1, 1.5, "m"),
        "arm_length_m": (0.2, 3.0, "m"),
        "arm_drop_low_m": _OFFSET_RANGE,
        "arm_travel_m": (0.05, 2.0, "m"),
        "arm_transport_m": (0.0, 2.0, "m"),
        "arm_kp_1_s": (0.05, 20.0, "1/s"),
        "arm_rate_limit_m_s": (0.005, 1.0, "m/s"),
        "arm_in_band_m": (0.001, 0.2, "m"),
        "articulation_limit_rad": (0.05, 1.2, "rad"),
        "articulation_rate_limit_rad_s": (0.01, 1.0, "rad/s"),
        "articulation_lag_s": (0.01, 2.0, "s"),
        "heading_kp_1_s": (0.05, 20.0, "1/s"),
        "cruise_speed_m_s": (0.05, 2.0, "m/s"),
        "speed_limit_m_s": (0.05, 2.0, "m/s"),
        "drive_acceleration_m_s2": (0.05, 3.0, "m/s^2"),
        "tilt_limit_rad": (0.05, 0.6, "rad"),
        "crane_base_m": _HEIGHT_RANGE,
        "crane_yaw_rad": ANGLE_RANGE,
        "antenna_main_m": _HEIGHT_RANGE,
        "antenna_aux_m": _HEIGHT_RANGE,
        "site_lat_deg": (-85.0, 85.0, "deg"),
        "site_lon_deg": (-180.0, 180.0, "deg"),
    },
    CarrierValve: {"delay_s": (0.01, 0.5, "s")},
    Timeouts: {
        "lease_max_ms": (20, 500, "ms"),
        "stop_ramp_ms": (10, 200, "ms"),
        "operator_link_ms": (0, 1000, "ms"),
    },
}
_SLIPS: Final = {
    "m": (1e-3, "mm"),
    "rad": (radians(1.0), "deg"),
    "s": (1e-3, "ms"),
    "m/s": (1e-3, "mm/s"),
    "rad/s": (radians(1.0), "deg/s"),
    "m/s^2": (1e-3, "mm/s^2"),
    "rad/s^2": (radians(1.0), "deg/s^2"),
    "bar": (1e-5, "Pa"),
    "Hz": (1e9, "s per tick in ns"),
}
"""By unit: the factor from a unit that is often written by mistake, and its name."""


def out_of_range(struct: msgspec.Struct, path: str) -> Iterator[Problem]:
    """Report every number that its table refuses, of a profile or of a part at the key path ``path``."""
    ranges = _RANGES.get(type(struct), {})
    for name, key in zip(struct.__struct_fields__, struct.__struct_encode_fields__, strict=True):
        value: Any = getattr(struct, name)
        where = f"{path}{key}"
        if isinstance(value, msgspec.Struct):
            yield from out_of_range(value, f"{where}.")
        elif isinstance(value, dict):
            for key, item in value.items():
                yield from out_of_range(item, f"{where}.{key}.")
        elif name in ranges:
            yield from _check_all(where, value, ranges[name])


def _check_all(path: str, value: Any, allowed: Range) -> Iterator[Problem]:
    if isinstance(value, tuple):
        for i, item in enumerate(value):
            yield from check_range(f"{path}[{i}]", item, allowed)
    else:
        yield from check_range(path, value, allowed)


def check_range(path: str, value: float, allowed: Range) -> Iterator[Problem]:
    """Report a number outside ``allowed``; the sentence suggests the unit that may have been meant."""
    low, high, unit = allowed
    if low <= value <= high:
        return
    factor, slip = _SLIPS.get(unit, (0.0, ""))
    hint = f"; was it given in {slip}?" if factor and low <= value * factor <= high else ""
    unit = f" {unit}" if unit else ""
    text = f"{value:.6g}{unit} is outside {low:.6g}..{high:.6g}{unit}{hint}"
    yield Problem("profile.out-of-range", path, text)
