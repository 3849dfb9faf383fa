"""Where the carrier is and where it looks, at every tick: the newest GNSS position and heading, carried on by odometry.

Between two samples (100 ms) the middle of the front axle goes along the heading of the front half with the measured
speed, and the heading turns as the articulation has it.  Inputs are the slots of mach0 and the estimate of the
articulation; nothing is filtered.  What a sample says against the odometry is kept as ``finding``: a jump, a heading
that does not turn while the machine does, or one that looks against the way it goes.

Angles are counter-clockwise from east, places metres east and north of the last position sample (latitude, longitude).
"""

from __future__ import annotations

import math
from typing import Final

from controller.carrier.inputs import MachineReceived
from controller.estimator import JointEstimator
from controller.laws.heading import east_north_m
from controller.message_state import known
from machine.carrier import heading_rate_rad_s
from machine.profile import Carrier
from machine.reasons import Reason

JUMP_M: Final = 1.0
"""A position this far from where odometry has it stops at once, ..."""
OFF_M: Final = 0.4
"""... one this far when the next one is as well."""
JUMP_RAD: Final = 0.35
OFF_RAD: Final = 0.12
FROZEN_SAMPLES: Final = 5
"""A heading that stays the same to the last digit over so many samples while the machine turns is frozen."""
TURNS_RAD_S: Final = 0.02
GOES_M_S: Final = 0.25
"""From this speed on the course over ground tells forward from backward."""
AGAINST_RAD: Final = 1.2
"""Greatest angle of the course against the heading: more is a heading that is wrong."""
BEND_RAD: Final = 1.2
"""No articulation bends farther; what an encoder says beyond is no angle."""
MAGNETIC: Final = 1
"""VesselHeading.Reference."""
FIXES: Final = (4, 5)
"""Methods of PGN 129029 that a waypoint may be driven by: RTK fixed and float."""


