"""Changes frames between the nodes and the bus: a node that is silent, repeats itself, babbles nonsense or is late.

An effect gets the payload of a frame and returns the payload to send, or None.  It acts on one key of one bus until it
is removed.  Pure: equal seeds and frames give equal bytes.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from random import Random
from typing import Any

from can_dbc.dbc.codec import FrameRefused, MessageCodec
from can_dbc.protocols.e2e import protect

Sent = tuple[str, int, bytes]
"""Bus, key and payload of a frame to send."""
Effect = Callable[[bytes, int], bytes | None]
"""Payload and time [ns] to the payload that is sent, None for none."""


class FrameTap:
    """All effects on the frames that the nodes of a machine send; `pass_on` once per step of the machine."""

    def __init__(self) -> None:
        self._effects: dict[tuple[str, int], list[Effect]] = {}
        self._last: dict[tuple[str, int], bytes] = {}
        self._late: deque[tuple[int, Sent]] = deque()
        self._now_ns = 0

    def add(self, bus: str, key: int, effect: Effect) -> Callable[[], None]:
        """Let an effect act on a frame; returns what removes it."""
        effects = self._effects.setdefault((bus, key), [])
        effects.append(effect)

        def remove() -> None:
            effects.remove(effect)

        return remove

    def repeat(self, bus: str, key: int) -> Callable[[], None]:
        """Send the last frame again and again: counter, time stamp and values stand still; returns what ends that."""
        kept = self._last.get((bus, key))
        return self.add(bus, key, lambda data, now_ns: data if kept is None else kept)

    def delay(self, bus: str, key: int, delay_ns: int) -> Callable[[], None]:
        """Send a frame ``delay_ns`` late; returns what ends that."""

        def hold(data: bytes, now_ns: int) -> None:
            self._late.append((now_ns + delay_ns, (bus, key, data)))

        return self.add(bus, key, hold)

    def pass_on(self, now_ns: int, sent: list[Sent]) -> list[Sent]:
        """The frames that reach the buses now."""
        for bus, key, data in sent:
            self._last[bus, key] = data
        if not self._effects and not self._late:
            return sent
        out: list[Sent] = []
        while self._late and self._late[0][0] <= now_ns:
            out.append(self._late.popleft()[1])
        for bus, key, data in sent:
            payload: bytes | None = data
            for effect in self._effects.get((bus, key), ()):
                if payload is not None:
                    payload = effect(payload, now_ns)
            if payload is not None:
                out.append((bus, key, payload))
        return out


def silent(data: bytes, now_ns: int) -> None:
    """The frame is never sent."""


def garbage(random: Random) -> Effect:
    """Random bytes of the same length."""
    return lambda data, now_ns: random.randbytes(len(data))


def intermittent(random: Random, probability: float) -> Effect:
    """The frame is lost with a probability."""
    return lambda data, now_ns: None if random.random() < probability else data


def every(count: int) -> Effect:
    """Only every ``count``-th frame is sent: a node that is too slow."""
    seen = [0]

    def effect(data: bytes, now_ns: int) -> bytes | None:
        seen[0] += 1
        return data if seen[0] % count == 0 else None

    return effect


def rewritten(codec: MessageCodec, values: dict[str, Any]) -> Effect:
    """Other values for some signals, correctly protected: a sensor that is wrong and does not know it."""

    def effect(data: bytes, now_ns: int) -> bytes:
        try:
            found = list(codec.receive(data))
        except FrameRefused:
            return data
        for name, value in values.items():
            found[codec.index[name]] = value
        payload = codec.encode(*found)
        return payload if codec.data_ids is None else protect(payload, data[1], codec.data_ids)

    return effect


def masqueraded(foreign_ids: bytes) -> Effect:
    """Another message's Data IDs under this identifier: a right checksum from a wrong sender."""
    return lambda data, now_ns: protect(data, data[1], foreign_ids)
