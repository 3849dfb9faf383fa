"""The monitors of a joint by its encoder: does it follow its command, and stay where it is without one?

Each judges one joint, once in a period, by its measured position or velocity; `controller.joint_watch` runs them and
reacts.  `MotionMonitor` compares the joint with its command, `StandstillMonitor` sees motion with a shut valve, which
`SlopeYield` excuses on a slope, and `DriftMonitor` an encoder that creeps.  Monitors that know the valve's spool are in
`controller.estimation.valve_monitors`.
"""

from __future__ import annotations

import math
from array import array
from typing import Final

from controller.estimation.joint_estimator import TrackedJoint
from machine.status.reasons import Reason

USUAL_SPEED: Final = (0.35, 0.15, 0.28, 0.25, 1.0)
"""The speed limits of ordinary cranes, by which monitors scale how far a joint moves without its valve, in
`machine.joints.Joint` order [rad/s, EXT m/s]: the slower one of the two shipped machines.

Oil yields, steel bends, a grapple swings and a log that is let go relieves the boom: the joint moves by as much whether
its valve lets little oil through or much.  On a machine that is slower than these limits the monitors allow the ways of
a machine that has them (``least_speed``); a third of them took an unloaded boom for a runaway (measured on the plant).
"""


# -- Motion monitor: does a joint follow its command?  (docs/reference/safety.md section 5, cases 1, 5, 16, 17)
#
# The valve's dead time is not known well: it lies between an early and a late bound, whatever the profile says.  So the
# commanded velocity passes two models of the valve, one at either bound, and a joint is wrong only against both.  They
# are compared with the measured velocity in leaky integrals (0.5 s), which are distances: how far the joint should have
# moved by now at the latest, how far it stayed behind that, how far it moved faster than any recent command, and how
# far against its command.  The monitor cannot see a stuck joint below a fifth of the speed limit: a wrong dead-band
# looks the same there.  Slow motion without a command is seen by the standstill monitor.

EARLY_DELAY_S: Final = 0.03
EARLY_LAG_S: Final = 0.03
LATE_DELAY_S: Final = 0.15
LATE_LAG_S: Final = 0.06
"""Bounds of the dead time, and the lags behind it: spool, and compressible oil."""
_MOTION_MEMORY_S: Final = 0.5
_COMMAND_DECAY_S: Final = 0.2
"""A former command at the speed limit still counts for this time, a smaller one longer."""
_MIN_TRAVEL_S: Final = 0.08
"""A joint can be stuck once it should have moved as far as in this time at its speed limit."""
_STUCK_SHARE: Final = 0.7
AGAINST_S: Final = 0.02
"""A joint that went as far against its command as in this time at its speed limit is reversed."""
AGAINST_ELSEWHERE_S: Final = 0.05
"""The same where a PLC closes the loop: its law overshoots and lets the oil ring while ours, which acts on nothing,
asks for a steady speed (0.03 s in one of fifty log jobs on sampled machines)."""
_RUNAWAY_S: Final = 0.06
_YIELDING_S: Final = 0.4
"""The same of a joint that yields to what it carries: a log that caught at a stake wound a rotator up by 0.22 rad and
turned it back as far when it came free, at 1.4 rad/s; behind a PLC it then rang three times by 7 degrees.  Its spool
is watched besides."""
_OVERSPEED_SHARE: Final = 0.25
"""Share of the speed limit by which a joint may be faster than its command: pendulum, ringing, ..."""
_OVERSPEED_GAIN: Final = 0.3
"""... and share of the command: the valve's gain."""
_NONE: Final = Reason.NONE
_REVERSAL_SHARE: Final = 0.1
"""From this share of the speed limit on, motion against the command is reversal and not runaway."""


