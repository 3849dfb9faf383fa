"""The gate of all requests: datagrams in, checked setpoints and operator actions out.

Every datagram is a request, refused whole with a `Reason` (`RequestRefused`) or passed on; nothing is corrected.
Checked here: form (CRC, length, version, finite numbers, by the codec), profile, age, order and lease.  The motion of a
crane setpoint is checked by `controller.crane.trajectory_check`, that of a drive setpoint by
`controller.carrier.vehicle`.  An operator's STOP is accepted whatever profile, age or order it carries, and from
anyone; any other action only from an operator.  Authenticators are checked, and taken away, where datagrams are
received (`controller.process.operator_socket`); a datagram without the right one arrives as an empty one.  The
heartbeats of those who watch are ordered by `controller.operator_link`, so that none of them can outrun an ARM.
Refusals are remembered in a fixed size.
"""

from __future__ import annotations

from typing import Final

from can_dbc.messages.crane import WATCH_ACTIONS, CraneSetpoint, OperatorAction, OperatorCommand, SpoolTest
from can_dbc.messages.datagrams import decode
from can_dbc.messages.envelope import DatagramRefused
from can_dbc.messages.vehicle import DriveSetpoint
from machine.profile import Profile
from machine.status.reasons import Reason

LeasedSetpoint = CraneSetpoint | SpoolTest | DriveSetpoint
OPERATOR_AGE_NS: Final = 1_000_000_000
REFUSED_WINDOW_NS: Final = 1_000_000_000
REFUSED_LIMIT_COUNT: Final = 3


class RequestRefused(Exception):
    """A datagram or request that is refused whole; ``reason`` is its code."""

    def __init__(self, reason: Reason, detail: int = 0) -> None:
        super().__init__(reason)
        self.reason = reason
        self.detail = detail


class SetpointGate:
    """Order and leases of one kind of setpoint; ``refused`` counts refusals, ``refusal`` and ``detail`` are the
    last.
    """

    __slots__ = (
        "_counted",
        "_lease_max_ns",
        "_profile_hash",
        "_refused_ns",
        "_sequence",
        "_stamp_ns",
        "detail",
        "refusal",
        "refused",
    )

    def __init__(self, profile: Profile, profile_hash: int) -> None:
        self._lease_max_ns = profile.timeouts.lease_max_ms * 1_000_000
        self._profile_hash = profile_hash
        self._sequence = self._stamp_ns = -1
        self._refused_ns = [-REFUSED_WINDOW_NS] * REFUSED_LIMIT_COUNT
        self._counted = 0
        self.refused = 0
        self.refusal = Reason.NONE
        self.detail = 0

    @property
    def sequence(self) -> int:
        """Sequence number of the last accepted setpoint, 0 before the first."""
        return max(self._sequence, 0)

    @property
    def stamp_ns(self) -> int:
        """Stamp of the last accepted setpoint, 0 before the first."""
        return max(self._stamp_ns, 0)

    def start_session(self) -> None:
        """Let a planner count from the beginning again, as an operator armed.  Stamps must still grow."""
        self._sequence = -1

    def count_refusal(self, reason: Reason, detail: int, now_ns: int) -> None:
        """Count and remember a refusal."""
        self.refusal, self.detail = reason, detail
        self._refused_ns[self._counted % REFUSED_LIMIT_COUNT] = now_ns
        self._counted += 1
        self.refused += 1

    def note_stranger(self) -> None:
        """Count and remember a datagram without the right key: whoever sent it, it says nothing of the planner."""
        self.refusal, self.detail = Reason.DATAGRAM_AUTHENTICATION, 0
        self.refused += 1

    def clear_refusals(self) -> None:
        """Clear the refusals from before a motion that begins: they do not count against it."""
        for i in range(REFUSED_LIMIT_COUNT):
            self._refused_ns[i] = -REFUSED_WINDOW_NS

    def refused_too_often(self, now_ns: int) -> bool:
        """Tell whether the last three refusals lie within one second."""
        oldest_ns = self._refused_ns[self._counted % REFUSED_LIMIT_COUNT]
        return now_ns - oldest_ns < REFUSED_WINDOW_NS

    def check(self, setpoint: LeasedSetpoint, now_ns: int, late_ns: int) -> None:
        """Check profile, order, age and lease of a setpoint.

        ``late_ns`` is how late the tick runs: the sender's clock may be that far ahead of the nominal time.

        Raises:
            RequestRefused: one of them does not fit.
        """
        if setpoint.profile_hash != self._profile_hash:
            raise RequestRefused(Reason.WRONG_PROFILE)
        if setpoint.sequence <= self._sequence or setpoint.stamp_ns <= self._stamp_ns:
            raise RequestRefused(Reason.OUT_OF_ORDER)
        if setpoint.stamp_ns > now_ns + late_ns:
            raise RequestRefused(Reason.STAMP_FUTURE)
        if setpoint.lease_ns > self._lease_max_ns:
            raise RequestRefused(Reason.LEASE_TOO_LONG)
        if setpoint.stamp_ns + setpoint.lease_ns <= now_ns:
            raise RequestRefused(Reason.STAMP_OLD)

    def mark_accepted(self, setpoint: LeasedSetpoint) -> None:
        """Remember an accepted setpoint: from now on only later ones are accepted."""
        self._sequence, self._stamp_ns = setpoint.sequence, setpoint.stamp_ns


