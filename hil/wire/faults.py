"""Fault injection: which faults act on which frames of a wire, and when.

A `Fault` is plain data and travels as JSON.  `Damage` decides the fate of each frame when it starts; the core carries
it out.  The same seed and the same frames give the same damage.

| kind | effect |
|---|---|
| drop | the sender succeeds, nobody receives |
| delay | received `shift_ns` later |
| repeat | received again `count` times, `shift_ns` apart |
| corrupt | `count` payload bits flip, undetected by the bus |
| error | the CRC fails: error frame, error counters rise, the sender tries again |
| babble | a new node `node` sends `key` with `data` every `shift_ns`, back to back when that is 0 |
| cut | the cable to participant `node` (None: to everyone) is open |
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from enum import StrEnum
from random import Random
from typing import Any, NamedTuple, Self

from runtime.errors import InputRefused

FOREVER_NS = 1 << 62


class Kind(StrEnum):
    """What a fault does (module docstring)."""

    DROP = "drop"
    DELAY = "delay"
    REPEAT = "repeat"
    CORRUPT = "corrupt"
    ERROR = "error"
    BABBLE = "babble"
    CUT = "cut"


@dataclass(frozen=True, slots=True)
class Fault:
    """One fault, active from `start_ns` up to `end_ns` on frames whose key equals `key` under `mask`.

    Times are those of the core: virtual in lockstep, CLOCK_MONOTONIC in the daemon.  Mask 0 selects every frame; `node`
    restricts the fault to frames sent by participants of that name.  Each frame is hit with `probability`, and at most
    `most` of them where that is not 0.
    """

    kind: Kind
    start_ns: int = 0
    end_ns: int = FOREVER_NS
    key: int = 0
    mask: int = 0
    node: str | None = None
    probability: float = 1.0
    shift_ns: int = 0
    count: int = 1
    data: bytes = bytes(8)
    seed: int = 0
    most: int = 0

    def __post_init__(self) -> None:
        out_of_range = self.shift_ns < 0 or self.count < 1 or self.most < 0
        if self.end_ns <= self.start_ns or out_of_range or len(self.data) > 8:
            raise InputRefused(
                "wire.fault-fields",
                f"The wire fault {self.kind} needs end_ns after start_ns, shift_ns and most of 0 or more, "
                "count of 1 or more and at most 8 data bytes.",
            )

    @classmethod
    def from_json(cls, fields: Mapping[str, Any]) -> Self:
        """Make a fault from its JSON fields; raises ValueError or TypeError for an unknown kind, field or value."""
        converted = dict(fields, kind=Kind(fields.get("kind", "")))
        if "data" in fields:
            converted["data"] = bytes.fromhex(fields["data"])
        return cls(**converted)

    def to_json(self) -> dict[str, Any]:
        return {**asdict(self), "data": self.data.hex()}


class Fate(NamedTuple):
    """The fate of one frame: destroyed by an error frame, or `data` received at each offset."""

    error: bool
    offsets_ns: tuple[int, ...]
    data: bytes


@dataclass(slots=True)
class _Acting:
    """A fault with its random stream, and the number of frames that it has hit."""

    fault: Fault
    random: Random
    hits: int = 0


class Damage:
    """The faults that act on single frames, with one random stream each."""

    def __init__(self) -> None:
        self._faults: list[_Acting] = []

    def __bool__(self) -> bool:
        return bool(self._faults)

    def add(self, fault: Fault) -> None:
        self._faults.append(_Acting(fault, Random(fault.seed)))

    def clear(self) -> None:
        self._faults.clear()

    def fate(self, at_ns: int, sender: str, key: int, data: bytes) -> Fate:
        """Decide the fate of a frame that starts at `at_ns`; faults apply in the order in which they were added."""
        error = False
        offsets: tuple[int, ...] = (0,)
        self._faults = [acting for acting in self._faults if at_ns < acting.fault.end_ns]
        for acting in self._faults:
            fault, random = acting.fault, acting.random
            if (
                at_ns < fault.start_ns
                or (key ^ fault.key) & fault.mask
                or fault.node not in (None, sender)
                or 0 < fault.most <= acting.hits
                or random.random() >= fault.probability
            ):
                continue
            acting.hits += 1
            match fault.kind:
                case Kind.DROP:
                    offsets = ()
                case Kind.DELAY:
                    offsets = tuple(offset + fault.shift_ns for offset in offsets)
                case Kind.REPEAT:
                    offsets = tuple(o + i * fault.shift_ns for o in offsets for i in range(fault.count + 1))
                case Kind.CORRUPT:
                    data = _flip(data, fault.count, random)
                case Kind.ERROR:
                    error = True
        return Fate(error, offsets, data)


def _flip(data: bytes, count: int, random: Random) -> bytes:
    bits = int.from_bytes(data, "big")
    for position in random.sample(range(8 * len(data)), min(count, 8 * len(data))):
        bits ^= 1 << position
    return bits.to_bytes(len(data), "big")
