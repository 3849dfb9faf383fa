"""What can be wrong with the emulated nodes: with their frames, an encoder's answers, a valve's spool."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from random import Random
from typing import Any

from can_dbc.dbc.codec import FrameRefused, MessageCodec
from can_dbc.protocols.e2e import protect

# -- Changes frames between the nodes and the bus: a node that is silent, repeats itself, babbles nonsense or is late.
#
# An effect gets the payload of a frame and returns the payload to send, or None.  It acts on one key of one bus
# until it is removed.  Pure: equal seeds and frames give equal bytes.

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
        last_payload = self._last.get((bus, key))
        return self.add(bus, key, lambda data, now_ns: data if last_payload is None else last_payload)

    def delay(self, bus: str, key: int, delay_ns: int) -> Callable[[], None]:
        """Send a frame ``delay_ns`` late; returns what ends that."""

        def hold(data: bytes, now_ns: int) -> None:
            self._late.append((now_ns + delay_ns, (bus, key, data)))

        return self.add(bus, key, hold)

    def pass_on(self, now_ns: int, sent: list[Sent]) -> list[Sent]:
        """Return the frames that reach the buses now."""
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
    """Drop the frame: it is never sent."""


def garbage(random: Random) -> Effect:
    """Send random bytes of the same length."""
    return lambda data, now_ns: random.randbytes(len(data))


def intermittent(random: Random, probability: float) -> Effect:
    """Lose the frame with a probability."""
    return lambda data, now_ns: None if random.random() < probability else data


def every(count: int) -> Effect:
    """Send only every ``count``-th frame: a node that is too slow."""
    seen = [0]

    def effect(data: bytes, now_ns: int) -> bytes | None:
        seen[0] += 1
        return data if seen[0] % count == 0 else None

    return effect


def rewritten(codec: MessageCodec, values: dict[str, Any]) -> Effect:
    """Send other values for some signals, correctly protected: a sensor that is wrong and does not know it."""

    def effect(data: bytes, now_ns: int) -> bytes:
        try:
            signal_values = list(codec.receive(data))
        except FrameRefused:
            return data
        for name, value in values.items():
            signal_values[codec.index[name]] = value
        payload = codec.encode(*signal_values)
        return payload if codec.data_ids is None else protect(payload, data[1], codec.data_ids)

    return effect


def masqueraded(foreign_ids: bytes) -> Effect:
    """Use another message's Data IDs under this identifier: a right checksum from a wrong sender."""
    return lambda data, now_ns: protect(data, data[1], foreign_ids)


# -- What can be wrong with an encoder that still answers (docs/reference/safety.md section 5, cases 1 to 5).


@dataclass(slots=True)
class EncoderFault:
    """Errors of the reading [rad, m], on top of the sensor's own.

    ``frozen``: the last reading is repeated while the time stamp runs.  ``offset`` jumps, ``drift_per_s`` grows from
    ``since_ns`` on, ``scale`` turns the reading about ``pivot`` (-1: wired the wrong way round), ``noise_factor``
    multiplies the noise.
    """

    frozen: bool = False
    offset: float = 0.0
    drift_per_s: float = 0.0
    since_ns: int = 0
    scale: float = 1.0
    pivot: float = 0.0
    noise_factor: float = 1.0

    def position(self, true: float, now_ns: int) -> float:
        """Return the position that the faulty sensor sees."""
        drifted = self.drift_per_s * (now_ns - self.since_ns) * 1e-9
        return self.pivot + self.scale * (true - self.pivot) + self.offset + drifted


# -- Valves that do not do what their node commands (docs/reference/safety.md section 5, cases 16 to 18).


class SpoolFaults:
    """Changes commands, -1..1 of the spool, by the name of their function.

    ``stuck`` holds a spool wherever the node wants it, ``bias`` adds to the command (the spool drifts), ``gain``
    multiplies it.  They are faults of the amplifiers: without
    pilot pressure the springs centre the spools.
    """

    def __init__(self) -> None:
        self.stuck: dict[str, float] = {}
        self.bias: dict[str, float] = {}
        self.gain: dict[str, float] = {}

    def __bool__(self) -> bool:
        return bool(self.stuck or self.bias or self.gain)

    def apply(self, names: Sequence[str], commands: Sequence[float]) -> list[float]:
        """Return the commands that reach the spools; ``names`` in the order of ``commands``."""
        out = list(commands)
        for i, name in enumerate(names[: len(out)]):
            out[i] = self.stuck.get(name, out[i] * self.gain.get(name, 1.0) + self.bias.get(name, 0.0))
        return out