class MotionMonitor:
    """Monitors one joint; `step` returns the fault, or `Reason.NONE`."""

    __slots__ = (
        "_against",
        "_against_most",
        "_at",
        "_behind",
        "_command_decay",
        "_decay",
        "_early",
        "_early_at",
        "_early_lag",
        "_expected",
        "_late",
        "_late_lag",
        "_limit",
        "_line",
        "_min_travel",
        "_overspeed",
        "_period_s",
        "_recent_command",
        "_runaway_s",
        "_usual",
        "expected_velocity",
    )

    def __init__(
        self,
        spec: TrackedJoint,
        period_s: float,
        later_s: float = 0.0,
        lag_s: float = LATE_LAG_S,
        against_s: float = AGAINST_S,
        least_speed: float = 0.0,
    ) -> None:
        """``later_s``: delay that a bus and a node add to the late bound; ``lag_s``: the lag behind it; ``against_s``:
        one of the two above; ``least_speed``: see `USUAL_SPEED`.
        """
        usual = max(spec.speed_limit, least_speed)
        self._against_most = against_s * usual
        self._line = array("d", [0.0] * (round((LATE_DELAY_S + later_s) / period_s) + 1))
        self._early_at = round(EARLY_DELAY_S / period_s)
        self._period_s = period_s
        self._early_lag, self._late_lag = (-math.expm1(-period_s / s) for s in (EARLY_LAG_S, lag_s))
        self._decay = math.exp(-period_s / _MOTION_MEMORY_S)
        self._limit, self._usual = spec.speed_limit, usual
        self._command_decay = spec.speed_limit * period_s / _COMMAND_DECAY_S
        self._min_travel = _MIN_TRAVEL_S * usual
        self.reset()

    def reset(self) -> None:
        """Start at rest with a neutral valve."""
        self._at = 0
        self._early = self._late = self._recent_command = 0.0
        self.expected_velocity = 0.0
        """What the joint should do now at the latest."""
        self._expected = self._behind = self._overspeed = self._against = 0.0
        self._runaway_s = _RUNAWAY_S
        for i in range(len(self._line)):
            self._line[i] = 0.0

    def forgive(self) -> None:
        """Drop the joint's motion so far as evidence: its command was a spool's, and the map is being measured."""
        self._expected = self._behind = self._overspeed = self._against = 0.0

    def step(self, command: float, velocity: float, yields: bool = False) -> Reason:
        """Take one period with the commanded and the measured velocity [rad/s or m/s]; ``yields``: whether the joint is
        one that gives way to what it carries, and something presses on it now.
        """
        line, at = self._line, self._at
        line[at] = command
        self._early = early = self._early + self._early_lag * (line[at - self._early_at] - self._early)
        self._at = at = at + 1 if at + 1 < len(line) else 0
        self._late = self.expected_velocity = late = self._late + self._late_lag * (line[at] - self._late)
        dt, decay, usual = self._period_s, self._decay, self._usual
        expected, moved = abs(late), abs(velocity)
        self._recent_command = recent = max(abs(early), expected, self._recent_command - self._command_decay)
        commanded = _REVERSAL_SHARE * self._limit
        opposed = (velocity < 0.0 and min(early, late) > commanded) or (
            velocity > 0.0 and max(early, late) < -commanded
        )
        self._expected, self._behind = decay * self._expected, decay * self._behind
        if not (yields and opposed):  # what its load turns back is not stuck
            self._expected += dt * expected
            self._behind += dt * (late - velocity) * math.copysign(1.0, late)
        self._against = decay * self._against + (dt * moved if opposed else 0.0)
        faster = 0.0 if opposed else moved - (1.0 + _OVERSPEED_GAIN) * recent - _OVERSPEED_SHARE * usual
        self._overspeed = max(0.0, decay * self._overspeed + dt * faster)
        if self._against > self._against_most:
            return Reason.JOINT_REVERSED
        if self._expected > self._min_travel and self._behind > _STUCK_SHARE * self._expected:
            return Reason.JOINT_STUCK
        self._runaway_s = _YIELDING_S if yields else _RUNAWAY_S
        if self._overspeed > self._runaway_s * usual:
            return Reason.JOINT_RUNAWAY
        return _NONE

    def shares(self) -> tuple[float, float, float]:
        """Compute what was measured over what is a fault: joint reversed, stuck, running away.  1 and more is one."""
        expected = self._expected
        behind = self._behind / (_STUCK_SHARE * expected) if expected > 0.0 else 0.0
        return (
            self._against / self._against_most,
            max(0.0, min(expected / self._min_travel, behind)),
            self._overspeed / (self._runaway_s * self._usual),
        )