class Whereabouts:
    """``yaw_rad`` of the front half and the axle's place, NaN while unknown; ``finding`` is of the last samples."""

    __slots__ = (
        "_against", "_axle_m", "_carrier", "_frozen", "_heading_off", "_heading_rad", "_machine", "_position_off",
        "east_m", "finding", "heights_m", "latitude_deg", "longitude_deg", "north_m", "speed_m_s", "steering",
        "tilt_rad", "yaw_rad", "yaw_rate_rad_s",
    )  # fmt: skip

    def __init__(self, carrier: Carrier, machine: MachineReceived, steering: JointEstimator) -> None:
        self._carrier = carrier
        self._machine = machine
        self.steering = steering
        x, y, z = carrier.antenna_main_m
        self._axle_m = (carrier.front_axle_m - x, -y, z)
        """The front axle ahead and left of the antenna, and the antenna above the arms' pivots."""
        self.heights_m = [math.nan] * 4
        self.speed_m_s = self.yaw_rate_rad_s = math.nan
        self.tilt_rad = (math.nan, math.nan)
        """Roll, + right side down, and pitch, + nose up, of the rear half."""
        self.finding = Reason.NONE
        self.latitude_deg = self.longitude_deg = math.nan
        self.east_m = self.north_m = self.yaw_rad = math.nan
        self._forget_position()
        self._forget_heading()

    def _forget_position(self) -> None:
        self.latitude_deg = self.longitude_deg = self.east_m = self.north_m = math.nan
        self._position_off = 0

    def _forget_heading(self) -> None:
        self.yaw_rad = self._heading_rad = math.nan
        self._heading_off = self._frozen = self._against = 0

    @property
    def fix(self) -> int:
        """Method of the position's solution, 0 when nothing is known of it."""
        return int(self._machine.fix.get("Method") or 0)

    @property
    def heading_rad(self) -> float | None:
        """As received, clockwise from true north; None when it is unknown, or from magnetic north."""
        slot = self._machine.heading
        heading: float | None = slot.get("Heading")
        return None if slot.get("Reference") == MAGNETIC else heading

    def to_m(self, latitude_deg: float, longitude_deg: float) -> tuple[float, float]:
        """(east, north) [m] from the front axle to a place; NaN while the position is unknown."""
        if self.east_m != self.east_m:
            return math.nan, math.nan
        east, north = east_north_m(self.latitude_deg, self.longitude_deg, latitude_deg, longitude_deg)
        return east - self.east_m, north - self.north_m

    def step(self, elapsed_s: float) -> None:
        """One tick, after the slots have been read and the articulation has been estimated."""
        machine, steering = self._machine, self.steering
        self.finding = Reason.NONE
        self._read_carrier(machine)
        speed = self.speed_m_s
        bend = min(max(steering.position, -BEND_RAD), BEND_RAD)
        self.yaw_rate_rad_s = heading_rate_rad_s(self._carrier, speed, bend, steering.velocity)
        if self.yaw_rate_rad_s == self.yaw_rate_rad_s:
            self.yaw_rad += self.yaw_rate_rad_s * elapsed_s
            self.east_m += speed * math.cos(self.yaw_rad) * elapsed_s
            self.north_m += speed * math.sin(self.yaw_rad) * elapsed_s
        self._take_heading(machine)
        self._take_position(machine)
        self._take_course(machine)

    def _read_carrier(self, machine: MachineReceived) -> None:
        self.speed_m_s = known(machine.vehicle.get("Speed"))
        roll, pitch = machine.arms_b.get("Roll"), machine.arms_b.get("Pitch")
        unknown = roll is None or pitch is None
        self.tilt_rad = (math.nan, math.nan) if unknown else (math.radians(roll), math.radians(pitch))
        middle, arms = 0.5 * self._carrier.arm_travel_m, machine.arms_a
        for i, name in enumerate(("Arm1", "Arm2", "Arm3", "Arm4")):
            height = arms.get(name)
            self.heights_m[i] = math.nan if height is None else 1e-3 * height + middle

    def _take_heading(self, machine: MachineReceived) -> None:
        heading = self.heading_rad
        if heading is None:
            self._forget_heading()
        elif machine.heading.fresh:
            yaw = math.remainder(0.5 * math.pi - heading, math.tau)
            turns = abs(self.yaw_rate_rad_s) > TURNS_RAD_S
            self._frozen = self._frozen + 1 if turns and heading == self._heading_rad else 0
            off = abs(math.remainder(yaw - self.yaw_rad, math.tau)) if self.yaw_rad == self.yaw_rad else 0.0
            self._heading_off = self._heading_off + 1 if off > OFF_RAD else 0
            self._heading_rad, self.yaw_rad = heading, yaw
            if off > JUMP_RAD or self._heading_off >= 2:
                self.finding = Reason.HEADING_JUMP
            elif self._frozen >= FROZEN_SAMPLES:
                self.finding = Reason.HEADING_FROZEN

    def _take_position(self, machine: MachineReceived) -> None:
        slot = machine.position
        latitude, longitude = slot.get("Latitude"), slot.get("Longitude")
        if latitude is None or longitude is None:
            self._forget_position()
        elif slot.fresh and self.yaw_rad == self.yaw_rad:
            east, north = self._axle_from_antenna()
            if self.east_m == self.east_m:
                moved = east_north_m(self.latitude_deg, self.longitude_deg, latitude, longitude)
                off = math.hypot(moved[0] + east - self.east_m, moved[1] + north - self.north_m)
                self._position_off = self._position_off + 1 if off > OFF_M else 0
                if not self.finding and (off > JUMP_M or self._position_off >= 2):
                    self.finding = Reason.POSITION_JUMP
            self.latitude_deg, self.longitude_deg = latitude, longitude
            self.east_m, self.north_m = east, north

    def _axle_from_antenna(self) -> tuple[float, float]:
        """(east, north) [m] from the antenna to the middle of the front axle; a mast leans with roll and pitch."""
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

    def _take_course(self, machine: MachineReceived) -> None:
        slot = machine.course
        course, ground = slot.get("Cog"), slot.get("Sog")
        if not slot.fresh or course is None or ground is None:
            return
        goes = ground > GOES_M_S and self.speed_m_s > GOES_M_S
        against = abs(math.remainder(0.5 * math.pi - course - self.yaw_rad, math.tau)) > AGAINST_RAD
        self._against = self._against + 1 if goes and against else 0
        if self._against >= 2 and not self.finding:
            self.finding = Reason.HEADING_REVERSED
