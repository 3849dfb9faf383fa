"""A spool test in force: one valve function driven by its spool command, all others neutral, within the same limits.

The joint laws compensate the dead-band by the profile's value, so it cannot be measured through them.  A spool test
bypasses the laws and nothing else: the gate checks lease, order and arming as for every setpoint; range, speed and
duration are checked here in every tick by the encoder.  The command may not grow faster than a law's, nor request more
speed by the profile's valve map.

A joint without an encoder cannot be tested, except a rotator, which only turns the grapple on the spot.  Its angle is
integrated from the commands of all its tests since the start and stays within its range; no test of it lasts over 5 s.

Inputs: accepted `SpoolTest` datagrams, the joint's position and velocity.  Outputs: the spool command [%] and a reason
to stop.  Fixed size; only `SpoolTestRun.start` raises.
"""

from __future__ import annotations

import math
from array import array
from typing import Final

from can_dbc.messages.crane import MAX_KNOTS, SpoolTest
from controller.laws.joint import ACCELERATION_FACTOR
from controller.requests import RequestRefused
from machine.joints import JOINTS, N_JOINTS, Joint
from machine.profile import SPEED_HEADROOM_SHARE, JointSpec, Profile, joint
from machine.status.reasons import Reason

RATE_SLACK_S: Final = 0.002
"""Growth by which a line may be ahead of its time: knots are cut to a microsecond, and commands to 0.05 %."""
STOP_S: Final = 0.3
"""A joint stops within its speed times this: dead time, stop ramp and oil."""
TESTED_NS: Final = 600_000_000
"""What a valve does until this time after its test belongs to the test: the longest dead time, spool and oil."""
MAX_OPEN_NS: Final = 20_000_000_000
MAX_OPEN_UNSENSED_NS: Final = 5_000_000_000
"""A rotator that nothing measures creeps for this long at most by a command believed to be inside its dead-band."""
MAX_STEP_NS: Final = 20_000_000
"""After a pause the integrated angle counts at most this much time."""
NO_FUNCTION: Final = -1


class SpoolTestLimits:
    """Limits of the test of one joint."""

    __slots__ = ("_deadband", "_full", "lower", "max_open_ns", "rate_pct_s", "sensed", "sign", "speed_limit", "upper")

    def __init__(self, spec: JointSpec) -> None:
        valve = spec.valve
        self.lower, self.upper, self.speed_limit = spec.lower, spec.upper, spec.speed_limit
        self.sensed = spec.encoder is not None
        self.max_open_ns = MAX_OPEN_NS if self.sensed else MAX_OPEN_UNSENSED_NS
        self.sign = valve.sign
        self._deadband = (valve.deadband_plus_pct, valve.deadband_minus_pct)
        self._full = (valve.full_speed_plus, valve.full_speed_minus)
        self.rate_pct_s = 100.0 * ACCELERATION_FACTOR * spec.acceleration_limit / max(self._full)

    def opening_pct(self, percent: float) -> float:
        """Compute the command beyond the dead-band [% of the rest], with its sign."""
        side = 0 if percent >= 0.0 else 1
        deadband = self._deadband[side]
        return math.copysign(max(0.0, abs(percent) - deadband) * 100.0 / (100.0 - deadband), percent)

    def too_fast(self, before: float, after: float, elapsed_ns: int) -> bool:
        """Tell whether a change of the command opens the valve further than it may in this time.

        Closing is unlimited, and so is a step inside the dead-band.  A line (elapsed time) is judged by its slope: one
        that begins inside the dead-band opens the valve with the whole of it.
        """
        if self.opening_pct(after) == 0.0 or (abs(after) <= abs(before) and after * before >= 0.0):
            return False
        widened = abs(after - before) * 100.0 / (100.0 - max(self._deadband))
        if elapsed_ns == 0:
            widened = abs(self.opening_pct(after) - self.opening_pct(before))
        return widened > self.rate_pct_s * (elapsed_ns * 1e-9 + RATE_SLACK_S)

    def speed(self, percent: float) -> float:
        """Compute the joint velocity that the profile's valve map expects of a command [rad/s, m/s]."""
        opening = self.opening_pct(percent)
        return opening / 100.0 * self._full[0 if opening >= 0.0 else 1]


