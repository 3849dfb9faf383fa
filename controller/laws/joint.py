"""The law of one joint: feed-forward, delay compensation, feedback, pressure damping, end positioning and limits::

    v_cmd = qdot_ref(t + delay + lag + oil) + feedback(e - in flight) - damping * load pressure without its mean

Inputs in rad or m, output a joint velocity.  The feed-forward leads, because the trajectory is known ahead.  Travel
that was commanded beyond it within the last delay and lag is in flight: the joint has not shown it yet, so it counts as
done (Smith predictor; the profile's delay need not be exact, `timberhand bench loop-design` computes the margins).  The
load pressure of a swinging load or a ringing boom is fed back to the valve, which yields (paper B's damping of residual
vibrations).  `JointLaw.desired_velocity` is what the joint alone would command, `JointLaw.command` what it may: scaled
with all joints and within the acceleration limit.
"""

from __future__ import annotations

import math
from enum import IntEnum
from typing import Final

from controller.laws.feedback import ESTIMATING, law_of
from controller.laws.response import CommandBound, DelayCompensation, ValveGain
from controller.laws.valve_map import ValveMap
from machine.profile import SPEED_HEADROOM_SHARE, JointSpec

# -- End positioning: bring a joint to its goal and keep it there, without a limit cycle.
#
# Quantised feedback, a dead-band whose edges are known to a few percent of the stroke, a dead time, and a load that
# swings on soft oil would keep any continuous law hunting (docs/reference/machines.md section 13, trap 1).  So where
# the reference stands still, the law only brings the joint near.  Then the valve shuts until the joint has settled, and
# the rest is covered by inching: the valve opens a little for as long as the remaining distance takes, and shuts until
# the joint has settled again.
#
# The distance of an inch is the oil that was metered, whatever the delay.  Two things are learned per direction: how
# far an inch really goes, and how far the valve must open to move at all.  A long inch shows before it is over: it ends
# as soon as what is still to come covers what is left.  Within the stop band nothing happens, and every inch at one
# place widens the band.


INCH_SHARE: Final = 0.03
"""Speed of an inch over the full speed of its side."""
REACH_S: Final = 0.8
"""The law brings the joint as near as an inch goes in this time."""
OPENING_STEP_SHARE: Final = 0.02
"""After an inch that moved nothing the valve opens by this share of the full speed more the next time, ..."""
MAX_OPENING_SHARE: Final = 0.14
"""... up to this share."""
NO_MOTION_SHARE: Final = 0.2
"""An inch that covered less than this share of its distance moved nothing."""
LEARNING_SHARE: Final = 0.7
"""Share of an inch's error that the next one in that direction corrects, ..."""
FULL_LEARNING_BANDS: Final = 4.0
"""... and less for a distance below this many stop bands, because a swinging load may cause as much."""
MIN_GAIN: Final = 0.3
MAX_GAIN: Final = 4.0
WIDENING_SHARE: Final = 0.25
"""Every inch at one place widens the stop band by this share."""
FAST_MEAN_S: Final = 0.1
SLOW_MEAN_S: Final = 0.4
SETTLED_SHARE: Final = 0.4
"""Settled: a fast and a slow mean of the error agree to this share of the stop band for `SETTLED_S`."""
SETTLED_S: Final = 0.2
MAX_SETTLING_S: Final = 1.6
"""A joint that never settles (a load swings on it) counts as settled after this time."""
FAR_BANDS: Final = 4.0
"""A joint that arrived more than this many stop bands away need not settle before the first inch, ..."""
FAR_WAIT_S: Final = 0.3
"""... but the valve must have shut."""


class _Phase(IntEnum):
    FOLLOWING = 0
    """The reference moves."""
    ARRIVING = 1
    """The reference stands, and the law brings the joint near."""
    INCHING = 2
    SETTLING = 3
    RESTING = 4


