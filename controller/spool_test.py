"""A spool test in force: one valve function driven by its spool command, all others neutral, inside the same bounds.

The joint laws undo a dead-band with the profile's idea of it, so nobody can measure it through them.  A test goes past
the laws and past nothing else: lease, order and arming are the gate's as for every setpoint; range, speed and duration
are judged here, every tick, from what the encoder says.  The command may not grow faster, nor ask for more speed by
the profile's valve map, than a law would.

A joint without an encoder cannot be tested, but for a rotator: it only turns the grapple on the spot.  Its way counts
as commanded, over all its tests since the start, and stays within its range; none of them lasts over 5 s.

Inputs: accepted `SpoolTest` datagrams, the joint's position and velocity.  Outputs: the spool [%], and a
reason to stop.  Fixed size; nothing raises but `Refusal` while a datagram is judged.
"""

from __future__ import annotations

import math
from array import array
from typing import Final

from can_dbc.setpoint import MAX_KNOTS, SpoolTest
from machine.joints import JOINTS, Joint
from machine.profile import JointSpec, Profile, joint
from machine.reasons import Reason

HEADROOM: Final = 1.25
"""Share of the speed limit that a joint may reach: as much as a law may use to catch up."""
RATE_FACTOR: Final = 4.0
"""The command may grow this many times faster than the acceleration limit, as a law's; the guard allows six."""
SLACK_S: Final = 0.002
"""Growth that a line may be ahead of its time: knots are cut to a microsecond, and commands to 0.05 %."""
STOP_S: Final = 0.3
"""A joint stops within its speed times this: dead time, stop ramp and oil."""
LONGEST_NS: Final = 20_000_000_000
LONGEST_BLIND_NS: Final = 5_000_000_000
"""A rotator that nobody watches creeps at most so long by a command that is thought to be inside its dead-band."""
STEP_NS: Final = 20_000_000
"""After a pause the commanded way counts at most so much time."""
AT_REST: Final = 0.05
"""Share of the speed limit below which a joint counts as standing."""
NONE: Final = -1


class Refusal(Exception):
    """Why a test is refused; the detail is the joint."""

    def __init__(self, reason: Reason) -> None:
        super().__init__(reason)
        self.reason = reason


class Bounds:
    """What the test of one joint may do."""

    __slots__ = ("_deadband", "_full", "longest_ns", "lower", "rate_pct_s", "sensed", "sign", "speed_limit", "upper")

    def __init__(self, spec: JointSpec) -> None:
        valve = spec.valve
        self.lower, self.upper, self.speed_limit = spec.lower, spec.upper, spec.speed_limit
        self.sensed = spec.encoder is not None
        self.longest_ns = LONGEST_NS if self.sensed else LONGEST_BLIND_NS
        self.sign = valve.sign
        self._deadband = (valve.deadband_plus_pct, valve.deadband_minus_pct)
        self._full = (valve.full_speed_plus, valve.full_speed_minus)
        self.rate_pct_s = 100.0 * RATE_FACTOR * spec.acceleration_limit / max(self._full)

    def opening_pct(self, percent: float) -> float:
        """The command past the dead-band [% of the rest], with its sign."""
        side = 0 if percent >= 0.0 else 1
        deadband = self._deadband[side]
        return math.copysign(max(0.0, abs(percent) - deadband) * 100.0 / (100.0 - deadband), percent)

    def too_fast(self, before: float, after: float, elapsed_ns: int) -> bool:
        """Whether a change of the command opens the valve further than it may in this time.

        Closing is free, and so is a step inside the dead-band.  A line (elapsed time) is judged by its slope: one that
        begins inside the dead-band opens the valve with the whole of it.
        """
        if self.opening_pct(after) == 0.0 or (abs(after) <= abs(before) and after * before >= 0.0):
            return False
        widened = abs(after - before) * 100.0 / (100.0 - max(self._deadband))
        if elapsed_ns == 0:
            widened = abs(self.opening_pct(after) - self.opening_pct(before))
        return widened > self.rate_pct_s * (elapsed_ns * 1e-9 + SLACK_S)

    def speed(self, percent: float) -> float:
        """The joint velocity that the profile's valve map expects of a command [rad/s, m/s]."""
        opening = self.opening_pct(percent)
        return opening / 100.0 * self._full[0 if opening >= 0.0 else 1]