class SpoolTestRun:
    """The test in force, or none (``function`` is `NO_FUNCTION`)."""

    __slots__ = (
        "_begun_ns",
        "_driven_ns",
        "_last",
        "_limits",
        "_n",
        "_percents",
        "_tested_ns",
        "_times_ns",
        "function",
        "integrated_rad",
    )

    def __init__(self, profile: Profile) -> None:
        self._limits = tuple(SpoolTestLimits(joint(profile, j)) for j in JOINTS)
        self._times_ns = array("q", [0] * MAX_KNOTS)
        self._percents = array("d", [0.0] * MAX_KNOTS)
        self._n = 0
        self._begun_ns = 0
        self._driven_ns = 0
        self._tested_ns = array("q", [-TESTED_NS] * N_JOINTS)
        self._last = 0.0
        self.function = NO_FUNCTION
        self.integrated_rad = 0.0
        """Commanded turn of a rotator without an encoder, summed over all tests."""

    @property
    def running(self) -> bool:
        """Whether a test is in force."""
        return self.function != NO_FUNCTION

    def tested(self, j: int, now_ns: int) -> bool:
        """Tell whether a test drives the valve of a joint, or drove it a moment ago."""
        return now_ns - self._tested_ns[j] < TESTED_NS

    def end(self) -> None:
        """End the test."""
        self.function = NO_FUNCTION

    def start(self, test: SpoolTest, now_ns: int) -> None:
        """Check a request against the profile and the present command, and put it in force.

        Raises:
            RequestRefused: the test leaves the limits, or another one holds a valve open; the detail is the joint.
        """
        j = test.function
        limits = self._limits[j]
        if not limits.sensed and j != Joint.ROT:
            raise RequestRefused(Reason.TEST_FUNCTION, j)
        if self.running and j != self.function and self.percent(now_ns) != 0.0:
            raise RequestRefused(Reason.TEST_BUSY, j)
        present = self.percent(now_ns) if j == self.function else 0.0
        self._check_program(test, limits, present, now_ns)
        if j != self.function or not self.opened(now_ns):
            self._begun_ns = now_ns
        self.function, self._n = j, len(test.knots)
        for i, knot in enumerate(test.knots):
            self._times_ns[i] = test.stamp_ns + knot.after_ns
            self._percents[i] = knot.percent

    def _check_program(self, test: SpoolTest, limits: SpoolTestLimits, present: float, now_ns: int) -> None:
        """Check the speed of every knot, and that neither a line nor the step from ``present`` opens too fast."""
        at, before_ns, before = test.knots[0].percent, 0, 0.0
        for i, knot in enumerate(test.knots):
            if abs(limits.speed(knot.percent)) > limits.speed_limit:
                raise RequestRefused(Reason.TEST_SPOOL, test.function)
            knot_ns = test.stamp_ns + knot.after_ns
            if i and limits.too_fast(before, knot.percent, knot_ns - before_ns):
                raise RequestRefused(Reason.TEST_SPOOL, test.function)
            if before_ns <= now_ns < knot_ns and i:
                at = before + (now_ns - before_ns) / (knot_ns - before_ns) * (knot.percent - before)
            elif knot_ns <= now_ns:
                at = knot.percent
            before_ns, before = knot_ns, knot.percent
        if limits.too_fast(present, at, 0):
            raise RequestRefused(Reason.TEST_SPOOL, test.function)

    def percent(self, now_ns: int) -> float:
        """Compute the command now [%, + is positive joint motion]; neutral without a test and after its last knot."""
        times, percents, n = self._times_ns, self._percents, self._n
        if not self.running or now_ns > times[n - 1]:
            return 0.0
        if now_ns <= times[0]:
            return percents[0]
        k = 1
        while times[k] < now_ns:
            k += 1
        share = (now_ns - times[k - 1]) / (times[k] - times[k - 1])
        return percents[k - 1] + share * (percents[k] - percents[k - 1])

    def opened(self, now_ns: int) -> bool:
        """Tell whether a test holds a valve open now."""
        return self.running and self.percent(now_ns) != 0.0

    def drive(self, share: float, now_ns: int) -> tuple[float, float]:
        """Compute the spool command [%, with the profile's sign] and the joint velocity that the profile expects of it.

        ``share`` is 1 while the test runs; below 1 it scales the last command, which fades.
        """
        limits = self._limits[self.function]
        if share == 1.0:
            self._last = self.percent(now_ns)
        percent = share * self._last
        self._tested_ns[self.function] = now_ns
        speed = limits.speed(percent)
        if not limits.sensed:
            self.integrated_rad += speed * min(now_ns - self._driven_ns, MAX_STEP_NS) * 1e-9
            self._driven_ns = now_ns
        return limits.sign * percent, speed

    def ends_neutral(self, now_ns: int) -> bool:
        """Tell whether the program is over and ended with a neutral command: its lease may end without a fault."""
        return now_ns >= self._times_ns[self._n - 1] and self._percents[self._n - 1] == 0.0

    def cut_short(self, now_ns: int) -> bool:
        """Tell whether the knots are over while the valve was open."""
        return now_ns > self._times_ns[self._n - 1] and self._percents[self._n - 1] != 0.0

    def check(self, position: float, velocity: float, cap: float, now_ns: int) -> Reason:
        """Find what is wrong with the tested joint now, or NONE; ``cap`` scales the speed limit.

        Unknown values (NaN) are left to the supervisor.  A joint without an encoder is checked by its integrated angle.
        """
        limits = self._limits[self.function]
        percent = self.percent(now_ns)
        if not limits.sensed:
            position, velocity = self.integrated_rad, limits.speed(percent)
        if abs(velocity) > cap * SPEED_HEADROOM_SHARE * limits.speed_limit:
            return Reason.TEST_SPEED
        ahead = position + STOP_S * velocity
        if (ahead > limits.upper and percent > 0.0) or (ahead < limits.lower and percent < 0.0):
            return Reason.TEST_RANGE
        if percent == 0.0:
            self._begun_ns = now_ns
        elif now_ns - self._begun_ns > limits.max_open_ns:
            return Reason.TEST_TOO_LONG
        return Reason.NONE
