"""Datagrams in, accepted setpoints and operator actions out: the gate before the supervisor.

Every datagram is a request.  It is refused whole with a `Reason`, or taken; nothing is repaired.  Checked
here: form (CRC, length, version, finite numbers, by the codec), profile, age, order, lease, joint range,
speed, the distance to the present reference.  An operator's STOP is obeyed whatever profile, age or order it
carries.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from can_dbc.setpoint import (
    CraneSetpoint,
    DatagramRefused,
    DriveSetpoint,
    OperatorAction,
    OperatorCommand,
    decode,
)
from controller.trajectory import Trajectory, extremes, peak_speed
from machine.faults import Reason
from machine.joints import JOINTS, N_JOINTS
from machine.profile import Profile, joint

SPEED_TOLERANCE: Final = 1.05
"""A smooth profile cut into cubics overshoots its peak speed a little between the knots."""
JUMP_S: Final = 0.1
"""A new reference may differ by what the joint covers in this time at its speed limit."""
KICK_S: Final = 0.25
"""and in velocity by what the acceleration limit gives in this time (plus 10 % of the speed limit)."""
OPERATOR_AGE_NS: Final = 1_000_000_000
REFUSED_WINDOW_NS: Final = 1_000_000_000
REFUSED_LIMIT: Final = 3


class Refused(Exception):
    """A datagram or request that is refused whole."""

    def __init__(self, reason: Reason, detail: int = 0) -> None:
        super().__init__(reason)
        self.reason = reason
        self.detail = detail


class Gate:
    """Order and refusal memory of the datagrams; fixed size."""

    __slots__ = (
        "_acceleration", "_hash", "_key", "_lease_max_ns", "_lower", "_operator_sequence",
        "_operator_stamp_ns", "_refused_ns", "_sequence", "_speed", "_stamp_ns", "_upper", "detail",
        "refusal", "refused",
    )  # fmt: skip

    def __init__(self, profile: Profile, profile_hash: int, key: bytes | None) -> None:
        specs = [joint(profile, j) for j in JOINTS]
        self._lower = tuple(s.lower for s in specs)
        self._upper = tuple(s.upper for s in specs)
        self._speed = tuple(s.speed_limit for s in specs)
        self._acceleration = tuple(s.acceleration_limit for s in specs)
        self._lease_max_ns = profile.timeouts.lease_max_ms * 1_000_000
        self._hash = profile_hash
        self._key = key
        self._stamp_ns = self._operator_stamp_ns = -1
        self._sequence = self._operator_sequence = -1
        self._refused_ns = [-REFUSED_WINDOW_NS] * REFUSED_LIMIT
        self.refused = 0
        self.refusal = Reason.NONE
        self.detail = 0

    @property
    def sequence(self) -> int:
        """Sequence number of the last accepted setpoint, 0 before the first."""
        return max(self._sequence, 0)

    def new_session(self) -> None:
        """An operator armed: a planner may count from the beginning again.  Stamps must still grow."""
        self._sequence = -1

    def refuse(self, reason: Reason, detail: int, now_ns: int) -> None:
        """Counts and remembers a refusal."""
        self.refusal, self.detail = reason, detail
        self._refused_ns[self.refused % REFUSED_LIMIT] = now_ns
        self.refused += 1

    def forgive(self) -> None:
        """A movement begins: refusals from before it do not count against it."""
        for i in range(REFUSED_LIMIT):
            self._refused_ns[i] = -REFUSED_WINDOW_NS

    def too_many(self, now_ns: int) -> bool:
        """Whether the last three refusals lie within one second."""
        return now_ns - min(self._refused_ns) < REFUSED_WINDOW_NS

    def take(self, data: bytes, now_ns: int, late_ns: int) -> CraneSetpoint | OperatorAction:
        """The setpoint or operator action in a datagram, checked for form, profile, age and order; raises
        Refused.

        ``late_ns`` is how late the tick runs: the sender's clock may be that far ahead of the nominal time.
        """
        try:
            message = decode(data, self._key)
        except DatagramRefused as error:
            raise Refused(Reason(100 + error.fault)) from None
        if isinstance(message, OperatorCommand):
            if message.action is not OperatorAction.STOP:
                self._check_operator(message, now_ns + late_ns)
            return message.action
        if isinstance(message, DriveSetpoint):
            raise Refused(Reason.CANNOT_DRIVE)
        if not isinstance(message, CraneSetpoint):
            raise Refused(Reason.DATAGRAM_KIND)
        if message.profile_hash != self._hash:
            raise Refused(Reason.WRONG_PROFILE)
        if message.sequence <= self._sequence or message.stamp_ns <= self._stamp_ns:
            raise Refused(Reason.OUT_OF_ORDER)
        if message.stamp_ns > now_ns + late_ns:
            raise Refused(Reason.STAMP_FUTURE)
        if message.lease_ns > self._lease_max_ns:
            raise Refused(Reason.LEASE_TOO_LONG)
        if message.stamp_ns + message.lease_ns <= now_ns:
            raise Refused(Reason.STAMP_OLD)
        return message

    def _check_operator(self, message: OperatorCommand, latest_ns: int) -> None:
        if message.profile_hash != self._hash:
            raise Refused(Reason.WRONG_PROFILE)
        order = (message.stamp_ns, message.sequence)
        if order <= (self._operator_stamp_ns, self._operator_sequence):
            raise Refused(Reason.OUT_OF_ORDER)
        if message.stamp_ns > latest_ns:
            raise Refused(Reason.STAMP_FUTURE)
        if latest_ns - message.stamp_ns > OPERATOR_AGE_NS:
            raise Refused(Reason.STAMP_OLD)
        self._operator_stamp_ns, self._operator_sequence = order

    def check_motion(
        self,
        setpoint: CraneSetpoint,
        candidate: Trajectory,
        position: Sequence[float],
        velocity: Sequence[float],
        now_ns: int,
    ) -> None:
        """Loads ``candidate``; refuses a trajectory that leaves the range, is too fast or jumps; notes its
        order.

        ``position`` and ``velocity`` are the present reference; NaN where it is unknown, which is not
        compared.
        """
        candidate.load(setpoint)
        for j in range(N_JOINTS):
            self._check_path(setpoint, j)
            new_position, new_velocity = candidate.sample(j, now_ns)
            far = abs(new_position - position[j]) > JUMP_S * self._speed[j]
            kick = abs(new_velocity - velocity[j]) > KICK_S * self._acceleration[j] + 0.1 * self._speed[j]
            if far or kick:
                raise Refused(Reason.REFERENCE_JUMP, j)
        self._sequence, self._stamp_ns = setpoint.sequence, setpoint.stamp_ns

    def _check_path(self, setpoint: CraneSetpoint, j: int) -> None:
        knots, lower, upper = setpoint.knots, self._lower[j], self._upper[j]
        fastest = SPEED_TOLERANCE * self._speed[j]
        first, last = knots[0], knots[-1]
        if not lower <= first.position[j] <= upper:
            raise Refused(Reason.JOINT_RANGE, j)
        if abs(first.velocity[j]) > fastest:
            raise Refused(Reason.JOINT_SPEED, j)
        if setpoint.final and last.velocity[j] != 0.0:
            raise Refused(Reason.FINAL_MOVING, j)
        for i in range(1, len(knots)):
            a, b = knots[i - 1], knots[i]
            piece = (a.position[j], a.velocity[j], b.position[j], b.velocity[j], (b.after_ns - a.after_ns) * 1e-9)
            # Written so that a NaN from an overflow is refused too.
            if not peak_speed(*piece) <= fastest:
                raise Refused(Reason.JOINT_SPEED, j)
            low, high = extremes(*piece)
            if not (lower <= low and high <= upper):
                raise Refused(Reason.JOINT_RANGE, j)
