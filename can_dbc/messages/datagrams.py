"""Encodes and decodes the UDP datagrams of crane and vehicle; those of a mission are in `can_dbc.messages.mission`.

`decode` refuses a datagram as a whole, with a reason: length, magic, version, checksum, authentication, or a value that
is not finite.  Whether a value suits this machine (limits, age, order) is for the supervisor to decide, not for the
codec.
"""

from __future__ import annotations

import struct
from typing import Final

from can_dbc.messages.crane import (
    CraneSetpoint,
    OperatorAction,
    OperatorCommand,
    SpoolTest,
    StateReport,
    crane_body,
    crane_from,
    operator_body,
    operator_from,
    report_body,
    report_from,
    spool_body,
    spool_from,
)
from can_dbc.messages.envelope import (
    DatagramFault,
    DatagramRefused,
    Kind,
    is_operator_command,
    sealed,
    unsealed,
    without_mac,
)
from can_dbc.messages.vehicle import (
    DriveSetpoint,
    VehicleReport,
    drive_body,
    drive_from,
    vehicle_body,
    vehicle_from,
)

OPERATOR_BYTES: Final = len(
    sealed(Kind.OPERATOR, (0, 0, 0), operator_body(OperatorCommand(0, 0, 0, OperatorAction.STOP)), None)
)
"""Of an operator's command without an authenticator."""
Datagram = CraneSetpoint | SpoolTest | DriveSetpoint | OperatorCommand | StateReport | VehicleReport


def encode(message: Datagram, key: bytes | None = None) -> bytes:
    """Encode the bytes of a datagram; times are truncated to 1 us.  With ``key`` it is authenticated."""
    kind, body = _body(message)
    return sealed(kind, (message.sequence, message.profile_hash, message.stamp_ns), body, key)


def decode(data: bytes, key: bytes | None = None) -> Datagram:
    """Decode the message in a datagram.

    Raises:
        DatagramRefused: with the reason; nothing of a refused datagram is used.
    """
    kind, common, body = unsealed(data, key)
    try:
        match kind:
            case Kind.CRANE:
                return crane_from(common, body)
            case Kind.SPOOL:
                return spool_from(common, body)
            case Kind.DRIVE:
                return drive_from(common, body)
            case Kind.OPERATOR:
                return operator_from(common, body)
            case Kind.REPORT:
                return report_from(common, body)
            case Kind.VEHICLE:
                return vehicle_from(common, body)
    except struct.error:
        raise DatagramRefused(DatagramFault.LENGTH) from None
    except DatagramRefused:
        raise
    except ValueError:
        raise DatagramRefused(DatagramFault.VALUE) from None
    raise DatagramRefused(DatagramFault.KIND)


def stop_in(data: bytes) -> bytes:
    """Return the operator's STOP in a datagram that is whole by its checksum, without any authenticator.

    STOP is heard from anyone, whatever key he has.  Empty: the datagram is something else.
    """
    if not is_operator_command(data):
        return b""
    try:
        plain = data if len(data) == OPERATOR_BYTES else without_mac(data)
        message = decode(plain)
    except DatagramRefused:
        return b""
    return plain if isinstance(message, OperatorCommand) and message.action is OperatorAction.STOP else b""


def _body(message: Datagram) -> tuple[Kind, bytes]:
    match message:
        case CraneSetpoint():
            return Kind.CRANE, crane_body(message)
        case SpoolTest():
            return Kind.SPOOL, spool_body(message)
        case DriveSetpoint():
            return Kind.DRIVE, drive_body(message)
        case VehicleReport():
            return Kind.VEHICLE, vehicle_body(message)
        case OperatorCommand():
            return Kind.OPERATOR, operator_body(message)
        case StateReport():
            return Kind.REPORT, report_body(message)
