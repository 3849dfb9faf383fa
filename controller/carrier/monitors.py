"""Does the carrier do what it is told, and is what steers it to be trusted?  One reason at a time, per tick.

Speed and articulation are watched whenever the machine is armed, for a carrier that rolls away from under the crane is
as bad; the rest only while it drives or slows down.  Every threshold must hold for a while, because a frame of mach0
comes every 20 ms and one of them may be odd.
"""

from __future__ import annotations

from typing import Final

from controller.carrier.dead_reckoning import FIXES, Whereabouts
from controller.carrier.inputs import MachineReceived
from controller.estimator import Tracked
from controller.laws.suspension import N_ARMS, Suspension
from controller.monitors import LATE_LAG_S, MotionMonitor
from machine.joints import ARTICULATION
from machine.profile import Carrier
from machine.reasons import Reason

OWN_GAIN: Final = 1.3
OWN_M_S: Final = 0.25
"""The carrier may be faster than it was told by this share and this much; ..."""
RUNAWAY_NS: Final = 300_000_000
"""... longer is a runaway."""
FORGET_M_S2: Final = 0.5
"""What it was told it may still do for as long as it takes to slow down like this."""
TOLD_M_S: Final = 0.2
STUCK_M_S: Final = 0.04
STUCK_NS: Final = 2_500_000_000
"""Told to go as fast as the first and slower than the second for so long, it is stuck."""
BEND_MARGIN_RAD: Final = 0.07
"""How far past its limit the articulation may be found: its stops, and the encoder's zero."""
DISAGREE_RAD: Final = 0.06
DISAGREE_NS: Final = 250_000_000
TILT_NS: Final = 60_000_000
OUTSIDE_M: Final = 0.06
"""An arm may be found this far outside of its travel: sag of the tyres' side, and the sensor's zero."""
ARM_STUCK_NS: Final = 2_000_000_000
ARM_MOVED_M: Final = 0.01
"""An arm that is told to move does so by this in that time."""
COMMAND_S: Final = 0.04
"""What VehCmd's period and the vehicle node add to the steering valve's dead time at most."""
_ARMS_FAULT: Final = 3
_STEERED: Final = {
    Reason.NONE: Reason.NONE,
    Reason.JOINT_STUCK: Reason.STEERING_STUCK,
    Reason.JOINT_RUNAWAY: Reason.STEERING_RUNAWAY,
    Reason.JOINT_REVERSED: Reason.STEERING_RUNAWAY,
}


