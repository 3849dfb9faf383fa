"""Angle estimate of a rotator without an encoder: the commanded count, corrected by how logs hang below it.

The count drifts because the valve gives more or less than the profile says: by 15 % of every turn in the nominal
machine, and by 8 % too much to one side and 25 % too little to the other in an individual one, which added up to 47
degrees within four logs. A log that hangs in closed jaws lies across their opening, so a view of the log is a view of
the rotator. The planner works with the estimated angle; the controller receives the count that should bring the rotator
there.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from math import atan2, copysign, pi, remainder, sqrt
from typing import Final

import numpy as np
from msgspec.structs import replace

from autonomy.crane_job.grapple import THICK_LOG_M
from autonomy.crane_job.grasp_verification import is_between_jaws
from autonomy.grasp.grapple_heights import travel_height_m
from autonomy.motion.arm_kinematics import Arm, Pose
from autonomy.motion.setpoint_stream import Axes, Motion
from autonomy.perception.camera.frame import optical_pose
from autonomy.perception.log_list import LogObservation
from machine.geometry.grapple import grapple_yaw, lowest_tip_below_pin_m, rotator_for_yaw
from machine.geometry.kinematics import Unreachable
from machine.joints import N_JOINTS, Joint
from machine.profile import Camera, Profile, joint

START_SIGMA_RAD: Final = 0.1
"""1-sigma of the angle before the first turn: the grapple was set straight by eye."""
PACE_SIGMA: Final = 0.15
"""1-sigma of the angle per unit of count before any view, each side."""
TURN_SIGMA_RAD: Final = 0.04
"""1-sigma of what a turn of 1 rad adds that the next one does not: dead-band, load and oil differ."""
VIEW_SIGMA_RAD: Final = 0.08
"""1-sigma of a viewed angle: a log may hang a little askew, and its axis is measured to 4 degrees."""
PLAY_RAD_M: Final = 6.0
"""For each metre by which a log is measured thinner than `THICK_LOG_M` it is taken to lie askew in closed jaws by up to
so much: they do not clasp it, and when the rotator stops it swings on.  No bound: in the plant, at rest before a
camera, logs measured 14 to 15 cm thick lay up to 0.43 rad askew, and on the way up to 0.57."""
SCALE_BOUNDS: Final = (0.6, 1.5)
ROUNDING_RAD: Final = 1e-9

Covariance = tuple[float, float, float, float, float, float]
"""Upper triangle, by rows, of angle and both paces."""


@dataclass(frozen=True, slots=True)
class RotatorEstimate:
    """At the count ``sent_rad`` the rotator stood at ``angle_rad``; from there ``paces`` are the angles per unit of
    count, to the negative and to the positive side.  A Kalman filter of these three with their ``covariance``.
    """

    sent_rad: float = 0.0
    angle_rad: float = 0.0
    paces: tuple[float, float] = (1.0, 1.0)
    covariance: Covariance = (START_SIGMA_RAD**2, 0.0, 0.0, PACE_SIGMA**2, 0.0, PACE_SIGMA**2)

    @property
    def sigma_rad(self) -> float:
        """1-sigma of the angle at the count ``sent_rad``."""
        return sqrt(max(0.0, self.covariance[0]))

    @property
    def is_possible(self) -> bool:
        """Whether the paces are within their bounds and the covariance is one; a file may hold any numbers."""
        (least, most), (aa, an, ap, nn, _, pp) = SCALE_BOUNDS, self.covariance
        correlates = an * an <= aa * nn and ap * ap <= aa * pp
        return min(aa, nn, pp) >= 0.0 and correlates and all(least <= pace <= most for pace in self.paces)

    def angle(self, sent_rad: float) -> float:
        """Return the angle at a count, rad."""
        turn = sent_rad - self.sent_rad
        return self.angle_rad + self.paces[turn > 0.0] * turn

    def sent(self, angle_rad: float) -> float:
        """Return the count that leads to an angle, rad."""
        turn = angle_rad - self.angle_rad
        return self.sent_rad + turn / self.paces[turn > 0.0]

    def turned(self, sent_rad: float) -> RotatorEstimate:
        """Return the estimate after a turn to one side, to a count.  A turn there and back is two of them: where the
        paces of both sides differ, it does not end where it began.
        """
        turn = sent_rad - self.sent_rad
        if turn == 0.0:
            return self
        aa, an, ap, nn, np, pp = self.covariance
        if turn > 0.0:
            aa, an, ap = aa + turn * (2.0 * ap + turn * pp), an + turn * np, ap + turn * pp
        else:
            aa, an, ap = aa + turn * (2.0 * an + turn * nn), an + turn * nn, ap + turn * np
        aa += TURN_SIGMA_RAD**2 * abs(turn)
        return RotatorEstimate(sent_rad, self.angle(sent_rad), self.paces, (aa, an, ap, nn, np, pp))

    def corrected(self, sent_rad: float, angle_rad: float, play_rad: float = 0.0) -> RotatorEstimate:
        """Return the estimate after the rotator was viewed at an angle, modulo pi, at this count.

        ``play_rad``: by which what was viewed may lie askew in the jaws; within that it says nothing of the rotator.
        """
        now = self.turned(sent_rad)
        aa, an, ap, nn, np, pp = now.covariance
        off, spread = remainder(angle_rad - now.angle_rad, pi), aa + VIEW_SIGMA_RAD**2 + play_rad**2
        off = copysign(max(abs(off) - play_rad, 0.0), off)
        # A grapple turned by pi looks the same: keep the estimate near the count and within its range.
        near = sent_rad + remainder(now.angle_rad + aa / spread * off - sent_rad, pi)
        least, most = SCALE_BOUNDS
        minus, plus = (
            min(max(pace + gain / spread * off, least), most) for pace, gain in zip(now.paces, (an, ap), strict=True)
        )
        left = (
            aa - aa * aa / spread,
            an - aa * an / spread,
            ap - aa * ap / spread,
            nn - an * an / spread,
            np - an * ap / spread,
            pp - ap * ap / spread,
        )
        return RotatorEstimate(sent_rad, near, (minus, plus), left)

    def to_counts(self, q: Axes) -> Axes:
        """Return the joints with the count in place of the rotator's angle."""
        return (*q[: Joint.ROT], self.sent(q[Joint.ROT]))

    def to_angles(self, q: Axes) -> Axes:
        """Return the joints with the rotator's angle in place of the count."""
        return (*q[: Joint.ROT], self.angle(q[Joint.ROT]))

    def motion(self, motion: Motion) -> Motion:
        """Convert a motion of the angle to a motion of the count."""
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
        # Where the rotator stands now, rounding must not choose the pace: knots of two paces make a kink too fast.
        ahead_rad = angle - rotator.angle_rad
        side = ahead_rad if abs(ahead_rad) > ROUNDING_RAD else speed
        return (*q, rotator.sent(angle)), (*v, speed / rotator.paces[side > 0.0])


