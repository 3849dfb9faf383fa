"""Monitors of the carrier: does it follow its command, and can its steering inputs be trusted?  One reason per tick.

The speed is monitored whenever the machine is armed, because a carrier that rolls away under the crane is as dangerous;
the rest, steering among it, only while it drives or slows down: a swinging load bends the standing machine.  Every
threshold must hold for a while, because frames of mach0 come every 20 ms and one of them may be an outlier.
"""

from __future__ import annotations

from typing import Final

from controller.bus_io import Signal
from controller.carrier.bus import CarrierInputs
from controller.carrier.dead_reckoning import (
    MAX_REPEATED_JUMP_M,
    MAX_REPEATED_JUMP_RAD,
    RTK_METHODS,
    DeadReckoning,
)
from controller.estimation.joint_estimator import TrackedJoint
from controller.estimation.joint_monitors import LATE_LAG_S, MotionMonitor
from controller.laws.suspension import N_ARMS, Suspension
from machine.joints import ARTICULATION
from machine.profile import Carrier
from machine.status.reasons import Reason

OVERSPEED_RATIO: Final = 1.3
OVERSPEED_M_S: Final = 0.25
"""The carrier may be faster than its command by this ratio and this much; ..."""
RUNAWAY_NS: Final = 300_000_000
"""... longer is a runaway."""
COMMAND_DECAY_M_S2: Final = 0.5
"""A former command still counts for as long as it takes to slow down like this."""
STUCK_COMMAND_M_S: Final = 0.2
STUCK_SPEED_M_S: Final = 0.04
STUCK_NS: Final = 2_500_000_000
"""It is stuck when its command is above the first and its speed below the second for this long."""
BEND_MARGIN_RAD: Final = 0.07
"""How far beyond its limit the articulation may be measured: its stops, and the encoder's zero."""
DISAGREE_RAD: Final = 0.06
DISAGREE_NS: Final = 250_000_000
TILT_NS: Final = 60_000_000
ARM_MARGIN_M: Final = 0.06
"""An arm may be measured this far outside its travel: sag of the tyres' side, and the sensor's zero."""
ARM_STUCK_NS: Final = 2_000_000_000
ARM_MOVED_M: Final = 0.01
"""An arm that is commanded to move moves by this much in that time."""
COMMAND_DELAY_S: Final = 0.04
"""At most this much is added to the steering valve's dead time by VehCmd's period and the vehicle node."""
_NO_FAULT: Final = 0
_ARMS_GOOD: Final = (0, 1)
"""ArmHeightA.State: hold and active; neither a fault nor "not available" is good."""
_NONE: Final = Reason.NONE
_STEERING_REASONS: Final = {
    Reason.NONE: Reason.NONE,
    Reason.JOINT_STUCK: Reason.STEERING_STUCK,
    Reason.JOINT_RUNAWAY: Reason.STEERING_RUNAWAY,
    Reason.JOINT_REVERSED: Reason.STEERING_RUNAWAY,
}


