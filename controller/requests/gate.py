"""The gate of all requests: datagrams in, checked setpoints and operator actions out.

Every datagram is a request, refused whole with a `Reason` or passed on; nothing is corrected.  Checked here: form (CRC,
length, version, finite numbers, by the codec), profile, age, order and lease.  The motion of a crane setpoint is
checked by `controller.crane.trajectory_check`, that of a drive setpoint by `controller.carrier.vehicle`.  An operator's
STOP is accepted whatever profile, age or order it carries, and from anyone; any other action only from an operator.
Authenticators are checked, and taken away, where datagrams are received
(`controller.requests.operator_socket`); a datagram without the right one arrives as an empty one.
The heartbeats of those who watch are ordered by `controller.operator_link`, so that none of them can outrun an ARM.
"""

from __future__ import annotations

from typing import Final

from can_dbc.messages.crane import WATCH_ACTIONS, CraneSetpoint, OperatorAction, OperatorCommand, SpoolTest
from can_dbc.messages.datagrams import decode
from can_dbc.messages.envelope import DatagramRefused
from can_dbc.messages.vehicle import DriveSetpoint
from controller.requests.setpoint_gate import RequestRefused, SetpointGate
from machine.profile import Profile
from machine.status.reasons import Reason

OPERATOR_AGE_NS: Final = 1_000_000_000


class RequestGate(SetpointGate):
    """The gate of all datagrams; as a `SetpointGate` it keeps the order of crane setpoints and spool tests."""

    __slots__ = ("_drives", "_operator_sequence", "_operator_stamp_ns", "watch_stamp_ns")

    def __init__(self, profile: Profile, profile_hash: int) -> None:
        super().__init__(profile, profile_hash)
        self._drives = profile.carrier is not None
        self._operator_stamp_ns = self._operator_sequence = -1
        self.watch_stamp_ns = 0
        """Stamp of the last WATCH or WATCH_END."""

    def accept(
        self, data: bytes, now_ns: int, late_ns: int, operator: bool = False
    ) -> CraneSetpoint | SpoolTest | DriveSetpoint | OperatorAction:
        """The setpoint or operator action in a datagram, checked for form, profile, age and order.

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