# -- Standstill monitor: does a joint stay where it is while its valve is neutral?  (docs/reference/safety.md case 17)
#
# The motion monitor compares speeds and cannot see a joint that drifts slowly.  This monitor compares distances.  A
# joint at rest still moves: the oil yields to a swinging grapple, a stop rings, a leaking valve creeps.  All of these
# turn back or are very slow; a valve stuck open does neither.  So the monitor keeps the range in which the joint has
# moved lately and measures how far, and for how long, the joint goes out of it in one direction without turning back.
# The range grows to every turning point, and shrinks towards the joint in `FORGET_S`.
#
# Far away in a short time counts as much as near in a long one: a joint runs away when it is out by more than a
# distance and the product of distance and time is over the limit.  The distance is small while everything is calm,
# greater while another function moves or the carrier drives, because they shake the joint, and greatest while the jaws
# are at work: they press on ground and logs, and a log that they let go relieves the boom.

CLOSING_S: Final = 0.5
"""A valve that was open shuts, and its oil comes to rest, within this time (dead time `LATE_DELAY_S`, lags 0.06 s and
0.04 s): the range grows with the joint meanwhile.  A dead time that is longer by the profile is added."""
CALM_S: Final = 1.5
"""Time without any command after which the distance is the small one."""
FORGET_S: Final = 2.0
"""The range shrinks towards the joint with this time constant."""
CALM_S_AT_LIMIT: Final = 0.011
"""Distance while everything is calm: the way of this time at the speed limit.  It is ten times the noise of an estimate
(0.2 mrad), and less than 3 % of the speed limit cover in 0.5 s."""
SHAKEN_S_AT_LIMIT: Final = 0.03
"""Distance while something else moves: a grapple that swings by 0.1 rad turns the slew by 5 mrad on its oil."""
PRESSED_S_AT_LIMIT: Final = 0.1
"""Distance while the jaws press: closing in a heap turned a slew by 17 mrad (0.038 s), and it would have gone on."""
HOLD_S: Final = 0.15
"""Time at the distance that makes a runaway; at twice the distance half of it."""
REST_S: Final = 0.5
"""A joint that has gone no further, as far as its noise lets tell, for this time rests, wherever it is; the noise over
this time is a creep that is never seen, 1 % of the lift's speed limit on the shipped machines and less elsewhere."""
TURNED_SHARE: Final = 0.25
"""A joint that has come back by this share of its way out has turned."""


class StandstillMonitor:
    """Monitors one joint; ``moves`` tells whether it moves without a command."""

    __slots__ = (
        "_calm_far",
        "_calm_s",
        "_closing_s",
        "_far",
        "_forget",
        "_gone_to",
        "_high",
        "_low",
        "_neutral_s",
        "_noise",
        "_out",
        "_out_s",
        "_peak",
        "_period_s",
        "_pressed_far",
        "_rest_s",
        "_shaken_far",
        "_started",
        "moves",
        "quiet_s",
    )

    def __init__(self, spec: TrackedJoint, period_s: float, delay_s: float = 0.0, least_speed: float = 0.0) -> None:
        """``delay_s``: the dead time of the joint's valve by the profile; ``least_speed``: see `USUAL_SPEED`."""
        usual = max(spec.speed_limit, least_speed)
        encoder = spec.encoder
        self._noise = 0.0 if encoder is None else encoder.noise + encoder.unit_per_count
        self._period_s = period_s
        self._closing_s = CLOSING_S + max(0.0, delay_s - LATE_DELAY_S)
        self._forget = period_s / FORGET_S
        self._calm_far = CALM_S_AT_LIMIT * usual
        self._shaken_far = SHAKEN_S_AT_LIMIT * usual
        self._pressed_far = PRESSED_S_AT_LIMIT * usual
        self.moves = False
        self.reset()

    def reset(self) -> None:
        """Reset as if nothing were known of the joint."""
        self._started = self.moves = False
        self._low = self._high = self._peak = self._gone_to = 0.0
        self._out = self._out_s = self._neutral_s = self._calm_s = self._rest_s = 0.0
        self._far = self._calm_far
        self.quiet_s = 0.0
        """How long the joint has not moved."""

    def step(self, neutral: bool, shaken: bool, position: float, slack: float = 0.0, pressed: bool = False) -> bool:
        """Take one period: whether the valve is ``neutral``, whether something else shakes the joint, its position, how
        much farther it may yield to a slope (`SlopeYield`), and whether jaws press on it.
        """
        if not self._started or not neutral:
            self._started = True
            self._low = self._high = self._peak = self._gone_to = position
            self._rest_s = self._out = self._out_s = self._neutral_s = self._calm_s = self.quiet_s = 0.0
            self.moves = False
            return False
        dt = self._period_s
        self._neutral_s += dt
        self._calm_s = 0.0 if shaken else self._calm_s + dt
        calm = self._calm_s > CALM_S
        begins = calm and self._calm_s <= CALM_S + dt  # the range that counts now is that of the shaken joint
        far = slack + (self._pressed_far if pressed else self._calm_far if calm else self._shaken_far)
        low, high = self._low, self._high
        if position > high:
            out = position - high
            turned = self._peak - position if self._peak > high else 0.0
            self._peak = max(self._peak, position)
        elif position < low:
            out = low - position
            turned = position - self._peak if self._peak < low else 0.0
            self._peak = min(self._peak, position)
        else:
            out = turned = 0.0
        if abs(self._peak - self._gone_to) > self._noise:
            self._gone_to, self._rest_s = self._peak, 0.0
        else:
            self._rest_s += dt
        learns = begins or self._rest_s > REST_S
        if out == 0.0 or learns or self._neutral_s <= self._closing_s or turned > TURNED_SHARE * out + self._noise:
            self._absorb(position)
        else:
            self._out_s += dt
        self._low += self._forget * (position - self._low)
        self._high += self._forget * (position - self._high)
        self._out, self._far = out, far
        self.moves = out > far and out * self._out_s > far * HOLD_S
        self.quiet_s = 0.0 if out > far else self.quiet_s + dt
        return self.moves

    def share(self) -> float:
        """Compute what was measured over what is a motion; 1 and more is one."""
        out = self._out / self._far
        return min(out, out * self._out_s / HOLD_S)

    def _absorb(self, position: float) -> None:
        """Extend the range to the joint: it is inside, has turned back, or its valve is still closing."""
        self._low, self._high = min(self._low, self._peak, position), max(self._high, self._peak, position)
        self._peak = self._gone_to = position
        self._out_s = self._rest_s = 0.0


