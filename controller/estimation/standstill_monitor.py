"""Standstill monitor: does a joint stay where it is while its valve is neutral?  (docs/reference/safety.md case 17)

The motion monitor compares speeds and cannot see a joint that drifts slowly.  This monitor compares distances.  A joint
at rest still moves: the oil yields to a swinging grapple, a stop rings, a leaking valve creeps.  All of these turn back
or are very slow; a valve stuck open does neither.  So the monitor keeps the range in which the joint has moved lately
and measures how far, and for how long, the joint goes out of it in one direction without turning back.  The range
grows to every turning point, and shrinks towards the joint in `FORGET_S`.

Far away in a short time counts as much as near in a long one: a joint runs away when it is out by more than a distance
and the product of distance and time is over the limit.  The distance is small while everything is calm, greater
while another function moves or the carrier drives, because they shake the joint, and greatest while the jaws are at
work: they press on ground and logs, and a log that they let go relieves the boom.
"""

from __future__ import annotations

from typing import Final

from controller.estimation.joint_estimator import TrackedJoint

CLOSING_S: Final = 0.5
"""A valve that was open shuts, and its oil comes to rest, within this time (dead time 0.15 s, lags 0.06 s and 0.04 s):
the range grows with the joint meanwhile.  A dead time that is longer by the profile is added."""
USUAL_DELAY_S: Final = 0.15
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
        """``delay_s``: the dead time of the joint's valve by the profile; ``least_speed``: see
        `controller.estimation.usual_speed`.
        """
        usual = max(spec.speed_limit, least_speed)
        encoder = spec.encoder
        self._noise = 0.0 if encoder is None else encoder.noise + encoder.unit_per_count
        self._period_s = period_s
        self._closing_s = CLOSING_S + max(0.0, delay_s - USUAL_DELAY_S)
        self._forget = period_s / FORGET_S
        self._calm_far = CALM_S_AT_LIMIT * usual
        self._shaken_far = SHAKEN_S_AT_LIMIT * usual
        self._pressed_far = PRESSED_S_AT_LIMIT * usual
        self.moves = False
        self.reset()

    def reset(self) -> None:
        """Nothing is known of the joint."""
        self._started = self.moves = False
        self._low = self._high = self._peak = self._gone_to = 0.0
        self._out = self._out_s = self._neutral_s = self._calm_s = self._rest_s = 0.0
        self._far = self._calm_far
        self.quiet_s = 0.0
        """How long the joint has not moved."""

    def step(self, neutral: bool, shaken: bool, position: float, slack: float = 0.0, pressed: bool = False) -> bool:
        """One period: whether the valve is ``neutral``, whether something else shakes the joint, its position, how
        much farther it may yield to a slope (`controller.estimation.slope_yield`), and whether jaws press on it.
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
        """What was measured over what is a motion; 1 and more is one."""
        out = self._out / self._far
        return min(out, out * self._out_s / HOLD_S)

    def _absorb(self, position: float) -> None:
        """The joint is inside its range, has turned back, or its valve is still closing: extend the range to it."""
        self._low, self._high = min(self._low, self._peak, position), max(self._high, self._peak, position)
        self._peak = self._gone_to = position
        self._out_s = self._rest_s = 0.0
