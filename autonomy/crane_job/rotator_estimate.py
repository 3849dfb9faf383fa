"""Where a rotator without an encoder stands: the count of what it was told, set right by how logs hang under it.

The count drifts, for the valve gives more or less than the profile says: by 15 % of every turn in the nominal machine.
A log that hangs in closed tongs lies across their opening, so that whoever sees it sees the rotator, too.  The planner
thinks in the angle that is believed to be true; the controller is sent the count that is to bring it there.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import atan2, pi, remainder
from typing import Final

from msgspec.structs import replace

from autonomy.motion.setpoint_stream import Axes, Motion
from autonomy.perception.log_list.observation import LogObservation
from machine.geometry.grapple import grapple_yaw
from machine.joints import Joint
from machine.profile import Profile, joint

ANGLE_GAIN: Final = 0.8
"""Share of what is seen that is believed: a log may hang a little askew."""
SCALE_GAIN: Final = 0.5
MIN_SCALE_TURN_RAD: Final = 0.5
"""A turn that is long enough to tell how much of it was made."""
SCALE_BOUNDS: Final = (0.6, 1.5)


@dataclass(frozen=True, slots=True)
class RotatorEstimate:
    """At the count ``sent_rad`` it stood at ``angle_rad``; from there a turn by 1 on the count is one by ``paces``, to
    the negative and to the positive side.
    """

    sent_rad: float = 0.0
    angle_rad: float = 0.0
    paces: tuple[float, float] = (1.0, 1.0)

    def angle(self, sent_rad: float) -> float:
        """Where it stands at a count, rad."""
        turn = sent_rad - self.sent_rad
        return self.angle_rad + self.paces[turn > 0.0] * turn

    def sent(self, angle_rad: float) -> float:
        """The count that brings it to an angle, rad."""
        turn = angle_rad - self.angle_rad
        return self.sent_rad + turn / self.paces[turn > 0.0]

    def seen(self, sent_rad: float, angle_rad: float) -> RotatorEstimate:
        """At this count it is seen to stand at an angle, modulo pi."""
        turn, off = sent_rad - self.sent_rad, remainder(angle_rad - self.angle(sent_rad), pi)
        paces = list(self.paces)
        if abs(turn) > MIN_SCALE_TURN_RAD:
            paces[turn > 0.0] += SCALE_GAIN * off / turn
        least, most = SCALE_BOUNDS
        angle = self.angle(sent_rad) + ANGLE_GAIN * off
        # A grapple turned by half a turn is the same: the count stays near the angle and within its range.
        near = sent_rad + remainder(angle - sent_rad, pi)
        minus, plus = (min(max(pace, least), most) for pace in paces)
        return RotatorEstimate(sent_rad, near, (minus, plus))

    def counted(self, q: Axes) -> Axes:
        """Joints with the count in place of the rotator's angle."""
        return (*q[: Joint.ROT], self.sent(q[Joint.ROT]))

    def believed(self, q: Axes) -> Axes:
        """Joints with the rotator's angle in place of the count."""
        return (*q[: Joint.ROT], self.angle(q[Joint.ROT]))

    def motion(self, motion: Motion) -> Motion:
        """A motion of the angle as one of the count."""
        return _CountMotion(motion, self)


class _CountMotion:
    def __init__(self, motion: Motion, rotator: RotatorEstimate) -> None:
        self._motion, self._rotator = motion, rotator

    @property
    def duration_s(self) -> float:
        return self._motion.duration_s

    def at(self, time_s: float) -> tuple[Axes, Axes]:
        (*q, angle), (*v, speed) = self._motion.at(time_s)
        rotator = self._rotator
        return (*q, rotator.sent(angle)), (*v, speed / rotator.paces[angle > rotator.angle_rad])


def has_no_encoder(profile: Profile) -> bool:
    """Whether the machine's rotator has no encoder."""
    return joint(profile, Joint.ROT).encoder is None


def planning_profile(profile: Profile, rotator: RotatorEstimate) -> Profile:
    """The machine as motions are planned for it: a counted rotator is sent no faster than it may be, and uses half of
    its range, for the count may be off by as much as a quarter turn and goes farther than the angle.
    """
    if not has_no_encoder(profile):
        return profile
    spec, slower = joint(profile, Joint.ROT), min(*rotator.paces, 1.0)
    limited = replace(
        spec, lower=spec.lower / 2, upper=spec.upper / 2,
        speed_limit=slower * spec.speed_limit, acceleration_limit=slower * spec.acceleration_limit,
    )  # fmt: skip
    return replace(profile, joints={**profile.joints, "rot": limited})


def rotator_angle_of_hanging_log(profile: Profile, log: LogObservation, slew_rad: float) -> float:
    """The rotator's angle that a log tells which is seen to hang in closed tongs, rad, modulo pi."""
    straight = grapple_yaw(profile, (slew_rad, 0.0, 0.0, 0.0, 0.0))
    return atan2(log.axis[1], log.axis[0]) + pi / 2 - straight
