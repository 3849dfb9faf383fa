"""Mutates inputs, runs targets on them, and keeps what breaks a contract.

A `Target` reads bytes from outside: it uses them or refuses them, each time in the documented way.  The loop mutates
known inputs: bits, bytes, numbers, words of the format, pieces of other inputs, lengths.  An input with a new outcome
(a refusal code that was never seen, or a new kind of success) joins the known ones.  The same seed gives the same
inputs.

A contract is broken by an exception that is not the documented one, by an input that takes longer than `HANG_S` of
processor time, and by memory that grows.
"""

from __future__ import annotations

import random
import resource
import signal
import struct
import time
from collections.abc import Callable, Hashable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType
from typing import Any

HANG_S = 10.0
MAX_BYTES = 4096
KNOWN_LIMIT = 512
GROWTH_BYTES = 96 << 20
"""A run may keep this much: allocators keep pages, and known inputs are kept."""
REGRESSIONS = Path(__file__).with_name("regressions")
_NUMBERS = (0, 1, 2, 7, 8, 0x0F, 0x10, 0x7F, 0x80, 0xFE, 0xFF)
_WIDE = (0, 1, 0x7FFF, 0x8000, 0xFFFF, 0x7FFF_FFFF, 0x8000_0000, 0xFFFF_FFFF, (1 << 63) - 1, 1 << 63, (1 << 64) - 1)
_FLOATS = (0.0, -0.0, 1.0, float("nan"), float("inf"), float("-inf"), 1e308, 5e-324, -1e9)

Run = Callable[[bytes], "tuple[int, Hashable]"]
"""Judges one input: how many units of the target it contained, and what became of it."""


class Broken(Exception):
    """An input broke a contract of its target."""


class Hang(BaseException):
    """An input took too long; not an Exception, so that no target swallows it."""


@dataclass(frozen=True, slots=True)
class Target:
    """One surface.  ``start`` makes a judge with a fresh state, good for ``runs_per_state`` inputs.

    ``seeds`` makes valid inputs, ``words`` are pieces of the format, and ``mend`` repairs checksums, so that most
    inputs get past them.  ``unit`` names what is counted; ``max_bytes`` bounds the length of an input.
    """

    name: str
    unit: str
    start: Callable[[], Run]
    seeds: Callable[[], Sequence[bytes]]
    words: tuple[bytes, ...] = ()
    mend: Callable[[bytes], bytes] | None = None
    runs_per_state: int = 1 << 62
    max_bytes: int = MAX_BYTES


@dataclass(slots=True)
class Result:
    """What a run of a target did."""

    name: str
    unit: str
    runs: int = 0
    units: int = 0
    outcomes: int = 0
    seconds: float = 0.0
    grown_bytes: int = 0
    failure: str = ""
    saved: Path | None = None
    inputs: list[bytes] = field(default_factory=list)


class Mutator:
    """Makes inputs from known ones."""

    def __init__(self, rng: random.Random, words: Sequence[bytes], max_bytes: int) -> None:
        self._rng, self._words, self._max = rng, words, max_bytes

    def changed(self, data: bytes, other: bytes) -> bytes:
        """``data`` after one to six changes; ``other`` is a second known input."""
        rng = self._rng
        made = bytearray(data)
        for _ in range(rng.choice((1, 1, 1, 2, 2, 3, 4, 6))):
            self._change(made, other)
        return bytes(made[: self._max])

    def _change(self, made: bytearray, other: bytes) -> None:
        rng, size = self._rng, len(made)
        at = rng.randrange(size + 1)
        match rng.randrange(12):
            case 0 if size:
                made[at % size] ^= 1 << rng.randrange(8)
            case 1 if size:
                made[at % size] = rng.choice(_NUMBERS)
            case 2 if size:
                made[at % size] = rng.randrange(256)
            case 3:
                made[at:at] = rng.randbytes(rng.randrange(1, 9))
            case 4:
                del made[at : at + rng.randrange(1, 17)]
            case 5 if size:
                piece = made[at : at + rng.randrange(1, 65)]
                where = rng.randrange(size + 1)
                made[where:where] = piece
            case 6 if other:
                begin = rng.randrange(len(other))
                made[at : at + rng.choice((0, 8, 64))] = other[begin : begin + rng.randrange(1, 129)]
            case 7:
                width = rng.choice((2, 4, 8))
                value = rng.choice(_WIDE) & ((1 << 8 * width) - 1)
                made[at : at + width] = value.to_bytes(width, rng.choice(("little", "big")))
            case 8:
                made[at : at + 8] = struct.pack("<d", rng.choice(_FLOATS))
            case 9 if self._words:
                made[at : at + rng.choice((0, 0, 1, 8))] = rng.choice(self._words)
            case 10 if size > 3 and rng.random() < 0.3:
                del made[at:]
            case _ if size:
                made[at % size] = (made[at % size] + rng.choice((-1, 1))) & 0xFF


def _resident_bytes() -> int:
    fields = Path("/proc/self/statm").read_text().split()
    return int(fields[1]) * resource.getpagesize()


def _alarm(_number: int, _frame: FrameType | None) -> None:
    raise Hang(f"an input took more than {HANG_S:g} s of processor time")