def has_no_encoder(profile: Profile) -> bool:
    """Tell whether the machine's rotator has no encoder."""
    return joint(profile, Joint.ROT).encoder is None


def planning_profile(profile: Profile, rotator: RotatorEstimate) -> Profile:
    """Return the machine as motions are planned for it.

    A rotator without an encoder keeps its limits in counts and uses half of its range: the count may be off by a
    quarter turn and goes farther than the angle.
    """
    if not has_no_encoder(profile):
        return profile
    spec, slower = joint(profile, Joint.ROT), min(*rotator.paces, 1.0)
    limited = replace(
        spec,
        lower=spec.lower / 2,
        upper=spec.upper / 2,
        speed_limit=slower * spec.speed_limit,
        acceleration_limit=slower * spec.acceleration_limit,
    )
    return replace(profile, joints={**profile.joints, "rot": limited})


def rotator_angle_of_hanging_log(profile: Profile, log: LogObservation, slew_rad: float) -> float:
    """Compute the rotator angle at which a log hangs in closed jaws as it is observed, rad, modulo pi."""
    straight = grapple_yaw(profile, (slew_rad, 0.0, 0.0, 0.0, 0.0))
    return atan2(log.axis[1], log.axis[0]) + pi / 2 - straight


def play_rad(thinnest_m: float) -> float:
    """Return by how much a log of this diameter may lie askew in closed jaws to either side."""
    return PLAY_RAD_M * max(THICK_LOG_M - thinnest_m, 0.0)


