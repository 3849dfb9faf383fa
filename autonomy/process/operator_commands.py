"""A person's orders to the mission: the gate of their datagrams, judged as the controller judges an operator's.

An order counts when its checksum (and, with a key, its authentication) is right, when it is for this machine, no older
than ``AGE_NS`` and newer than the last one.  It comes from this machine: the port is bound to loopback, and a stamp of
another machine's clock has no age here.
"""

from __future__ import annotations

from typing import Final

from can_dbc.mission_datagrams import MissionOrder, decode_order
from can_dbc.setpoint import DatagramRefused

AGE_NS: Final = 1_000_000_000


class OrderRefused(ValueError):
    """An order that is not heeded; the message says why."""


class Orders:
    """The gate; it remembers the last order that it let through."""

    def __init__(self, profile_hash: int, key: bytes | None = None) -> None:
        self._hash, self._key = profile_hash, key
        self._last = (-1, -1)

    def take(self, data: bytes, now_ns: int) -> MissionOrder:
        """The order in a datagram.

        Raises:
            OrderRefused: nothing of it is heeded.
        """
        try:
            order = decode_order(data, self._key)
        except DatagramRefused as error:
            raise OrderRefused(str(error)) from None
        if order.profile_hash != self._hash:
            raise OrderRefused("it is for a machine with another profile")
        if order.stamp_ns > now_ns:
            raise OrderRefused("its stamp lies in the future")
        if now_ns - order.stamp_ns > AGE_NS:
            raise OrderRefused(f"it is {(now_ns - order.stamp_ns) * 1e-9:.1f} s old")
        if (order.stamp_ns, order.sequence) <= self._last:
            raise OrderRefused("it was given before, or a later one was")
        self._last = (order.stamp_ns, order.sequence)
        return order
