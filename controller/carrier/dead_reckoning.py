"""Dead reckoning of the carrier: the newest GNSS position and heading, propagated to every tick by odometry.

Between two samples (100 ms) the middle of the front axle moves along the heading of the front half with the measured
speed, and the heading turns by the articulation's kinematics.  Inputs are the received values of mach0 and the estimate
of the articulation; nothing is filtered.  A contradiction between a sample and the odometry is kept as ``finding``: a
jump, a heading that does not turn while the machine does, or one that points against the motion.

Angles are counter-clockwise from east; positions are metres east and north of the last position sample (latitude,
longitude).
"""

from __future__ import annotations

import math
from typing import Final

from controller.bus_io import Signal, or_nan
from controller.carrier.bus import CarrierInputs
from controller.estimation.joint_estimator import JointEstimator
from controller.laws.drive import east_north_m
from machine.geometry.carrier import ARMS, heading_rate_rad_s
from machine.profile import Carrier
from machine.status.reasons import Reason

N_ARMS: Final = len(ARMS)
MAX_JUMP_M: Final = 1.0
"""A position this far from the odometry stops the carrier at once, ..."""
MAX_REPEATED_JUMP_M: Final = 0.4
"""... one this far only when the next one is as well."""
MAX_JUMP_RAD: Final = 0.35
MAX_REPEATED_JUMP_RAD: Final = 0.12
FROZEN_SAMPLES_COUNT: Final = 5
"""A heading that stays the same to the last digit over this many samples while the machine turns is frozen."""
MIN_TURN_RAD_S: Final = 0.02
MIN_COURSE_SPEED_M_S: Final = 0.25
"""From this speed on the course over ground distinguishes forward from reverse."""
MIN_COURSE_SHARE: Final = 0.8
"""A machine that is slower over ground than this share of its wheels' speed slips: it may slide to any side, and its
mast rocks."""
MAX_COURSE_ERROR_RAD: Final = 1.2
"""Greatest angle between course and heading; beyond it the heading is wrong, ..."""
CROSSWISE_SAMPLES_COUNT: Final = 8
"""... after so many samples of the course (2 s): for half a second a front half that slides aside on rough ground moves
crosswise as fast as its wheels turn, ..."""
REVERSED_SAMPLES_COUNT: Final = 2
"""... and after so many where the antenna goes backwards as fast as that."""
MAX_BEND_RAD: Final = 1.2
"""No articulation bends further; an encoder value beyond it is not an angle."""
TRUE_REFERENCE: Final = 0
"""VesselHeading.Reference and CogSogRapidUpdate.CogReference: the only one of the four whose angle can be used."""
_NONE: Final = Reason.NONE
RTK_METHODS: Final = (4, 5)
"""Methods of PGN 129029 that are good enough to drive to a waypoint: RTK fixed and float."""