class EndPositioning:
    """End positioning of one joint; `step` returns the velocity to command in place of the law's."""

    __slots__ = (
        "_band",
        "_before",
        "_direction",
        "_distance",
        "_fast",
        "_full",
        "_gain",
        "_inches",
        "_lag_s",
        "_left_s",
        "_open",
        "_opened_s",
        "_phase",
        "_reaction_s",
        "_settling_s",
        "_slow",
        "_stall_s",
        "_still_s",
    )

    def __init__(self, spec: JointSpec) -> None:
        valve = spec.valve
        self._band = spec.law.stop_band
        self._lag_s = valve.lag_s
        self._reaction_s = valve.delay_s + valve.lag_s + valve.oil_s
        self._stall_s = SETTLED_S + 2.0 * (valve.delay_s + valve.lag_s)
        self._full = (valve.full_speed_minus, valve.full_speed_plus)
        self._open = [INCH_SHARE, INCH_SHARE]
        self._gain = [1.0, 1.0]
        self.reset()

    def reset(self) -> None:
        """Reset to resting with a neutral valve; what was learned is kept."""
        self._phase = _Phase.RESTING
        self._direction = self._inches = 0
        self._left_s = self._settling_s = self._still_s = self._fast = self._slow = 0.0
        self._before = self._distance = self._opened_s = 0.0

    @property
    def resting(self) -> bool:
        """Whether the valve is shut."""
        return self._phase >= _Phase.SETTLING

    def follow(self) -> None:
        """Follow the moving reference: the law controls the joint."""
        self._phase = _Phase.FOLLOWING
        self._inches = 0

    def step(self, error: float, predicted: float, wanted: float, elapsed_s: float) -> float:
        """Compute the velocity to command while the reference stands still [rad/s, m/s].

        ``error``: reference less position; ``predicted``: the same once all commands in flight have come through;
        ``wanted``: the law's command.
        """
        self._fast += min(1.0, elapsed_s / FAST_MEAN_S) * (error - self._fast)
        self._slow += min(1.0, elapsed_s / SLOW_MEAN_S) * (error - self._slow)
        if self._phase is _Phase.FOLLOWING:
            self._phase = _Phase.ARRIVING
            self._start_observing(error)
        if self._phase is _Phase.ARRIVING:
            # A law that moves nothing, because the dead-band is wider than in the profile, is of no more use.
            if abs(predicted) > self._reach(predicted) and not self._stands_still(self._stall_s, elapsed_s):
                return wanted
            self._settle(error, 0)
        elif self._phase is _Phase.INCHING:
            return self._inch(error, elapsed_s)
        elif self._phase is _Phase.SETTLING:
            if self._stands_still(SETTLED_S, elapsed_s) or self._settling_s >= MAX_SETTLING_S:
                self._learn()
                self._phase = _Phase.RESTING
            elif self._direction == 0 and self._far(error):
                self._phase = _Phase.RESTING
        elif abs(self._slow) > self._band * (1.0 + WIDENING_SHARE * self._inches):
            return self._begin_inch(error)
        return 0.0

    def _reach(self, error: float) -> float:
        """Compute the distance that an inch may cover."""
        side = error > 0.0
        return REACH_S * INCH_SHARE * self._full[side]

    def _far(self, error: float) -> bool:
        """Tell whether so much is left that the joint need not settle before the first inch."""
        left = min(self._slow, self._fast, error) if error > 0.0 else -max(self._slow, self._fast, error)
        return self._settling_s > FAR_WAIT_S and left > FAR_BANDS * self._band

    def _settle(self, error: float, direction: int) -> None:
        self._phase = _Phase.SETTLING
        self._direction = direction
        self._start_observing(error)

    def _start_observing(self, error: float) -> None:
        self._settling_s = self._still_s = 0.0
        self._fast = self._slow = error

    def _stands_still(self, for_s: float, elapsed_s: float) -> bool:
        """Tell whether the error has not changed for this time."""
        self._settling_s += elapsed_s
        still = abs(self._fast - self._slow) < SETTLED_SHARE * self._band and self._settling_s > SLOW_MEAN_S
        self._still_s = self._still_s + elapsed_s if still else 0.0
        return self._still_s >= for_s

    def _begin_inch(self, error: float) -> float:
        """Begin an inch; a long distance takes more than one."""
        side = self._slow > 0.0
        self._phase = _Phase.INCHING
        self._direction, self._before = (1 if side else -1), self._slow
        self._distance = min(abs(self._slow), 2.0 * self._reach(self._slow))
        self._inches += self._distance == abs(self._slow)
        self._left_s = self._distance / self._inch_speed() + self._lag_s
        self._opened_s = 0.0
        return self._inch(error, 0.0)

    def _inch_speed(self) -> float:
        """Compute the expected speed of the present inch."""
        side = self._direction > 0
        return self._gain[side] * self._open[side] * self._full[side]

    def _inch(self, error: float, elapsed_s: float) -> float:
        direction, side = self._direction, self._direction > 0
        self._left_s -= elapsed_s
        self._opened_s += elapsed_s
        if self._covered(error):
            self._distance -= max(0.0, self._left_s) * self._inch_speed()
            self._left_s = 0.0
        if self._left_s <= 0.0 or direction * error < -self._band:
            self._settle(error, direction)
            return 0.0
        return direction * self._open[side] * self._full[side]

    def _covered(self, error: float) -> bool:
        """Tell whether a joint that shows the inch reaches its goal with what is still to come, or passes it."""
        coming = self._direction * (self._fast - error) * self._reaction_s / FAST_MEAN_S
        return self._opened_s > self._reaction_s and coming > max(0.0, self._direction * error)

    def _learn(self) -> None:
        if self._direction == 0:
            return
        side = self._direction > 0
        went = self._direction * (self._before - self._slow) / self._distance
        if went < NO_MOTION_SHARE:
            self._open[side] = min(self._open[side] + OPENING_STEP_SHARE, MAX_OPENING_SHARE)
        else:
            learned = LEARNING_SHARE * min(1.0, self._distance / (FULL_LEARNING_BANDS * self._band))
            self._gain[side] = min(max(self._gain[side] * (1.0 + learned * (went - 1.0)), MIN_GAIN), MAX_GAIN)