# -- Slope yield: how far the slew may yield on its oil because the machine leans, although its valve is shut.
#
# On ground that falls across the boom, gravity turns the slew; the oil holds it like a spring.  A crane of mass m at
# reach r that swings on this oil with w has the stiffness m r^2 w^2, and leans against it with m g r sin(lean): it
# yields by g sin(lean) / (r w^2), 0.2 rad for each radian far out (7.5 m, a period of 2.5 s), and swings as far again.
# So a slew yields when the lean changes, as a wheel climbs a stump, and on a slope when a log is lifted: 110 kg at 7.5
# m on 10 degrees are 1.4 kNm, which turned it by 7 mrad within a second (measured on the plant).  Jaws that close about
# a log pull it likewise.  On level ground there is nothing to yield to, and nothing changes.

LEAN_FORGET_S: Final = 2.0
"""The range of the last inclinations shrinks with this time constant."""
LEVEL_RAD: Final = 0.02
"""An inclination, or a change of it, below this is none: noise of the sensor, and tyres that give."""
YIELD_SHARE: Final = 0.4
"""Yield for each radian of lean, with its swing."""
YIELD_LIMIT_RAD: Final = 0.06


class SlopeYield:
    """`step` once per period; ``rad`` is how far the slew may yield now."""

    __slots__ = ("_forget", "_high", "_low", "rad")

    def __init__(self, period_s: float) -> None:
        self._forget = period_s / LEAN_FORGET_S
        self._low = [0.0, 0.0]
        self._high = [0.0, 0.0]
        self.rad = 0.0

    def step(self, pressed: bool, roll_rad: float, pitch_rad: float) -> None:
        """Tell whether jaws or a load press on the boom, or did lately; the inclination of its base (NaN: unknown)."""
        turned = self._range(0, roll_rad) + self._range(1, pitch_rad)
        if pressed:
            turned += self._beyond_level(abs(roll_rad)) + self._beyond_level(abs(pitch_rad))
        self.rad = min(YIELD_SHARE * turned, YIELD_LIMIT_RAD)

    def _beyond_level(self, angle_rad: float) -> float:
        return angle_rad - LEVEL_RAD if angle_rad > LEVEL_RAD else 0.0

    def _range(self, axis: int, angle_rad: float) -> float:
        """Tell how far the machine has leaned to and fro about an axis lately."""
        if angle_rad != angle_rad:
            return 0.0
        low, high, forget = self._low, self._high, self._forget
        low[axis] = min(angle_rad, low[axis] + forget * (angle_rad - low[axis]))
        high[axis] = max(angle_rad, high[axis] + forget * (angle_rad - high[axis]))
        return self._beyond_level(high[axis] - low[axis])


