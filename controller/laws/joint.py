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
from typing import Final

from controller.laws.command_bound import CommandBound
from controller.laws.delay_compensation import DelayCompensation
from controller.laws.end_positioning import EndPositioning
from controller.laws.feedback import law_of
from controller.laws.valve_map import ValveMap
from machine.motion_limits import SPEED_HEADROOM_SHARE
from machine.profile import JointSpec

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
        """The next value becomes the mean."""
        self.known = False
        self._mean = self._smooth = 0.0

    def step(self, bar: float, elapsed_s: float) -> float:
        """The vibration [bar] in a pressure; 0 for an unknown pressure (NaN)."""
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
        "_bound", "_damping", "_end_positioning", "_feedback", "_flight", "_frozen", "_lead", "_lower", "_max_rate",
        "_max_step", "_plain", "_position", "_speed", "_stood", "_upper", "_valve", "_vibration", "has_encoder",
        "lead_ns", "velocity_command", "velocity_desired",
    )  # fmt: skip

    def __init__(self, spec: JointSpec, valve_map: ValveMap, period_s: float) -> None:
        law, valve = spec.law, spec.valve
        reaction_s = valve.delay_s + valve.lag_s
        self._feedback = law_of(law)
        self._flight = DelayCompensation(reaction_s, period_s)
        self._vibration = VibrationFilter()
        self._end_positioning = EndPositioning(spec)
        self._max_step = spec.law.stop_band
        self._plain = law.kind == "pid" and spec.encoder is not None
        self._damping = 0.0 if self._plain else law.damping_per_bar
        self._lower, self._upper = spec.lower, spec.upper
        self._speed = SPEED_HEADROOM_SHARE * spec.speed_limit
        self._valve = valve_map
        self._max_rate = ACCELERATION_FACTOR * spec.acceleration_limit
        self.has_encoder = spec.encoder is not None
        self.lead_ns = int((reaction_s + valve.oil_s) * 1e9)
        """Lead of the feed-forward."""
        self._bound = CommandBound(spec.speed_limit, reaction_s + valve.oil_s, period_s)
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
        """The velocity that this joint alone would command [rad/s, m/s]; also kept in ``velocity_desired``.

        ``q_ref`` and ``v_ref``: reference now; ``v_lead``: its velocity ``lead_ns`` ahead; ``q`` and ``v``: estimates;
        ``load_bar``: load pressure, NaN where there is none.  ``damping`` and ``displaced``: velocity and displacement
        that sway damping adds to the reference (`controller.laws.sway`); end positioning waits until both are zero.
        """
        self._lead = command = 0.0 if self._plain else v_lead
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
        """Share of the desired velocity within valve and speed limit; ``cap`` scales the speed limit."""
        desired = self.velocity_desired
        limit = min(self._speed * cap, self._valve.full_plus if desired >= 0.0 else self._valve.full_minus)
        if self.has_encoder:
            limit = min(limit, self._bound.limit(desired))
        return limit / abs(desired) if abs(desired) > limit else 1.0

    def command(self, share: float, elapsed_s: float) -> float:
        """The velocity to command when all joints get this ``share`` of their desired velocities."""
        change = self._max_rate * elapsed_s
        last = self.velocity_command
        command = min(max(share * self.velocity_desired, last - change), last + change)
        self._frozen = command != self.velocity_desired
        self._flight.add((command - self._lead) * elapsed_s)
        self.velocity_command = command
        if self.has_encoder:
            self._bound.add(command, self._position, elapsed_s)
        return command
