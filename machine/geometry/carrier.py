"""Geometry of the articulated carrier: swing arms, steering and the frames of its two halves.

Inputs are the profile's ``Carrier`` and SI numbers; every function is pure.  Frames ``rear`` and ``front`` share the
articulation axis (origin on it, x forward, y left, z up, z = 0 at the pivots of the swing arms); the articulation
angle is positive when the front is turned left against the rear.  The front arms lead and the rear arms trail:
their hubs are ``front_axle_m`` ahead of and ``rear_axle_m`` behind the axis at the transport height, and slightly
closer at every height at which the arm is steeper.  Heights count from the lowest position of the frame.
"""

from __future__ import annotations

from math import asin, cos, inf, pi, sin, sqrt
from typing import Final

from machine.profile import Carrier

Point = tuple[float, float, float]

ARMS: Final = ("arm_fl", "arm_fr", "arm_rl", "arm_rr")
"""Swing arms: front left, front right, rear left, rear right."""


def arm_angle_from_height(carrier: Carrier, height_m: float) -> float:
    """Compute the angle of a swing arm below the horizontal [rad] that raises the frame by ``height_m``.

    Raises:
        ValueError: the arm is too short for this height.
    """
    share = (carrier.arm_drop_low_m + height_m) / carrier.arm_length_m
    if not -1.0 <= share <= 1.0:
        raise ValueError(
            f"height {height_m:.3f} m is out of reach of a swing arm of {carrier.arm_length_m:.2f} m; "
            f"its travel is 0..{carrier.arm_travel_m:.2f} m"
        )
    return asin(share)


def height_from_arm_angle(carrier: Carrier, angle_rad: float) -> float:
    """Compute the inverse of ``arm_angle_from_height`` [m]."""
    return carrier.arm_length_m * sin(angle_rad) - carrier.arm_drop_low_m


def pivot_height_m(carrier: Carrier, height_m: float) -> float:
    """Compute the height of the pivots' plane above level ground with every arm at ``height_m`` [m]."""
    return carrier.wheel_radius_m + carrier.arm_drop_low_m + height_m


def arm_pivot_m(carrier: Carrier, arm: str) -> Point:
    """Compute the pivot of one of ``ARMS`` in the frame of its half [m]; y is the middle plane of the wheel."""
    transport = arm_angle_from_height(carrier, carrier.arm_transport_m)
    axle, ahead = _axle(carrier, arm)
    return ahead * (axle - carrier.arm_length_m * cos(transport)), _side_m(carrier, arm), 0.0


def hub_m(carrier: Carrier, arm: str, height_m: float) -> Point:
    """Compute the wheel hub of one of ``ARMS`` in the frame of its half at a height of that arm [m]."""
    x, y, _ = arm_pivot_m(carrier, arm)
    reach = carrier.arm_length_m * cos(arm_angle_from_height(carrier, height_m))
    return x + _axle(carrier, arm)[1] * reach, y, -(carrier.arm_drop_low_m + height_m)


def turning_radius_m(carrier: Carrier, articulation_rad: float) -> float:
    """Compute the radius of the circle of the front axle's middle at a constant articulation [m]; infinite when
    straight (docs/reference/machines.md section 7.1).
    """
    bend = abs(sin(articulation_rad))
    return (carrier.front_axle_m * cos(articulation_rad) + carrier.rear_axle_m) / bend if bend else inf


def heading_rate_rad_s(
    carrier: Carrier, speed_m_s: float, articulation_rad: float, articulation_rate_rad_s: float
) -> float:
    """Compute the rate of the front half's heading without slip [rad/s]; ``speed_m_s`` is the speed of the front axle
    (docs/reference/machines.md section 7.1).
    """
    turned = speed_m_s * sin(articulation_rad) + carrier.rear_axle_m * articulation_rate_rad_s
    return turned / (carrier.front_axle_m * cos(articulation_rad) + carrier.rear_axle_m)


def rear_from_front(articulation_rad: float, point: Point) -> Point:
    """Transform a point of the front frame to the rear frame [m]."""
    return _turned(point, articulation_rad)


def rear_from_base(carrier: Carrier, point: Point) -> Point:
    """Transform a point of the crane's base frame to the rear frame [m]."""
    x, y, z = _turned(point, carrier.crane_yaw_rad)
    bx, by, bz = carrier.crane_base_m
    return x + bx, y + by, z + bz


def base_from_rear(carrier: Carrier, point: Point) -> Point:
    """Transform a point of the rear frame to the crane's base frame [m]."""
    bx, by, bz = carrier.crane_base_m
    return _turned((point[0] - bx, point[1] - by, point[2] - bz), -carrier.crane_yaw_rad)


def axis_from_antenna(carrier: Carrier, antenna_m: tuple[float, float], heading_rad: float) -> tuple[float, float]:
    """Compute the articulation axis [m] east and north of where the place of the main antenna counts from.

    ``heading_rad`` is that of the front half, clockwise from true north.
    """
    x, y, _ = _turned(carrier.antenna_main_m, 0.5 * pi - heading_rad)
    return antenna_m[0] - x, antenna_m[1] - y


def wheel_gap_m(carrier: Carrier, articulation_rad: float) -> float:
    """Compute the free length between front and rear wheel on the inner side of a bend at the transport height [m]; 0
    or less means that they touch.
    """
    side = 0.5 * carrier.track_width_m
    x, y, _ = rear_from_front(abs(articulation_rad), (carrier.front_axle_m, side, 0.0))
    apart = sqrt((x + carrier.rear_axle_m) ** 2 + (y - side) ** 2)
    return apart - 2.0 * carrier.wheel_radius_m


def _axle(carrier: Carrier, arm: str) -> tuple[float, float]:
    return (carrier.front_axle_m, 1.0) if arm.startswith("arm_f") else (carrier.rear_axle_m, -1.0)


def _side_m(carrier: Carrier, arm: str) -> float:
    return 0.5 * carrier.track_width_m * (1.0 if arm.endswith("l") else -1.0)


def _turned(point: Point, angle_rad: float) -> Point:
    c, s = cos(angle_rad), sin(angle_rad)
    return c * point[0] - s * point[1], s * point[0] + c * point[1], point[2]