# -- Drift monitor: does a joint creep away, by its encoder, while its valve is shut?  (docs/reference/safety.md case 3)
#
# An encoder that drifts slowly looks like a joint that moves.  While the reference stands, the law pulls the joint back
# by small pulses (`controller.laws.joint.EndPositioning`), so that the error stays small and nothing else shows: the
# real joint wanders with the drift.  What shows is that the joint goes one way whenever its valve is shut and is
# commanded the other way whenever it is open.  Both ways are summed in leaky integrals.  A valve that leaks as fast
# looks the same, and deserves the same.  While the reference moves, the valve is open and the monitor is blind; what
# was commanded then is no pulse and does not count, or the way to a pose would hide a drift along it for seconds.
#
# It is judged only where nothing else explains a creep.  Jaws that press on ground and logs, a log that they let go,
# another joint's valve and a carrier that drives move every joint by some millimetres on its oil and steel, within some
# tenths of a second; a law answers them by the same pulses.  So what a joint does while one of them is at work, and
# `SETTLE_S` longer, is no evidence (``calm``).

DRIFT_MEMORY_S: Final = 3.0
SHUT_S: Final = 0.4
"""What a joint does until this time after its valve has shut belongs to the command before."""
PULSE_S: Final = 1.0
"""A valve that is open for longer follows a reference that moves: the longest pulse takes 0.8 s."""
DRIFT_S_AT_LIMIT: Final = 0.012
DRIFT_NOISES: Final = 3.0
"""A drift is further than the way of the first at the speed limit and this many times noise and resolution, ..."""
SETTLE_S: Final = 1.0
"""A joint that something else moved has come to rest on its oil after this time."""
COMMANDED_SHARE: Final = 0.3
"""... and the command went at least this share of it the other way: the gain of small pulses is known badly."""


class DriftMonitor:
    """Monitors one joint; `step` tells whether it drifts."""

    __slots__ = (
        "_alone",
        "_before",
        "_calm_s",
        "_commanded",
        "_decay",
        "_limit",
        "_open_s",
        "_period_s",
        "_shut_s",
    )

    def __init__(self, spec: TrackedJoint, period_s: float, least_speed: float = 0.0) -> None:
        """``least_speed``: see `USUAL_SPEED`."""
        encoder = spec.encoder
        noise = 0.0 if encoder is None else encoder.noise + encoder.unit_per_count
        usual = max(spec.speed_limit, least_speed)
        self._limit = DRIFT_S_AT_LIMIT * usual + DRIFT_NOISES * noise
        self._period_s, self._decay = period_s, math.exp(-period_s / DRIFT_MEMORY_S)
        self.reset()

    def reset(self) -> None:
        """Reset as if nothing had moved yet."""
        self._alone = self._commanded = self._before = self._shut_s = self._open_s = self._calm_s = 0.0

    def step(self, neutral: bool, expected_velocity: float, position: float, calm: bool) -> bool:
        """Take one period: is the valve ``neutral``, the velocity that the command lets expect, the position, and
        whether nothing else moves the joint.
        """
        self._shut_s = self._shut_s + self._period_s if neutral else 0.0
        self._calm_s = self._calm_s + self._period_s if calm else 0.0
        self._open_s = 0.0 if neutral else self._open_s + self._period_s
        judged = self._shut_s > SHUT_S and self._calm_s > SETTLE_S
        moved = position - self._before if judged else 0.0
        self._before = position
        self._alone = alone = self._decay * self._alone + moved
        if self._open_s > PULSE_S:
            self._commanded = 0.0
        else:
            self._commanded = self._decay * self._commanded + self._period_s * expected_velocity
        against = -self._commanded if alone > 0.0 else self._commanded
        return abs(alone) > self._limit and against > COMMANDED_SHARE * abs(alone)

    def share(self) -> float:
        """Compute what was measured over what is a drift; 1 and more is one."""
        alone = abs(self._alone)
        against = -self._commanded if self._alone > 0.0 else self._commanded
        return max(0.0, min(alone / self._limit, against / (COMMANDED_SHARE * alone))) if alone > 0.0 else 0.0
