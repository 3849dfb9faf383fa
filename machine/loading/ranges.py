"""The range of every number in a profile, and the sentence for one that is outside.

The ranges are generous physical bounds of road-going loader and forwarder cranes, so that they catch a wrong unit or
a slipped digit and never a real machine.  NaN and infinity are outside every range.
"""

from __future__ import annotations

from collections.abc import Iterator
from math import pi, radians
from typing import Any, Final

import msgspec

from machine.profile import (
    Bunk,
    Camera,
    Carrier,
    CarrierValve,
    Encoder,
    Grapple,
    Hydraulics,
    Imu,
    Kinematics,
    Law,
    Profile,
    Sag,
    Timeouts,
    TongTable,
    Valve,
    Workspace,
)

TURN_RAD: Final = 2.0 * pi

Bounds = tuple[float, float, str]
DEPTH_SCALE: Final[Bounds] = (0.9, 1.1, "")
_LENGTH: Final[Bounds] = (0.3, 15.0, "m")
_OFFSET: Final[Bounds] = (-2.0, 2.0, "m")
ANGLE: Final[Bounds] = (-TURN_RAD, TURN_RAD, "rad")
_PLACE: Final[Bounds] = (-20.0, 20.0, "m")
_HEIGHT: Final[Bounds] = (-5.0, 5.0, "m")

_BOUNDS: Final[dict[type[msgspec.Struct], dict[str, Bounds]]] = {
    Profile: {"rate_hz": (50, 1000, "Hz")},
    Kinematics: {
        "d1_m": (0.0, 10.0, "m"),
        "a1_m": _OFFSET,
        "theta1_offset_rad": ANGLE,
        "a2_m": _LENGTH,
        "theta2_offset_rad": ANGLE,
        "a3_m": _OFFSET,
        "theta3_offset_rad": ANGLE,
        "d4_m": _LENGTH,
        "hanger_to_fork_m": (0.0, 2.0, "m"),
        "fork_to_rotator_m": (0.0, 2.0, "m"),
        "rotator_to_tong_pivot_m": (0.0, 2.0, "m"),
    },
    Encoder: {
        "node": (1, 127, ""),
        "device_type": (0, 2**32 - 1, ""),
        "total_counts": (2, 2**32, "counts"),
        "unit_per_count": (1e-9, 0.1, "per count"),
        "zero_counts": (-(2**31), 2**32 - 1, "counts"),
    },
    Valve: {
        "delay_s": (0.0, 0.5, "s"),
        "lag_s": (0.0, 0.3, "s"),
        "oil_s": (0.0, 0.5, "s"),
        "flow_plus": (1e-6, 0.1, "m^3 per unit"),
        "flow_minus": (1e-6, 0.1, "m^3 per unit"),
        "exponent": (0.5, 3.0, ""),
        "hysteresis_pct": (0.0, 10.0, "%"),
        "lever": (0.2, 5.0, ""),
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
    TongTable: {
        "angle_rad": (0.0, TURN_RAD, "rad"),
        "half_gap_m": _OFFSET,
        "tip_below_pin_m": (0.0, 3.0, "m"),
    },
    Bunk: {
        "center_m": _PLACE,
        "yaw_rad": ANGLE,
        "length_m": (0.5, 15.0, "m"),
        "width_m": (0.3, 5.0, "m"),
        "floor_z_m": _HEIGHT,
        "stake_height_m": (0.0, 4.0, "m"),
    },
    Workspace: {"ground_z_m": _HEIGHT, "pick_center_m": _PLACE, "pick_half_size_m": (0.1, 10.0, "m")},
    Camera: {
        "position_m": _PLACE,
        "rpy_rad": ANGLE,
        "width_px": (16, 8192, "px"),
        "height_px": (16, 8192, "px"),
        "fx_px": (10.0, 20000.0, "px"),
        "fy_px": (10.0, 20000.0, "px"),
        "baseline_m": (0.01, 2.0, "m"),
        "rate_hz": (0.1, 240.0, "Hz"),
        "depth_min_m": (0.01, 100.0, "m"),
        "depth_max_m": (0.01, 100.0, "m"),
        "depth_scale": DEPTH_SCALE,
    },
    Carrier: {
        "front_axle_m": (0.5, 6.0, "m"),
        "rear_axle_m": (0.5, 6.0, "m"),
        "track_width_m": (0.8, 4.0, "m"),
        "wheel_radius_m": (0.2, 1.5, "m"),
        "wheel_width_m": (0.1, 1.5, "m"),
        "arm_length_m": (0.2, 3.0, "m"),
        "arm_drop_low_m": _OFFSET,
        "arm_travel_m": (0.05, 2.0, "m"),
        "arm_transport_m": (0.0, 2.0, "m"),
        "arm_kp_1_s": (0.05, 20.0, "1/s"),
        "arm_rate_limit_m_s": (0.005, 1.0, "m/s"),
        "arm_in_band_m": (0.001, 0.2, "m"),
        "articulation_limit_rad": (0.05, 1.2, "rad"),
        "articulation_rate_limit_rad_s": (0.01, 1.5, "rad/s"),
        "articulation_lag_s": (0.0, 2.0, "s"),
        "heading_kp_1_s": (0.05, 20.0, "1/s"),
        "cruise_speed_m_s": (0.05, 5.0, "m/s"),
        "speed_limit_m_s": (0.05, 5.0, "m/s"),
        "drive_acceleration_m_s2": (0.05, 3.0, "m/s^2"),
        "tilt_limit_rad": (0.05, 0.6, "rad"),
        "crane_base_m": _HEIGHT,
        "crane_yaw_rad": ANGLE,
        "antenna_main_m": _HEIGHT,
        "antenna_aux_m": _HEIGHT,
        "site_lat_deg": (-85.0, 85.0, "deg"),
        "site_lon_deg": (-180.0, 180.0, "deg"),
    },
    CarrierValve: {"delay_s": (0.0, 0.5, "s")},
    Timeouts: {
        "lease_max_ms": (20, 500, "ms"),
        "stop_ramp_ms": (10, 300, "ms"),
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


def out_of_range(struct: msgspec.Struct, path: str) -> Iterator[str]:
    """The sentence of every number of a profile, or of a part at the key path ``path``, that its table refuses."""
    bounds = _BOUNDS.get(type(struct), {})
    for name in struct.__struct_fields__:
        value: Any = getattr(struct, name)
        where = f"{path}{name}"
        if isinstance(value, msgspec.Struct):
            yield from out_of_range(value, f"{where}.")
        elif isinstance(value, dict):
            for key, item in value.items():
                yield from out_of_range(item, f"{where}.{key}.")
        elif name in bounds:
            yield from _bounded_all(where, value, bounds[name])


def _bounded_all(path: str, value: Any, bounds: Bounds) -> Iterator[str]:
    if isinstance(value, tuple):
        for i, item in enumerate(value):
            yield from bounded(f"{path}[{i}]", item, bounds)
    else:
        yield from bounded(path, value, bounds)


def bounded(path: str, value: float, bounds: Bounds) -> Iterator[str]:
    """The sentence for a number outside (lowest, highest, unit); it guesses the unit that was meant."""
    low, high, unit = bounds
    if low <= value <= high:
        return
    factor, slip = _SLIPS.get(unit, (0.0, ""))
    hint = f"; was it given in {slip}?" if factor and low <= value * factor <= high else ""
    unit = f" {unit}" if unit else ""
    yield f"{path}: {value:.6g}{unit} is outside {low:.6g}..{high:.6g}{unit}{hint}"