# -- The law


ACCELERATION_FACTOR: Final = 4.0
"""The command may change this many times faster than the planner's acceleration limit."""
END_GAIN_1_S: Final = 4.0
"""Speed limit over the distance to the end of the range: a joint can stop before it."""
STANDING_UNIT_S: Final = 1e-7
"""A reference slower than this stands; the rest is rounding."""
PRESSURE_MEAN_S: Final = 2.0
"""Slower changes of the load pressure are load, not vibration."""
PRESSURE_SMOOTH_S: Final = 0.05
"""The delayed valve would answer a faster vibration too late."""


class VibrationFilter:
    """Band-pass of a pressure: without its mean and without fast noise."""

    __slots__ = ("_mean", "_smooth", "known")

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Make the next value the mean."""
        self.known = False
        self._mean = self._smooth = 0.0

    def step(self, bar: float, elapsed_s: float) -> float:
        """Return the vibration [bar] in a pressure; 0 for an unknown pressure (NaN)."""
        if bar != bar:
            self.known = False
            return 0.0
        if not self.known:
            self.known = True
            self._mean = self._smooth = bar
        self._smooth += min(1.0, elapsed_s / PRESSURE_SMOOTH_S) * (bar - self._smooth)
        self._mean += min(1.0, elapsed_s / PRESSURE_MEAN_S) * (self._smooth - self._mean)
        return self._smooth - self._mean


class JointLaw:
    """The law of one joint; ``velocity_command`` is its last command [rad/s, m/s]."""

    __slots__ = (
        "_bound",
        "_damping",
        "_end_positioning",
        "_feedback",
        "_flight",
        "_frozen",
        "_gain",
        "_lead",
        "_lower",
        "_max_rate",
        "_max_step",
        "_plain",
        "_position",
        "_speed",
        "_stood",
        "_upper",
        "_valve",
        "_vibration",
        "has_encoder",
        "lead_ns",
        "velocity_command",
        "velocity_desired",
    )

    def __init__(self, spec: JointSpec, valve_map: ValveMap, period_s: float) -> None:
        law, valve = spec.law, spec.valve
        reaction_s = valve.delay_s + valve.lag_s
        self._feedback = law_of(law)
        self._flight = DelayCompensation(reaction_s, period_s)
        self._vibration = VibrationFilter()
        self._end_positioning = EndPositioning(spec)
        self._max_step = spec.law.stop_band
        self._plain = law.kind == "pd_plain" and spec.encoder is not None
        self._damping = 0.0 if self._plain else law.damping_per_bar
        self._lower, self._upper = spec.lower, spec.upper
        self._speed = SPEED_HEADROOM_SHARE * spec.speed_limit
        self._valve = valve_map
        self._max_rate = ACCELERATION_FACTOR * spec.acceleration_limit
        self.has_encoder = spec.encoder is not None
        self.lead_ns = int((reaction_s + valve.oil_s) * 1e9)
        """Lead of the feed-forward."""
        self._bound = CommandBound(spec.speed_limit, reaction_s + valve.oil_s, period_s)
        self._gain: ValveGain | None = None
        if self.has_encoder and law.kind == ESTIMATING:
            self._gain = ValveGain(spec.speed_limit, reaction_s + valve.oil_s, period_s)
        self._position = 0.0
        self.reset()

    def reset(self) -> None:
        """Reset for a valve at neutral."""
        self.velocity_command = self.velocity_desired = self._lead = 0.0
        self._frozen = False
        self._stood = math.nan
        self._feedback.reset()
        self._flight.reset()
        self._vibration.reset()
        self._end_positioning.reset()
        self._bound.reset()
        if self._gain is not None:
            self._gain.reset()

    @property
    def resting(self) -> bool:
        """Whether end positioning keeps the valve shut."""
        return self.has_encoder and self._end_positioning.resting

    def desired_velocity(
        self,
        q_ref: float,
        v_ref: float,
        v_lead: float,
        q: float,
        v: float,
        load_bar: float,
        elapsed_s: float,
        damping: float = 0.0,
        displaced: float = 0.0,
    ) -> float:
        """Compute the velocity that this joint alone would command [rad/s, m/s]; also kept in ``velocity_desired``.

        ``q_ref`` and ``v_ref``: reference now; ``v_lead``: its velocity ``lead_ns`` ahead; ``q`` and ``v``: estimates;
        ``load_bar``: load pressure, NaN where there is none.  ``damping`` and ``displaced``: velocity and displacement
        that sway damping adds to the reference (`controller.laws.sway`); end positioning waits until both are zero.
        """
        self._lead = command = v_ref if self._plain else v_lead
        if self.has_encoder:
            self._position = q
            swayed = damping != 0.0 or displaced != 0.0
            error = q_ref + displaced - q if swayed else q_ref - q
            predicted = error if self._plain else error - self._flight.travel
            vibration = self._vibration.step(load_bar, elapsed_s)
            command += self._feedback.step(predicted, v_ref - v, elapsed_s, self._frozen)
            command -= self._damping * vibration
            if swayed:
                command += damping
            if self._gain is not None:
                command /= self._gain.of(command)
            stands = not swayed and abs(v_ref) < STANDING_UNIT_S and abs(v_lead) < STANDING_UNIT_S
            # A reference that jumped is for the law, not for end positioning.
            if stands and not abs(q_ref - self._stood) > self._max_step:
                if self._stood != self._stood:
                    self._stood = q_ref
                command = self._end_positioning.step(error, predicted, command, elapsed_s)
                if self._end_positioning.resting:
                    self._feedback.reset()
            else:
                self._end_positioning.follow()
                self._stood = q_ref
            command = min(command, max(0.0, (self._upper - q) * END_GAIN_1_S))
            command = max(command, min(0.0, (self._lower - q) * END_GAIN_1_S))
        self.velocity_desired = command
        return command

    def feasible_share(self, cap: float) -> float:
        """Compute the share of the desired velocity within valve and speed limit; ``cap`` scales the speed limit."""
        desired = self.velocity_desired
        limit = min(self._speed * cap, self._valve.full_plus if desired >= 0.0 else self._valve.full_minus)
        if self.has_encoder:
            limit = min(limit, self._bound.limit(desired))
        return limit / abs(desired) if abs(desired) > limit else 1.0

    def command(self, share: float, elapsed_s: float) -> float:
        """Compute the velocity to command when all joints get this ``share`` of their desired velocities."""
        change = self._max_rate * elapsed_s
        last = self.velocity_command
        command = min(max(share * self.velocity_desired, last - change), last + change)
        self._frozen = command != self.velocity_desired
        expected = command if self._gain is None else command * self._gain.of(command)
        self._flight.add((expected - self._lead) * elapsed_s)
        self.velocity_command = command
        if self.has_encoder:
            self._bound.add(command, self._position, elapsed_s)
        if self._gain is not None:
            self._gain.add(command, self._position, elapsed_s)
        return command