class RequestGate(SetpointGate):
    """The gate of all datagrams; as a `SetpointGate` it keeps the order of crane setpoints and spool tests."""

    __slots__ = ("_drives", "_operator_sequence", "_operator_stamp_ns", "_profile_check", "watch_stamp_ns")

    def __init__(self, profile: Profile, profile_hash: int, profile_check: int = 0) -> None:
        """``profile_check``: of the profile's file, which an ARM that names one must be meant for; 0: not compared."""
        super().__init__(profile, profile_hash)
        self._drives = profile.carrier is not None
        self._profile_check = profile_check
        self._operator_stamp_ns = self._operator_sequence = -1
        self.watch_stamp_ns = 0
        """Stamp of the last WATCH or WATCH_END."""

    def accept(
        self, data: bytes, now_ns: int, late_ns: int, operator: bool = False
    ) -> CraneSetpoint | SpoolTest | DriveSetpoint | OperatorAction:
        """Return the setpoint or operator action in a datagram, checked for form, profile, age and order.

        ``operator``: it came from a person who may arm, and is no setpoint.  Order and lease of a drive setpoint are
        checked by the vehicle.

        Raises:
            RequestRefused: the datagram does not pass.
        """
        if not data:
            raise RequestRefused(Reason.DATAGRAM_AUTHENTICATION)
        try:
            message = decode(data)
        except DatagramRefused as error:
            raise RequestRefused(Reason(100 + error.fault)) from None
        if isinstance(message, OperatorCommand):
            if message.action is not OperatorAction.STOP:
                if not operator:
                    raise RequestRefused(Reason.NO_AUTHORITY)
                self._check_operator(message, now_ns + late_ns)
            return message.action
        if operator:
            raise RequestRefused(Reason.DATAGRAM_KIND)
        if isinstance(message, DriveSetpoint):
            if not self._drives:
                raise RequestRefused(Reason.CANNOT_DRIVE)
            return message
        if not isinstance(message, CraneSetpoint | SpoolTest):
            raise RequestRefused(Reason.DATAGRAM_KIND)
        self.check(message, now_ns, late_ns)
        return message

    def _check_operator(self, message: OperatorCommand, latest_ns: int) -> None:
        if message.profile_hash != self._profile_hash:
            raise RequestRefused(Reason.WRONG_PROFILE)
        compared = self._profile_check and message.action is OperatorAction.ARM
        if compared and message.profile_check not in (0, self._profile_check):
            raise RequestRefused(Reason.WRONG_PROFILE)
        order, watches = (message.stamp_ns, message.sequence), message.action in WATCH_ACTIONS
        if not watches and order <= (self._operator_stamp_ns, self._operator_sequence):
            raise RequestRefused(Reason.OUT_OF_ORDER)
        if message.stamp_ns > latest_ns:
            raise RequestRefused(Reason.STAMP_FUTURE)
        if latest_ns - message.stamp_ns > OPERATOR_AGE_NS:
            raise RequestRefused(Reason.STAMP_OLD)
        if watches:
            self.watch_stamp_ns = message.stamp_ns
        else:
            self._operator_stamp_ns, self._operator_sequence = order
