"""Datagrams in, accepted setpoints and operator actions out: the gate before the supervisor.

Every datagram is a request.  It is refused whole with a `Reason`, or taken; nothing is repaired.  Checked
here: form (CRC, length, version, finite numbers, by the codec), profile, age, order, lease, joint range,
speed, the distance to the present reference.  An operator's STOP is obeyed whatever profile, age or order it
carries.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, Protocol

from can_dbc.setpoint import (
    CraneSetpoint,
    DatagramRefused,
    OperatorAction,
    OperatorCommand,
    SpoolTest,
    decode,
)
from can_dbc.vehicle_datagrams import DriveSetpoint
from controller.trajectory import Trajectory, extremes, peak_speed
from machine.joints import JOINTS, N_JOINTS
from machine.profile import Profile, joint
from machine.reasons import Reason

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


class Leased(Protocol):
    """What every setpoint says of itself."""

    @property
    def sequence(self) -> int: ...
    @property
    def profile_hash(self) -> int: ...
    @property
    def stamp_ns(self) -> int: ...
    @property
    def lease_ns(self) -> int: ...


class Order:
    """Order and leases of one kind of setpoints, and the memory of those that were refused; fixed size."""

    __slots__ = ("_hash", "_lease_max_ns", "_refused_ns", "_sequence", "_stamp_ns", "detail", "refusal", "refused")

    def __init__(self, profile: Profile, profile_hash: int) -> None:
        self._lease_max_ns = profile.timeouts.lease_max_ms * 1_000_000
        self._hash = profile_hash
        self._sequence = self._stamp_ns = -1
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

    def check(self, setpoint: Leased, now_ns: int, late_ns: int) -> None:
        """Refuses a setpoint for its profile, order, age or lease; raises Refused.

        ``late_ns`` is how late the tick runs: the sender's clock may be that far ahead of the nominal time.
        """
        if setpoint.profile_hash != self._hash:
            raise Refused(Reason.WRONG_PROFILE)
        if setpoint.sequence <= self._sequence or setpoint.stamp_ns <= self._stamp_ns:
            raise Refused(Reason.OUT_OF_ORDER)
        if setpoint.stamp_ns > now_ns + late_ns:
            raise Refused(Reason.STAMP_FUTURE)
        if setpoint.lease_ns > self._lease_max_ns:
            raise Refused(Reason.LEASE_TOO_LONG)
        if setpoint.stamp_ns + setpoint.lease_ns <= now_ns:
            raise Refused(Reason.STAMP_OLD)

    def note_order(self, setpoint: Leased) -> None:
        """An accepted setpoint: only later ones are taken from here on."""
        self._sequence, self._stamp_ns = setpoint.sequence, setpoint.stamp_ns


class Gate(Order):
    """The gate of all datagrams, and what it keeps of the crane's setpoints and the operator's."""

    __slots__ = (
        "_acceleration", "_drives", "_key", "_lower", "_new_position", "_new_velocity", "_operator_sequence",
        "_operator_stamp_ns", "_speed", "_upper",
    )  # fmt: skip

    def __init__(self, profile: Profile, profile_hash: int, key: bytes | None) -> None:
        super().__init__(profile, profile_hash)
        specs = [joint(profile, j) for j in JOINTS]
        self._lower = tuple(s.lower for s in specs)
        self._upper = tuple(s.upper for s in specs)
        self._speed = tuple(s.speed_limit for s in specs)
        self._acceleration = tuple(s.acceleration_limit for s in specs)
        self._drives = profile.carrier is not None
        self._key = key
        self._new_position, self._new_velocity = [0.0] * N_JOINTS, [0.0] * N_JOINTS
        self._operator_stamp_ns = self._operator_sequence = -1

    def take(
        self, data: bytes, now_ns: int, late_ns: int
    ) -> CraneSetpoint | SpoolTest | DriveSetpoint | OperatorAction:
        """The setpoint or operator action in a datagram, checked for form, profile, age and order; raises
        Refused.  The order of drive setpoints is checked where they are obeyed.
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
            if not self._drives:
                raise Refused(Reason.CANNOT_DRIVE)
            return message
        if not isinstance(message, CraneSetpoint | SpoolTest):
            raise Refused(Reason.DATAGRAM_KIND)
        self.check(message, now_ns, late_ns)
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
        new_position, new_velocity = self._new_position, self._new_velocity
        candidate.fill(JOINTS, now_ns, new_position, new_velocity)
        for j in JOINTS:
            self._check_path(setpoint, j)
            far = abs(new_position[j] - position[j]) > JUMP_S * self._speed[j]
            kick = abs(new_velocity[j] - velocity[j]) > KICK_S * self._acceleration[j] + 0.1 * self._speed[j]
            if far or kick:
                raise Refused(Reason.REFERENCE_JUMP, j)
        self.note_order(setpoint)

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
        a = first
        for b in knots[1:]:
            p0, v0, p1, v1 = a.position[j], a.velocity[j], b.position[j], b.velocity[j]
            h = (b.after_ns - a.after_ns) * 1e-9
            a = b
            # A cubic and its velocity lie within the hulls of their Bezier points; only one that these do not clear is
            # looked at closely.  Written so that a NaN from an overflow is refused too.
            if (
                lower <= p1 <= upper
                and lower <= p0 + v0 * h / 3.0 <= upper
                and lower <= p1 - v1 * h / 3.0 <= upper
                and -fastest <= v1 <= fastest
                and -fastest <= 3.0 * (p1 - p0) / h - v0 - v1 <= fastest
            ):
                continue
            piece = (p0, v0, p1, v1, h)
            if not peak_speed(*piece) <= fastest:
                raise Refused(Reason.JOINT_SPEED, j)
            low, high = extremes(*piece)
            if not (lower <= low and high <= upper):
                raise Refused(Reason.JOINT_RANGE, j)