class VehicleMonitor:
    """`step` returns the (reason, detail) of an armed carrier's fault, (NONE, 0) without one."""

    __slots__ = (
        "_arm_from_m",
        "_arm_since_ns",
        "_arms_state",
        "_articulation",
        "_carrier",
        "_disagree_ns",
        "_fault",
        "_inputs",
        "_overspeed_ns",
        "_recent_command_m_s",
        "_reckoning",
        "_steering",
        "_stuck_ns",
        "_tilt_ns",
    )

    def __init__(
        self, carrier: Carrier, inputs: CarrierInputs, reckoning: DeadReckoning, steering: TrackedJoint, period_s: float
    ) -> None:
        self._carrier, self._reckoning = carrier, reckoning
        self._fault, self._articulation = Signal(inputs.vehicle, "Fault"), Signal(inputs.vehicle, "Articulation")
        self._arms_state = Signal(inputs.arms_a, "State")
        self._inputs = inputs
        self._steering = MotionMonitor(steering, period_s, COMMAND_DELAY_S, max(LATE_LAG_S, carrier.articulation_lag_s))
        self._arm_from_m, self._arm_since_ns = [0.0] * N_ARMS, [0] * N_ARMS
        self.reset(0)

    def reset(self, now_ns: int) -> None:
        """Start over: the machine is not armed."""
        self._recent_command_m_s = 0.0
        self._steering.reset()
        self._overspeed_ns = self._stuck_ns = self._disagree_ns = self._tilt_ns = now_ns
        for i in range(N_ARMS):
            self._arm_since_ns[i] = now_ns

    def ready(self, waypoint: bool) -> Reason:
        """Give the reason that prevents driving now, to a waypoint or by articulation angles, or NONE."""
        reckoning = self._reckoning
        reason = self._reported()
        if reason:
            return reason
        if self._tilt_unknown():
            return Reason.ARMS_FAULT
        if self._tilted():
            return Reason.TILTED
        return self._lost(reckoning) if waypoint else Reason.NONE

    def step(
        self,
        speed_command_m_s: float,
        rate_command_rad_s: float,
        drives: bool,
        waypoint: bool,
        arms: Suspension,
        now_ns: int,
        elapsed_s: float,
    ) -> tuple[Reason, int]:
        """Run one tick with the commanded speed and articulation rate.

        ``drives``: the carrier drives or slows down; ``waypoint``: it steers to a waypoint.
        """
        decayed_m_s = self._recent_command_m_s - COMMAND_DECAY_M_S2 * elapsed_s
        self._recent_command_m_s = max(abs(speed_command_m_s), decayed_m_s)
        if self._runs_away(speed_command_m_s, now_ns):
            return Reason.CARRIER_RUNAWAY, 0
        if not drives:
            self._stuck_ns = self._disagree_ns = self._tilt_ns = now_ns
            self._steering.reset()
            for i in range(N_ARMS):
                self._arm_since_ns[i] = now_ns
            return _NONE, 0
        reckoning = self._reckoning
        if reckoning.steering.jumped:
            return Reason.ENCODER_JUMP, ARTICULATION
        if abs(reckoning.steering.position) > self._carrier.articulation_limit_rad + BEND_MARGIN_RAD:
            return Reason.POSITION_OUTSIDE, ARTICULATION
        reported = self._reported()
        if reported:
            return reported, 0
        if self._disagrees(now_ns):
            return Reason.STEERING_DISAGREES, 0
        steering = _STEERING_REASONS[self._steering.step(rate_command_rad_s, reckoning.steering.velocity)]
        if steering:
            return steering, 0
        unknown = self._tilt_unknown()
        if not (unknown or self._tilted()):
            self._tilt_ns = now_ns
        elif now_ns - self._tilt_ns >= TILT_NS:
            return Reason.ARMS_FAULT if unknown else Reason.TILTED, 0
        if waypoint:
            reason = self._lost(reckoning) or reckoning.finding
            if reason:
                return reason, 0
        if self._stuck(speed_command_m_s, now_ns):
            return Reason.CARRIER_STUCK, 0
        return self._check_arms(arms, now_ns)

    def shares(self, now_ns: int) -> dict[str, float]:
        """Compute what was measured of the carrier over what is a fault, 1 and more, by the fault."""
        reckoning = self._reckoning
        reversed_, stuck, runaway = self._steering.shares()
        return {
            "carrier too fast": (now_ns - self._overspeed_ns) / RUNAWAY_NS,
            "carrier stuck": (now_ns - self._stuck_ns) / STUCK_NS,
            "steering stuck": stuck,
            "steering runs away": max(reversed_, runaway),
            "steering disagrees": (now_ns - self._disagree_ns) / DISAGREE_NS,
            "carrier tilted": (now_ns - self._tilt_ns) / TILT_NS,
            "arm stuck": (now_ns - min(self._arm_since_ns)) / ARM_STUCK_NS,
            "position jumps": reckoning.position_off_m / MAX_REPEATED_JUMP_M,
            "heading jumps": reckoning.heading_off_rad / MAX_REPEATED_JUMP_RAD,
        }

    def _reported(self) -> Reason:
        """Find a fault that carrier or arms report, or that they cannot say whether there is one."""
        inputs = self._inputs
        if inputs.vehicle.values is not None and self._fault.value() != _NO_FAULT:
            return Reason.CARRIER_FAULT
        if inputs.arms_a.values is not None and self._arms_state.value() not in _ARMS_GOOD:
            return Reason.ARMS_FAULT
        return Reason.NONE

    def _tilt_unknown(self) -> bool:
        """Tell whether the arms' node is heard and says that it does not know roll or pitch."""
        roll, pitch = self._reckoning.tilt_rad
        return self._inputs.arms_b.values is not None and (roll != roll or pitch != pitch)

    def _tilted(self) -> bool:
        roll, pitch = self._reckoning.tilt_rad
        return max(abs(roll), abs(pitch)) > self._carrier.tilt_limit_rad

    def _lost(self, reckoning: DeadReckoning) -> Reason:
        """Find an input that driving to a waypoint needs and that is missing."""
        if reckoning.yaw_rad != reckoning.yaw_rad:
            return Reason.HEADING_LOST
        if reckoning.east_m != reckoning.east_m:
            return Reason.POSITION_LOST
        return Reason.NONE if reckoning.fix in RTK_METHODS else Reason.FIX_LOST

    def _runs_away(self, speed_command_m_s: float, now_ns: int) -> bool:
        speed = self._reckoning.speed_m_s
        too_fast = abs(speed) > OVERSPEED_RATIO * self._recent_command_m_s + OVERSPEED_M_S
        against = speed * speed_command_m_s < 0.0 and abs(speed) > OVERSPEED_M_S
        if not (too_fast or against):
            self._overspeed_ns = now_ns
        return now_ns - self._overspeed_ns >= RUNAWAY_NS

    def _stuck(self, speed_command_m_s: float, now_ns: int) -> bool:
        if not (abs(speed_command_m_s) > STUCK_COMMAND_M_S and abs(self._reckoning.speed_m_s) < STUCK_SPEED_M_S):
            self._stuck_ns = now_ns
        return now_ns - self._stuck_ns >= STUCK_NS

    def _disagrees(self, now_ns: int) -> bool:
        theirs = self._articulation.value()
        if theirs is None or not abs(theirs - self._reckoning.steering.position) > DISAGREE_RAD:
            self._disagree_ns = now_ns
        return now_ns - self._disagree_ns >= DISAGREE_NS

    def _check_arms(self, arms: Suspension, now_ns: int) -> tuple[Reason, int]:
        heights, travel = self._reckoning.heights_m, self._carrier.arm_travel_m
        for i in range(N_ARMS):
            height = heights[i]
            if height < -ARM_MARGIN_M or height > travel + ARM_MARGIN_M:
                return Reason.ARM_OUTSIDE, i
            if arms.speeds_m_s[i] == 0.0 or abs(height - self._arm_from_m[i]) > ARM_MOVED_M:
                self._arm_since_ns[i], self._arm_from_m[i] = now_ns, height
            elif now_ns - self._arm_since_ns[i] >= ARM_STUCK_NS:
                return Reason.ARM_STUCK, i
        return _NONE, 0