def judged(run: Run, data: bytes) -> tuple[int, Hashable]:
    """The judgement of one input.

    Raises:
        Broken: the target raised, or hung.
    """
    signal.setitimer(signal.ITIMER_VIRTUAL, HANG_S)
    try:
        return run(data)
    except Hang as hang:
        raise Broken(str(hang)) from hang
    except Exception as error:
        raise Broken(f"{type(error).__name__}: {error}") from error
    finally:
        signal.setitimer(signal.ITIMER_VIRTUAL, 0.0)


def inputs(target: Target, seed: int) -> Iterator[tuple[bytes, Callable[[Hashable], None]]]:
    """Inputs without end, each with the function that takes its outcome."""
    rng = random.Random(f"{target.name} {seed}")
    known = list(target.seeds())
    mutator = Mutator(rng, target.words, target.max_bytes)
    seen: set[Hashable] = set()

    def learn(data: bytes, outcome: Hashable) -> None:
        if outcome in seen:
            return
        seen.add(outcome)
        if len(known) < KNOWN_LIMIT:
            known.append(data)

    for data in known[:]:
        yield data, lambda outcome, data=data: learn(data, outcome)
    while True:
        data = mutator.changed(rng.choice(known), rng.choice(known))
        if target.mend is not None and rng.random() < 0.8:
            data = target.mend(data)
        yield data, lambda outcome, data=data: learn(data, outcome)


def fuzz(
    target: Target, seed: int = 1, *, runs: int | None = None, units: int | None = None, seconds: float | None = None,
) -> Result:  # fmt: skip
    """Run a target until a number of inputs or units or a time is reached, or a contract breaks.

    ``Result.inputs`` are then the inputs since the last fresh state.
    """
    result = Result(target.name, target.unit)
    signal.signal(signal.SIGVTALRM, _alarm)
    begun = time.monotonic()
    run, since = target.start(), []
    outcomes: set[Hashable] = set()
    base = 0
    for data, learn in inputs(target, seed):
        enough = (runs is not None and result.runs >= runs) or (units is not None and result.units >= units)
        now = time.monotonic()
        result.seconds = now - begun
        if enough or (seconds is not None and result.seconds >= seconds):
            break
        if len(since) >= target.runs_per_state:
            run, since = target.start(), []
        if target.runs_per_state < 1 << 62:
            since.append(data)
        else:
            since = [data]
        result.runs += 1
        try:
            count, outcome = judged(run, data)
        except Broken as broken:
            result.failure, result.inputs = str(broken), since
            break
        result.units += count
        outcomes.add(outcome)
        result.outcomes = len(outcomes)
        learn(outcome)
        if result.runs == 2000:
            base = _resident_bytes()
        if base and result.runs % 5000 == 0:
            result.grown_bytes = max(result.grown_bytes, _resident_bytes() - base)
            if result.grown_bytes > GROWTH_BYTES:
                result.failure, result.inputs = f"memory grew by {result.grown_bytes >> 20} MiB", since
                break
    return result


# -- regressions -------------------------------------------------------------------------------------------------------


def packed(given: Sequence[bytes]) -> bytes:
    """Inputs in their order, each with its length (u32)."""
    return b"".join(struct.pack("<I", len(data)) + data for data in given)


def unpacked(data: bytes) -> list[bytes]:
    """The inverse of `packed`."""
    found, at = [], 0
    while at < len(data):
        (size,) = struct.unpack_from("<I", data, at)
        found.append(data[at + 4 : at + 4 + size])
        at += 4 + size
    return found


def replay(target: Target, given: Sequence[bytes]) -> None:
    """Judge inputs from a fresh state; raises Broken."""
    signal.signal(signal.SIGVTALRM, _alarm)
    run: Any = target.start()
    for data in given:
        judged(run, data)


def smallest(target: Target, given: Sequence[bytes]) -> list[bytes]:
    """Fewer and shorter inputs that break the contract as well."""

    def breaks(some: Sequence[bytes]) -> bool:
        try:
            replay(target, some)
        except Broken:
            return True
        return False

    kept = list(given)
    if not breaks(kept):
        return kept
    if breaks(kept[-1:]):
        kept = kept[-1:]
    step = len(kept) // 2
    while step:
        at = 0
        while at < len(kept) - 1 and len(kept) > 1:
            fewer = kept[:at] + kept[at + step :]
            if fewer and breaks(fewer):
                kept = fewer
            else:
                at += step
        step //= 2
    step = len(kept[-1]) // 2
    while step:
        at = 0
        while at < len(kept[-1]):
            shorter = kept[-1][:at] + kept[-1][at + step :]
            if breaks([*kept[:-1], shorter]):
                kept[-1] = shorter
            else:
                at += step
        step //= 2
    return kept


def save(target: Target, given: Sequence[bytes]) -> Path:
    """Write inputs into the folder of regressions, which the tests replay."""
    import hashlib

    data = packed(given)
    folder = REGRESSIONS / target.name
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{hashlib.sha256(data).hexdigest()[:12]}.inputs"
    path.write_bytes(data)
    return path
