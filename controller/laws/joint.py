"""The law of one joint: feed-forward, delay compensation, a feedback, pressure damping, rest and limits::

    v_cmd = qdot_ref(t + delay + lag + oil) + feedback(e - in flight) - damping * load pressure without its mean

Inputs in rad and m per joint, output a joint velocity.  The feed-forward leads because the trajectory is known ahead.
What was commanded beyond it within the last delay and lag is in flight: the joint has not shown it yet, so it counts as
done (Smith's predictor; the profile's delay need not be the true one, `timberhand bench loop-design` has the margins).
The load pressure of a swinging load or a ringing boom goes back to the valve, which gives way (paper B's damping of
residual vibrations).  `wanted` says what the joint would like, `finish` what it gets: slowed with all others, within
what changes per second the machine bears.
"""

from __future__ import annotations

import math
from array import array
from typing import Final

from controller.laws.end_positioning import Rest
from controller.laws.feedback import LAWS
from controller.valve import ValveMap
from machine.profile import JointSpec

HEADROOM: Final = 1.25
"""Share of the speed limit that a correction may use, so that a joint behind its reference can catch up."""
ACCELERATION_FACTOR: Final = 4.0
"""The command may change this many times faster than the planner's acceleration limit."""
END_GAIN_1_S: Final = 4.0
"""Near the ends of its range a joint is no faster than it can stop."""
STANDING: Final = 1e-7
"""A reference slower than this stands; the rest is rounding."""
PRESSURE_MEAN_S: Final = 2.0
"""What the load pressure does slower than this is load, not vibration."""
PRESSURE_SMOOTH_S: Final = 0.05
"""Faster than this the delayed valve would answer a vibration too late."""


class InFlight:
    """Travel that was commanded but cannot show yet: the commands of the last delay, of fixed size."""

    __slots__ = ("_at", "_line", "travel")

    def __init__(self, delay_s: float, period_s: float) -> None:
        self._line = array("d", [0.0] * max(1, round(delay_s / period_s)))
        self.reset()

    def reset(self) -> None:
        """Nothing is under way."""
        self._at = 0
        self.travel = 0.0
        for i in range(len(self._line)):
            self._line[i] = 0.0

    def add(self, travel: float) -> None:
        """One tick's commanded travel; the oldest has come through."""
        line, at = self._line, self._at
        self.travel += travel - line[at]
        line[at] = travel
        self._at = at + 1 if at + 1 < len(line) else 0


class Vibration:
    """A pressure without its mean and without what is too fast."""

    __slots__ = ("_mean", "_smooth", "known")

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """The next value is the mean."""
        self.known = False
        self._mean = self._smooth = 0.0

    def step(self, bar: float, elapsed_s: float) -> float:
        """The vibration [bar] in a pressure; 0 for one that is unknown (NaN)."""
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
    """The law of one joint; the velocity it got last is ``velocity_command``."""

    __slots__ = (
        "_damping", "_feedback", "_flight", "_frozen", "_lead", "_lower", "_max_rate", "_plain", "_rest", "_speed",
        "_step", "_stood", "_upper", "_valve", "_vibration", "has_encoder", "lead_ns", "velocity_command",
        "velocity_wanted",
    )  # fmt: skip

    def __init__(self, spec: JointSpec, valve_map: ValveMap, period_s: float) -> None:
        law, valve = spec.law, spec.valve
        reaction_s = valve.delay_s + valve.lag_s
        self._feedback = LAWS[law.kind](law)
        self._flight = InFlight(reaction_s, period_s)
        self._vibration = Vibration()
        self._rest = Rest(spec)
        self._step = spec.law.stop_band
        self._plain = law.kind == "pid" and spec.encoder is not None
        self._damping = 0.0 if self._plain else law.damping_per_bar
        self._lower, self._upper = spec.lower, spec.upper
        self._speed = HEADROOM * spec.speed_limit
        self._valve = valve_map
        self._max_rate = ACCELERATION_FACTOR * spec.acceleration_limit
        self.has_encoder = spec.encoder is not None
        self.lead_ns = int((reaction_s + valve.oil_s) * 1e9)
        """How far ahead the feed-forward looks."""
        self.reset()

    def reset(self) -> None:
        """Forgets the last command: the valve is at neutral."""
        self.velocity_command = self.velocity_wanted = self._lead = 0.0
        self._frozen = False
        self._stood = math.nan
        self._feedback.reset()
        self._flight.reset()
        self._vibration.reset()
        self._rest.reset()

    @property
    def resting(self) -> bool:
        """Whether it keeps the valve shut because nothing is to be done."""
        return self.has_encoder and self._rest.resting

    def wanted(
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
        """The velocity that this joint alone would command [unit/s]; also in ``velocity_wanted``.

        Reference and its velocity now, its velocity ``lead_ns`` ahead; position and velocity as estimated;
        load pressure [bar], NaN where there is none.  ``damping`` and ``displaced``: a motion on top of the
        reference's and how far it went (`controller.laws.sway`); while they last the joint does not rest.
        """
        self._lead = command = 0.0 if self._plain else v_lead
        if self.has_encoder:
            swayed = damping != 0.0 or displaced != 0.0
            error = q_ref + displaced - q if swayed else q_ref - q
            predicted = error if self._plain else error - self._flight.travel
            vibration = self._vibration.step(load_bar, elapsed_s)
            command += self._feedback.step(predicted, v_ref - v, elapsed_s, self._frozen)
            command -= self._damping * vibration
            if swayed:
                command += damping
            stands = not swayed and -STANDING < v_ref < STANDING and -STANDING < v_lead < STANDING
            # A reference that jumped is for the law, not for inches.
            if stands and not abs(q_ref - self._stood) > self._step:
                if self._stood != self._stood:
                    self._stood = q_ref
                command = self._rest.step(error, predicted, command, elapsed_s)
                if self._rest.resting:
                    self._feedback.reset()
            else:
                self._rest.follow()
                self._stood = q_ref
            command = min(command, max(0.0, (self._upper - q) * END_GAIN_1_S))
            command = max(command, min(0.0, (self._lower - q) * END_GAIN_1_S))
        self.velocity_wanted = command
        return command

    def room(self, cap: float) -> float:
        """The share of the wanted velocity that valve and speed limit allow; ``cap`` scales the limit."""
        wanted = self.velocity_wanted
        limit = min(self._speed * cap, self._valve.full_plus if wanted >= 0.0 else self._valve.full_minus)
        return limit / abs(wanted) if abs(wanted) > limit else 1.0

    def finish(self, share: float, elapsed_s: float) -> float:
        """The velocity to command when the machine can give this share of what is wanted."""
        change = self._max_rate * elapsed_s
        last = self.velocity_command
        command = min(max(share * self.velocity_wanted, last - change), last + change)
        self._frozen = command != self.velocity_wanted
        self._flight.add((command - self._lead) * elapsed_s)
        self.velocity_command = command
        return command
