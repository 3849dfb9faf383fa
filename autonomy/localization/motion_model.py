"""The filter's model: state transition of an articulated machine, and the measurements of its antennas.


State (``State``): centre of the front axle [m] and yaw of the front half [rad] in the plane; curvature [1/m] and
direction [rad] added by slip; scale error of the wheel speed; error of the receiver's heading [rad]; slowly varying
position error of the receiver [m]; offset of the main antenna, ahead and to the left [m]; downhill drift of the
direction per radian of lean.  Without slip (docs/reference/machines.md section 7.1)

    x' = v cos psi,  y' = v sin psi,  psi' = (v sin g + lr g') / (lf cos g + lr)

with the speed v of the front axle and the articulation g.  Slip noise grows with the distance driven, so a standing
machine does not become uncertain.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Final

import numpy as np

from machine.geometry.carrier import Point
from machine.profile import Carrier

Array = np.ndarray


class State(IntEnum):
    """Indices of the state vector."""

    X = 0
    Y = 1
    YAW = 2
    CURVE = 3
    SIDE = 4
    SCALE = 5
    HEADING = 6
    WANDER_X = 7
    WANDER_Y = 8
    ANTENNA_X = 9
    ANTENNA_Y = 10
    SLIDE = 11


SIZE: Final = len(State)


@dataclass(frozen=True, slots=True)
class GaussMarkov:
    """A first-order Gauss-Markov process: standard deviation, and correlation length [m] or time [s]."""

    sigma: float
    over: float

    def step(self, by: float) -> tuple[float, float]:
        """Decay factor and added variance after ``by`` m or s."""
        keep = math.exp(-by / self.over)
        return keep, self.sigma**2 * (1.0 - keep * keep)


@dataclass(frozen=True, slots=True)
class NoiseModel:
    """Noise of the filter; all of it assumed.  ``fixes`` by method of PGN 129029: white and slowly varying horizontal
    error of a position, root mean square [m].
    """

    curve: GaussMarkov = GaussMarkov(0.02, 4.0)
    side: GaussMarkov = GaussMarkov(0.02, 6.0)
    slide: GaussMarkov = GaussMarkov(0.25, 200.0)
    scale: GaussMarkov = GaussMarkov(0.12, 30.0)
    distance_m: float = 0.01
    """Position noise per square root of a metre driven."""
    distance_yaw_rad: float = 0.003
    """Yaw noise per square root of a metre driven."""
    standstill_m: float = 0.002
    """Position noise per square root of a second: the machine rocks while its crane works."""
    heading_start_rad: float = 0.015
    heading_rad: float = 2e-5
    """Noise of the heading error per square root of a second."""
    antenna_m: float = 0.02
    attitude_rad: float = 0.004
    articulation_rad: float = 0.004
    """Of the articulation encoder, including its zero."""
    phase_m: float = 0.003
    """Per antenna, for a dual-antenna heading."""
    turn_rad_s: float = 0.006
    wander_s: float = 60.0
    fixes: dict[int, tuple[float, float]] = field(
        default_factory=lambda: {1: (0.5, 2.5), 2: (0.2, 0.8), 4: (0.012, 0.010), 5: (0.07, 0.35)}
    )


@dataclass(frozen=True, slots=True)
class Odometry:
    """Motion since the last step: time [s], horizontal distance of the wheels [m], articulation before and now [rad],
    roll of the front half, + right side down [rad].
    """

    seconds: float
    distance_m: float
    articulation_before_rad: float
    articulation_rad: float
    roll_rad: float = 0.0


def turned_without_slip(carrier: Carrier, odometry: Odometry, distance_m: float) -> float:
    """Turn of the front half over a distance ``distance_m`` of its axle, without slip [rad]."""
    articulation = 0.5 * (odometry.articulation_before_rad + odometry.articulation_rad)
    swing = odometry.articulation_rad - odometry.articulation_before_rad
    lf, lr = carrier.front_axle_m, carrier.rear_axle_m
    return (distance_m * math.sin(articulation) + lr * swing) / (lf * math.cos(articulation) + lr)


def predicted_state(carrier: Carrier, noise: NoiseModel, x: Array, odometry: Odometry) -> tuple[Array, Array, Array]:
    """State (12,), Jacobian (12, 12) and process noise (12, 12) one step later."""
    s, d = State, odometry
    distance = d.distance_m * (1.0 + x[s.SCALE])
    turned = turned_without_slip(carrier, d, distance) + x[s.CURVE] * distance
    course = x[s.YAW] + 0.5 * turned + drift_rad(x, d.roll_rad)
    c, si = math.cos(course), math.sin(course)
    out = x.copy()
    out[s.X] += distance * c
    out[s.Y] += distance * si
    out[s.YAW] += turned
    jacobian = np.eye(SIZE)
    articulation = 0.5 * (d.articulation_before_rad + d.articulation_rad)
    from_distance = (
        math.sin(articulation) / (carrier.front_axle_m * math.cos(articulation) + carrier.rear_axle_m) + x[s.CURVE]
    )
    for place, of_turn, of_length in ((s.CURVE, distance, 0.0), (s.SCALE, from_distance * d.distance_m, d.distance_m)):
        jacobian[s.YAW, place] = of_turn
        jacobian[s.X, place] = c * of_length - 0.5 * distance * si * of_turn
        jacobian[s.Y, place] = si * of_length + 0.5 * distance * c * of_turn
    for place, of_course in ((s.YAW, 1.0), (s.SIDE, 1.0), (s.SLIDE, -d.roll_rad)):
        jacobian[s.X, place], jacobian[s.Y, place] = -of_course * distance * si, of_course * distance * c
    driven = abs(d.distance_m)
    added = np.zeros(SIZE)
    added[[s.X, s.Y]] = noise.distance_m**2 * driven + noise.standstill_m**2 * d.seconds
    added[s.YAW] = noise.distance_yaw_rad**2 * driven
    added[s.HEADING] = noise.heading_rad**2 * d.seconds
    for place, drift in ((s.CURVE, noise.curve), (s.SIDE, noise.side), (s.SCALE, noise.scale), (s.SLIDE, noise.slide)):
        keep, added[place] = drift.step(driven)
        out[place] *= keep
        jacobian[place, place] = keep
    return out, jacobian, np.diag(added)


def drift_rad(x: Array, roll_rad: float) -> float:
    """Direction of the front axle's motion relative to the front half, + left [rad]."""
    return float(x[State.SIDE] - x[State.SLIDE] * roll_rad)