class SpoolRun:
    """The test that is in force, or none (``function`` is `NONE`)."""

    __slots__ = ("_begun_ns", "_bounds", "_driven_ns", "_last", "_n", "_percents", "_times_ns", "function", "way")

    def __init__(self, profile: Profile) -> None:
        self._bounds = tuple(Bounds(joint(profile, j)) for j in JOINTS)
        self._times_ns = array("q", [0] * MAX_KNOTS)
        self._percents = array("d", [0.0] * MAX_KNOTS)
        self._n = 0
        self._begun_ns = 0
        self._driven_ns = 0
        self._last = 0.0
        self.function = NONE
        self.way = 0.0
        """How far a rotator without an encoder was told to turn by all its tests [rad]."""

    @property
    def running(self) -> bool:
        """Whether a test is in force."""
        return self.function != NONE

    def end(self) -> None:
        """Back to trajectories."""
        self.function = NONE

    def take(self, test: SpoolTest, now_ns: int) -> None:
        """Judges a datagram against the profile and the present command, and puts it in force; raises Refusal."""
        j = test.function
        bounds = self._bounds[j]
        if not bounds.sensed and j != Joint.ROT:
            raise Refusal(Reason.TEST_FUNCTION)
        if self.running and j != self.function and self.percent(now_ns) != 0.0:
            raise Refusal(Reason.TEST_BUSY)
        present = self.percent(now_ns) if j == self.function else 0.0
        self._check(test, bounds, present, now_ns)
        if j != self.function or not self.opened(now_ns):
            self._begun_ns = now_ns
        self.function, self._n = j, len(test.knots)
        for i, knot in enumerate(test.knots):
            self._times_ns[i] = test.stamp_ns + knot.after_ns
            self._percents[i] = knot.percent

    def _check(self, test: SpoolTest, bounds: Bounds, present: float, now_ns: int) -> None:
        """Speed of every knot; no line opens the valve too fast, nor the step from the present command on to it."""
        at, before_ns, before = test.knots[0].percent, 0, 0.0
        for i, knot in enumerate(test.knots):
            if abs(bounds.speed(knot.percent)) > bounds.speed_limit:
                raise Refusal(Reason.TEST_SPOOL)
            knot_ns = test.stamp_ns + knot.after_ns
            if i and bounds.too_fast(before, knot.percent, knot_ns - before_ns):
                raise Refusal(Reason.TEST_SPOOL)
            if before_ns <= now_ns < knot_ns and i:
                at = before + (now_ns - before_ns) / (knot_ns - before_ns) * (knot.percent - before)
            elif knot_ns <= now_ns:
                at = knot.percent
            before_ns, before = knot_ns, knot.percent
        if bounds.too_fast(present, at, 0):
            raise Refusal(Reason.TEST_SPOOL)

    def percent(self, now_ns: int) -> float:
        """The command now [%, + is positive joint motion]; neutral without a test and past its last knot."""
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
        """Whether a test holds a valve open now."""
        return self.running and self.percent(now_ns) != 0.0

    def drive(self, share: float, now_ns: int) -> tuple[float, float]:
        """Spool command [%, with the profile's sign] and the joint velocity that the profile expects of it.

        ``share`` is 1 while the test runs; less, and the last command fades.
        """
        bounds = self._bounds[self.function]
        if share == 1.0:
            self._last = self.percent(now_ns)
        percent = share * self._last
        speed = bounds.speed(percent)
        if not bounds.sensed:
            self.way += speed * min(now_ns - self._driven_ns, STEP_NS) * 1e-9
            self._driven_ns = now_ns
        return bounds.sign * percent, speed

    def ends_neutral(self, now_ns: int) -> bool:
        """Whether the program is over and its last command was neutral: the lease may run out in peace."""
        return now_ns >= self._times_ns[self._n - 1] and self._percents[self._n - 1] == 0.0

    def cut_short(self, now_ns: int) -> bool:
        """Whether the knots are over while the valve was open."""
        return now_ns > self._times_ns[self._n - 1] and self._percents[self._n - 1] != 0.0

    def judge(self, position: float, velocity: float, cap: float, now_ns: int) -> Reason:
        """What is wrong with the tested joint now; NONE while all is well.  ``cap`` scales the speed limit; an unknown
        value is the supervisor's business.  Of a joint without an encoder the commanded way is judged instead.
        """
        bounds = self._bounds[self.function]
        percent = self.percent(now_ns)
        if not bounds.sensed:
            position, velocity = self.way, bounds.speed(percent)
        if abs(velocity) > cap * HEADROOM * bounds.speed_limit:
            return Reason.TEST_SPEED
        ahead = position + STOP_S * velocity
        if (ahead > bounds.upper and percent > 0.0) or (ahead < bounds.lower and percent < 0.0):
            return Reason.TEST_RANGE
        if percent == 0.0:
            self._begun_ns = now_ns
        elif now_ns - self._begun_ns > bounds.longest_ns:
            return Reason.TEST_TOO_LONG
        return Reason.NONE
