"""The datagram from planner to console about the grasp that the crane is about to make, twice a second until the jaws
have closed.

It travels in the envelope of `can_dbc.messages.envelope` as JSON, like a mission report, and is only shown: the
controller refuses it.  A grasp that does not match its schema in every field is refused as a whole.
"""

from __future__ import annotations

from typing import Annotated, Final, Literal

import msgspec

from can_dbc.messages.envelope import DatagramFault, DatagramRefused, Kind, sealed, unsealed

MAX_LOGS: Final = 20
MAX_REASON_CHARS: Final = 240


class ChosenGrasp(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Where the hanger pin will be when the jaws begin to close, in the crane's base frame [m], the direction of their
    opening axis there [rad, counter-clockwise from base x], the logs' numbers, and the planner's sentence why.
    """

    schema: Literal[1]
    pin_m: tuple[float, float, float]
    yaw_rad: float
    logs: Annotated[tuple[int, ...], msgspec.Meta(max_length=MAX_LOGS)]
    reason: Annotated[str, msgspec.Meta(max_length=MAX_REASON_CHARS)]


_GRASP: Final = msgspec.json.Decoder(ChosenGrasp)


def encode_grasp(
    grasp: ChosenGrasp, sequence: int, profile_hash: int, stamp_ns: int, key: bytes | None = None
) -> bytes:
    """The bytes of a grasp."""
    return sealed(Kind.GRASP, (sequence, profile_hash, stamp_ns), msgspec.json.encode(grasp), key)


def decode_grasp(data: bytes, key: bytes | None = None) -> tuple[int, int, ChosenGrasp]:
    """Profile hash, stamp [ns] and grasp in a datagram.

    Raises:
        DatagramRefused: it is not a valid grasp.
    """
    kind, (_, profile_hash, stamp_ns), body = unsealed(data, key)
    if kind != Kind.GRASP:
        raise DatagramRefused(DatagramFault.KIND)
    try:
        return profile_hash, stamp_ns, _GRASP.decode(body)
    except (msgspec.DecodeError, UnicodeDecodeError):
        raise DatagramRefused(DatagramFault.VALUE) from None