def tilt(roll_rad: float, pitch_rad: float) -> Array:
    """Rotation (3, 3) of a half without its yaw: roll + right side down, pitch + nose up."""
    cr, sr, cp, sp = math.cos(roll_rad), math.sin(roll_rad), math.cos(pitch_rad), math.sin(pitch_rad)
    roll = np.array([[1.0, 0.0, 0.0], [0.0, cr, -sr], [0.0, sr, cr]])
    rotation: Array = np.array([[cp, 0.0, -sp], [0.0, 1.0, 0.0], [sp, 0.0, cp]]) @ roll
    return rotation


def axle_m(carrier: Carrier, height_m: float) -> Point:
    """Centre of the front axle, between the hubs, in the front frame."""
    return carrier.front_axle_m, 0.0, -(carrier.arm_drop_low_m + height_m)


def antenna_reach(carrier: Carrier, roll_rad: float, pitch_rad: float, height_m: float) -> Array:
    """From the centre of the front axle to the main antenna (3,): along the front's yaw, to its left, and up [m]."""
    lever = np.subtract(carrier.antenna_main_m, axle_m(carrier, height_m))
    return tilt(roll_rad, pitch_rad) @ lever


def predicted_antenna(x: Array, reach: Array) -> tuple[Array, Array]:
    """Predicted position of the main antenna (2,) and its Jacobian (2, 12)."""
    s = State
    c, si = math.cos(x[s.YAW]), math.sin(x[s.YAW])
    ahead, left = reach[0] + x[s.ANTENNA_X], reach[1] + x[s.ANTENNA_Y]
    shown = np.array(
        [
            x[s.X] + c * ahead - si * left + x[s.WANDER_X],
            x[s.Y] + si * ahead + c * left + x[s.WANDER_Y],
        ]
    )
    jacobian = np.zeros((2, SIZE))
    jacobian[:, [s.X, s.Y]] = jacobian[:, [s.WANDER_X, s.WANDER_Y]] = np.eye(2)
    jacobian[:, s.YAW] = -si * ahead - c * left, c * ahead - si * left
    jacobian[:, [s.ANTENNA_X, s.ANTENNA_Y]] = [[c, -si], [si, c]]
    return shown, jacobian


def front_attitude(roll_rad: float, pitch_rad: float, articulation_rad: float) -> tuple[float, float]:
    """Roll and pitch of the front half from those of the rear, for a rigid articulation axis."""
    down = tilt(roll_rad, pitch_rad)[2]
    c, s = math.cos(articulation_rad), math.sin(articulation_rad)
    ahead, left, up = c * down[0] + s * down[1], -s * down[0] + c * down[1], down[2]
    return math.atan2(left, up), math.asin(max(-1.0, min(1.0, ahead)))