class VehicleWatch:
    """`step` gives (reason, detail) of what is wrong with a carrier that is armed; (NONE, 0) when nothing is."""

    __slots__ = (
        "_arm_from_m", "_arm_since_ns", "_carrier", "_disagree_ns", "_machine", "_own_ns", "_steering", "_stuck_ns",
        "_tilt_ns", "_told_m_s", "_where",
    )  # fmt: skip

    def __init__(
        self, carrier: Carrier, machine: MachineReceived, where: Whereabouts, steering: Tracked, period_s: float
    ) -> None:
        self._carrier, self._machine, self._where = carrier, machine, where
        self._steering = MotionMonitor(steering, period_s, COMMAND_S, max(LATE_LAG_S, carrier.articulation_lag_s))
        self._arm_from_m, self._arm_since_ns = [0.0] * N_ARMS, [0] * N_ARMS
        self.reset(0)

    def reset(self, now_ns: int) -> None:
        """Nothing is armed."""
        self._told_m_s = 0.0
        self._steering.reset()
        self._own_ns = self._stuck_ns = self._disagree_ns = self._tilt_ns = now_ns
        for i in range(N_ARMS):
            self._arm_since_ns[i] = now_ns

    def ready(self, waypoint: bool) -> Reason:
        """What speaks against driving now, to a waypoint or by angles."""
        machine, where = self._machine, self._where
        if machine.vehicle.get("Fault"):
            return Reason.CARRIER_FAULT
        if machine.arms_a.get("State") == _ARMS_FAULT:
            return Reason.ARMS_FAULT
        if self._tilted():
            return Reason.TILTED
        return self._lost(where) if waypoint else Reason.NONE

    def step(
        self,
        told_m_s: float,
        told_rad_s: float,
        drives: bool,
        waypoint: bool,
        arms: Suspension,
        now_ns: int,
        elapsed_s: float,
    ) -> tuple[Reason, int]:
        """One tick: speed and articulation rate it is told, whether it drives or slows down, whether a waypoint steers
        it.
        """
        self._told_m_s = max(abs(told_m_s), self._told_m_s - FORGET_M_S2 * elapsed_s)
        if self._runs_away(told_m_s, now_ns):
            return Reason.CARRIER_RUNAWAY, 0
        if not drives:
            self._stuck_ns = self._disagree_ns = self._tilt_ns = now_ns
            self._steering.reset()
            for i in range(N_ARMS):
                self._arm_since_ns[i] = now_ns
            return Reason.NONE, 0
        machine, where = self._machine, self._where
        if where.steering.jumped:
            return Reason.ENCODER_JUMP, ARTICULATION
        if abs(where.steering.position) > self._carrier.articulation_limit_rad + BEND_MARGIN_RAD:
            return Reason.POSITION_OUTSIDE, ARTICULATION
        if machine.vehicle.get("Fault"):
            return Reason.CARRIER_FAULT, 0
        if machine.arms_a.get("State") == _ARMS_FAULT:
            return Reason.ARMS_FAULT, 0
        if self._disagrees(now_ns):
            return Reason.STEERING_DISAGREES, 0
        steered = _STEERED[self._steering.step(told_rad_s, where.steering.velocity)]
        if steered:
            return steered, 0
        if not self._tilted():
            self._tilt_ns = now_ns
        elif now_ns - self._tilt_ns >= TILT_NS:
            return Reason.TILTED, 0
        if waypoint:
            reason = self._lost(where) or where.finding
            if reason:
                return reason, 0
        if self._stuck(told_m_s, now_ns):
            return Reason.CARRIER_STUCK, 0
        return self._judge_arms(arms, now_ns)

    def _tilted(self) -> bool:
        roll, pitch = self._where.tilt_rad
        return max(abs(roll), abs(pitch)) > self._carrier.tilt_limit_rad

    def _lost(self, where: Whereabouts) -> Reason:
        """What a waypoint needs and is not there."""
        if where.yaw_rad != where.yaw_rad:
            return Reason.HEADING_LOST
        if where.east_m != where.east_m:
            return Reason.POSITION_LOST
        return Reason.NONE if where.fix in FIXES else Reason.FIX_LOST

    def _runs_away(self, told_m_s: float, now_ns: int) -> bool:
        speed = self._where.speed_m_s
        faster = abs(speed) > OWN_GAIN * self._told_m_s + OWN_M_S
        against = speed * told_m_s < 0.0 and abs(speed) > OWN_M_S
        if not (faster or against):
            self._own_ns = now_ns
        return now_ns - self._own_ns >= RUNAWAY_NS

    def _stuck(self, told_m_s: float, now_ns: int) -> bool:
        if not (abs(told_m_s) > TOLD_M_S and abs(self._where.speed_m_s) < STUCK_M_S):
            self._stuck_ns = now_ns
        return now_ns - self._stuck_ns >= STUCK_NS

    def _disagrees(self, now_ns: int) -> bool:
        theirs = self._machine.vehicle.get("Articulation")
        if theirs is None or not abs(theirs - self._where.steering.position) > DISAGREE_RAD:
            self._disagree_ns = now_ns
        return now_ns - self._disagree_ns >= DISAGREE_NS

    def _judge_arms(self, arms: Suspension, now_ns: int) -> tuple[Reason, int]:
        heights, travel = self._where.heights_m, self._carrier.arm_travel_m
        for i in range(N_ARMS):
            height = heights[i]
            if height < -OUTSIDE_M or height > travel + OUTSIDE_M:
                return Reason.ARM_OUTSIDE, i
            if arms.speeds_m_s[i] == 0.0 or abs(height - self._arm_from_m[i]) > ARM_MOVED_M:
                self._arm_since_ns[i], self._arm_from_m[i] = now_ns, height
            elif now_ns - self._arm_since_ns[i] >= ARM_STUCK_NS:
                return Reason.ARM_STUCK, i
        return Reason.NONE, 0