# -- Shows a load to the camera ahead of the machine, so that a rotator without an encoder is measured.
#
# The crane works from memory of what that camera has seen, and a remembered load hangs as the count says.  So the
# planner carries a load past the camera while it is unsure of the rotator, stands still there, and takes the log's
# direction from the picture.

UNSURE_RAD: Final = 0.15
"""A load is shown where the rotator's angle has a greater 1-sigma: three of them put an end of a log of 2 m, laid at
the side of the bunk, onto its stakes."""
UNSURE_AHEAD_RAD: Final = 0.08
"""... or this, where the log was gripped ahead of the machine: the camera is on the way, or nearly."""
AHEAD_RAD: Final = 1.9
"""Slew to either side beyond which a log lies ahead of the machine."""
AHEAD_M: Final = 3.0
"""Distance of a shown load in front of the camera: half of the picture is 3.6 m wide there."""
BELOW_CAMERA_M: Final = 0.45
"""A shown load hangs so far below the camera, clear of the ground and of the upper edge of the picture."""
ASIDE_M: Final = (0.0, 0.5, 1.0, 1.5, 2.0)
"""Places beside the middle of the picture, for a slew that does not turn all round."""
VIEW_MARGIN_M: Final = 0.5
"""A load is measured this near to the jaws: the machine leans, and the load swings."""
VEHICLE_LINKS: Final = ("front", "rear")


@dataclass(frozen=True, slots=True)
class LoadView:
    """The camera of a machine that stands with this articulation [rad]."""

    profile: Profile
    camera: Camera
    articulation_rad: float

    def is_needed(self, rotator: RotatorEstimate, slew_rad: float) -> bool:
        """Tell whether a load gripped at this slew should be shown for the rotator's sake."""
        unsure_rad = UNSURE_AHEAD_RAD if abs(slew_rad) > AHEAD_RAD else UNSURE_RAD
        return has_no_encoder(self.profile) and rotator.sigma_rad > unsure_rad

    def pose(self, arm: Arm, start: Pose, diameter_m: float) -> Pose:
        """Find the pose of the pin in which a load hangs in front of the camera, across its view and nearest to
        ``start``.

        Raises:
            Unreachable: the crane does not reach there.
        """
        mount = optical_pose(self.profile, self.camera, (0.0,) * N_JOINTS, self.articulation_rad)
        ahead = mount.rotation[:2, 2] / np.linalg.norm(mount.rotation[:2, 2])
        aside = np.array((-ahead[1], ahead[0]))
        height_m = float(mount.position_m[2]) - BELOW_CAMERA_M
        height_m += lowest_tip_below_pin_m(self.profile.grapple.jaws) - 0.5 * diameter_m
        reachable_poses = []
        for offset_m in sorted({side * m for m in ASIDE_M for side in (-1.0, 1.0)}):
            x, y = (mount.position_m[:2] + AHEAD_M * ahead + offset_m * aside).tolist()
            try:
                pose = arm.pose_above(x, y, height_m, max(height_m, travel_height_m(self.profile)))
            except Unreachable:
                continue
            reachable_poses.append((abs(offset_m) + abs(pose.slew_rad - start.slew_rad), pose))
        if not reachable_poses:
            raise Unreachable("the crane does not reach in front of the camera", "reach.camera")
        pose = min(reachable_poses, key=lambda found: found[0])[1]
        yaw = atan2(ahead[1], ahead[0])  # the jaws open along the view, so that the log lies across it
        return pose._replace(rot_rad=rotator_for_yaw(self.profile, pose.slew_rad, yaw, start.rot_rad))


def load_in_view(arm: Arm, logs: Iterable[LogObservation], pin: Pose) -> LogObservation | None:
    """Find what hangs in the jaws at a pin, of the logs of one picture; None where the picture shows no such log."""
    hanging = (log for log in logs if is_between_jaws(arm, log, pin, VIEW_MARGIN_M))
    return max(hanging, key=lambda o: o.length_m, default=None)


def load_view(profile: Profile, articulation_rad: float) -> LoadView | None:
    """Return the view of the machine's camera ahead; None where it has none."""
    camera = next((c for c in profile.cameras.values() if c.link in VEHICLE_LINKS), None)
    return None if camera is None else LoadView(profile, camera, articulation_rad)
