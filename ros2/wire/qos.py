"""Quality of service, as ROS 2's profiles translate to DDS, with what ROS 2 tells in USER_DATA."""

from __future__ import annotations

from typing import Final

from cyclonedds.core import Policy, Qos
from cyclonedds.idl import IdlStruct

from ros2.wire.type_hashes import type_hash

BLOCKED_NS: Final = 20_000_000
"""Longest time that a write waits for a slow reader; what does not fit then is lost, and the next sample follows."""
_XCDR1: Final = Policy.DataRepresentation(use_cdrv0_representation=True, use_xcdrv2_representation=False)


def endpoint_qos(message: type[IdlStruct], profile: Qos, identity: str = "") -> Qos:
    """Return the QoS of a reader or writer of ``message``.

    ``identity`` is ``clientid=...;`` or ``serviceid=...;`` where the endpoint is half of a service.
    """
    return Qos(_XCDR1, Policy.Userdata(f"{identity}typehash={type_hash(message)};".encode()), base=profile)


def reliable(depth: int) -> Qos:
    """Return a reliable and volatile QoS, the default of ROS 2 and of its services."""
    return Qos(Policy.Reliability.Reliable(BLOCKED_NS), Policy.Durability.Volatile, Policy.History.KeepLast(depth))


def latched(depth: int) -> Qos:
    """Return a reliable and transient local QoS: a late reader gets the last ``depth`` samples."""
    return Qos(
        Policy.Reliability.Reliable(BLOCKED_NS),
        Policy.Durability.TransientLocal,
        Policy.History.KeepLast(depth),
    )


def sensor_data() -> Qos:
    """Return a best-effort QoS, of whose samples only the newest matter: pictures."""
    return Qos(Policy.Reliability.BestEffort, Policy.Durability.Volatile, Policy.History.KeepLast(5))