class DeadReckoning:
    """``yaw_rad`` of the front half and the front axle's position, NaN while unknown; ``finding`` of this tick."""

    __slots__ = (
        "_arms",
        "_axle_m",
        "_carrier",
        "_crosswise",
        "_frozen",
        "_heading",
        "_heading_off",
        "_heading_rad",
        "_inputs",
        "_latitude",
        "_longitude",
        "_method",
        "_middle_m",
        "_pitch",
        "_position_off",
        "_reference",
        "_reversed",
        "_roll",
        "_speed",
        "east_m",
        "finding",
        "heading_off_rad",
        "heights_m",
        "latitude_deg",
        "longitude_deg",
        "north_m",
        "position_off_m",
        "speed_m_s",
        "steering",
        "tilt_rad",
        "yaw_rad",
        "yaw_rate_rad_s",
    )

    def __init__(self, carrier: Carrier, inputs: CarrierInputs, steering: JointEstimator) -> None:
        self._carrier = carrier
        self._inputs = inputs
        self.steering = steering
        self._speed, self._roll, self._pitch = (
            Signal(inputs.vehicle, "Speed"),
            Signal(inputs.arms_b, "Roll"),
            Signal(inputs.arms_b, "Pitch"),
        )
        self._arms = [Signal(inputs.arms_a, f"Arm{i + 1}") for i in range(N_ARMS)]
        self._heading, self._reference = Signal(inputs.heading, "Heading"), Signal(inputs.heading, "Reference")
        self._latitude, self._longitude = Signal(inputs.position, "Latitude"), Signal(inputs.position, "Longitude")
        self._method = Signal(inputs.fix, "Method")
        self._middle_m = 0.5 * carrier.arm_travel_m
        x, y, z = carrier.antenna_main_m
        self._axle_m = (carrier.front_axle_m - x, -y, z)
        """The front axle ahead and left of the antenna, and the antenna above the arms' pivots."""
        self.heights_m = [math.nan] * N_ARMS
        self.speed_m_s = self.yaw_rate_rad_s = math.nan
        self.tilt_rad = (math.nan, math.nan)
        """Roll, + right side down, and pitch, + nose up, of the rear half."""
        self.finding = Reason.NONE
        self.heading_off_rad = self.position_off_m = 0.0
        """How far the last samples were from the odometry."""
        self.latitude_deg = self.longitude_deg = math.nan
        self.east_m = self.north_m = self.yaw_rad = math.nan
        self._forget_position()
        self._forget_heading()

    def _forget_position(self) -> None:
        self.latitude_deg = self.longitude_deg = self.east_m = self.north_m = math.nan
        self._position_off = 0

    def _forget_heading(self) -> None:
        self.yaw_rad = self._heading_rad = math.nan
        self._heading_off = self._frozen = self._crosswise = self._reversed = 0

    @property
    def fix(self) -> int:
        """Method of the position's solution, 0 while unknown."""
        return int(self._method.value() or 0)

    @property
    def heading_rad(self) -> float | None:
        """As received, clockwise from true north; None while unknown or when it is not said to refer to true north."""
        heading: float | None = self._heading.value()
        return heading if self._reference.value() == TRUE_REFERENCE else None

    def offset_m(self, latitude_deg: float, longitude_deg: float) -> tuple[float, float]:
        """Compute (east, north) [m] from the front axle to a position; NaN while its own position is unknown."""
        if self.east_m != self.east_m:
            return math.nan, math.nan
        east, north = east_north_m(self.latitude_deg, self.longitude_deg, latitude_deg, longitude_deg)
        return east - self.east_m, north - self.north_m

    def step(self, elapsed_s: float) -> None:
        """Run one tick, after frames are decoded and the articulation is estimated."""
        inputs, steering = self._inputs, self.steering
        self.finding = _NONE
        self._update_carrier()
        speed = self.speed_m_s
        bend = min(max(steering.position, -MAX_BEND_RAD), MAX_BEND_RAD)
        self.yaw_rate_rad_s = heading_rate_rad_s(self._carrier, speed, bend, steering.velocity)
        if self.yaw_rate_rad_s == self.yaw_rate_rad_s:
            self.yaw_rad += self.yaw_rate_rad_s * elapsed_s
            self.east_m += speed * math.cos(self.yaw_rad) * elapsed_s
            self.north_m += speed * math.sin(self.yaw_rad) * elapsed_s
        self._update_heading(inputs)
        self._update_position(inputs)
        self._update_course(inputs)

    def _update_carrier(self) -> None:
        self.speed_m_s = or_nan(self._speed.value())
        roll, pitch = self._roll.value(), self._pitch.value()
        unknown = roll is None or pitch is None
        self.tilt_rad = (math.nan, math.nan) if unknown else (math.radians(roll), math.radians(pitch))
        for i in range(N_ARMS):
            height = self._arms[i].value()
            self.heights_m[i] = math.nan if height is None else 1e-3 * height + self._middle_m

    def _update_heading(self, inputs: CarrierInputs) -> None:
        heading = self.heading_rad
        if heading is None:
            self._forget_heading()
        elif inputs.heading.fresh:
            yaw = math.remainder(0.5 * math.pi - heading, math.tau)
            turns = abs(self.yaw_rate_rad_s) > MIN_TURN_RAD_S
            self._frozen = self._frozen + 1 if turns and heading == self._heading_rad else 0
            off = abs(math.remainder(yaw - self.yaw_rad, math.tau)) if self.yaw_rad == self.yaw_rad else 0.0
            self._heading_off = self._heading_off + 1 if off > MAX_REPEATED_JUMP_RAD else 0
            self._heading_rad, self.yaw_rad = heading, yaw
            self.heading_off_rad = off
            if off > MAX_JUMP_RAD or self._heading_off >= 2:
                self.finding = Reason.HEADING_JUMP
            elif self._frozen >= FROZEN_SAMPLES_COUNT:
                self.finding = Reason.HEADING_FROZEN

    def _update_position(self, inputs: CarrierInputs) -> None:
        state = inputs.position
        latitude, longitude = self._latitude.value(), self._longitude.value()
        if latitude is None or longitude is None:
            self._forget_position()
        elif state.fresh and self.yaw_rad == self.yaw_rad:
            east, north = self._axle_from_antenna()
            if self.east_m == self.east_m:
                moved = east_north_m(self.latitude_deg, self.longitude_deg, latitude, longitude)
                off = math.hypot(moved[0] + east - self.east_m, moved[1] + north - self.north_m)
                self._position_off = self._position_off + 1 if off > MAX_REPEATED_JUMP_M else 0
                self.position_off_m = off
                if not self.finding and (off > MAX_JUMP_M or self._position_off >= 2):
                    self.finding = Reason.POSITION_JUMP
            self.latitude_deg, self.longitude_deg = latitude, longitude
            self.east_m, self.north_m = east, north

    def _axle_from_antenna(self) -> tuple[float, float]:
        """Compute (east, north) [m] from antenna to middle of the front axle; the mast leans with roll and pitch."""
        ahead, left, up = self._axle_m
        roll, pitch = self.tilt_rad
        if roll == roll:
            height = 0.5 * (self.heights_m[0] + self.heights_m[1])
            low = self._carrier.arm_drop_low_m + (height if height == height else self._carrier.arm_transport_m)
            # The inclination is measured on the rear half, the mast stands on the front one.
            bend = self.steering.position
            cos, sin = (math.cos(bend), math.sin(bend)) if bend == bend else (1.0, 0.0)
            ahead += (up + low) * (cos * math.sin(pitch) + sin * math.sin(roll))
            left += (up + low) * (cos * math.sin(roll) - sin * math.sin(pitch))
        cos, sin = math.cos(self.yaw_rad), math.sin(self.yaw_rad)
        return cos * ahead - sin * left, sin * ahead + cos * left

    def _update_course(self, inputs: CarrierInputs) -> None:
        state = inputs.course
        course, ground = state.get("Cog"), state.get("Sog")
        if not state.fresh or course is None or ground is None or state.get("CogReference") != TRUE_REFERENCE:
            return
        goes = self.speed_m_s > MIN_COURSE_SPEED_M_S
        goes = goes and ground > max(MIN_COURSE_SPEED_M_S, MIN_COURSE_SHARE * self.speed_m_s)
        error_rad = math.remainder(0.5 * math.pi - course - self.yaw_rad, math.tau)
        reversed_ = goes and -ground * math.cos(error_rad) > MIN_COURSE_SHARE * self.speed_m_s
        self._reversed = self._reversed + 1 if reversed_ else 0
        self._crosswise = self._crosswise + 1 if goes and abs(error_rad) > MAX_COURSE_ERROR_RAD else 0
        wrong = self._reversed >= REVERSED_SAMPLES_COUNT or self._crosswise >= CROSSWISE_SAMPLES_COUNT
        if wrong and not self.finding:
            self.finding = Reason.HEADING_REVERSED
