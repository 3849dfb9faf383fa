"""Mutates inputs, runs targets on them, and keeps what breaks a contract.

A `Target` reads bytes from outside: it uses them or refuses them, each time in the documented way.  `fuzz` mutates
known inputs: bits, bytes, numbers, words of the format, pieces of other inputs, lengths.  An input with a new outcome
(a refusal code that was never seen, or a new kind of success) joins the known ones.  The same seed gives the same
inputs.

A contract is broken by an exception that is not the documented one, by an input that takes longer than `HANG_S` of
processor time or more memory than `MEMORY_BYTES` while it is judged, and by memory that grows.
"""

from __future__ import annotations

import atexit
import hashlib
import random
import re
import resource
import shutil
import signal
import struct
import tempfile
import time
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType
from typing import Any, TypeVar

HANG_S = 2.0
MEMORY_BYTES = 200 << 20
"""Of one input, beside what the process has already."""
KNOWN_LIMIT = 512
FOREVER = 1 << 62
GROWTH_BYTES = 96 << 20
"""A run may keep this much: allocators keep pages, and known inputs are kept."""
REGRESSIONS = Path(__file__).with_name("regressions")
CODE = re.compile(r"[a-z0-9]+(-[a-z0-9]+)*(\.[a-z0-9]+(-[a-z0-9]+)*)+")
MAX_SENTENCE_CHARS = 20_000
_NUMBERS = (0, 1, 2, 7, 8, 0x0F, 0x10, 0x7F, 0x80, 0xFE, 0xFF)
_WIDE = (0, 1, 0x7FFF, 0x8000, 0xFFFF, 0x7FFF_FFFF, 0x8000_0000, 0xFFFF_FFFF, (1 << 63) - 1, 1 << 63, (1 << 64) - 1)
_FLOATS = (0.0, -0.0, 1.0, float("nan"), float("inf"), float("-inf"), 1e308, 5e-324, -1e9)

Run = Callable[[bytes], Hashable]
"""Judges one input: what became of it."""
_S = TypeVar("_S", list[bytes], bytes)


class Broken(Exception):
    """An input broke a contract of its target."""


class Hang(BaseException):
    """An input took too long; not an Exception, so that no target swallows it."""


@dataclass(frozen=True, slots=True)
class Target:
    """One surface.  ``start`` makes a judge with a fresh state, good for ``runs_per_state`` inputs.

    ``seeds`` makes valid inputs, ``words`` are pieces of the format, and ``mend`` repairs checksums, so that most
    inputs get past them.  ``unit`` names what ``count`` finds in an input; ``max_bytes`` bounds its length.
    """

    name: str
    unit: str
    start: Callable[[], Run]
    seeds: Callable[[], Sequence[bytes]]
    words: Sequence[bytes] = ()
    mend: Callable[[bytes], bytes] | None = None
    runs_per_state: int = FOREVER
    max_bytes: int = 4096
    count: Callable[[bytes], int] = lambda _: 1


@dataclass(slots=True)
class Result:
    """What a run of a target did; ``inputs`` are those since the last fresh state when a contract broke."""

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


# -- what targets share ------------------------------------------------------------------------------------------------


def coded(error: Exception) -> str:
    """The code of a refusal, which has one that is stable, and one sentence that a person can read."""
    code, text = getattr(error, "code", ""), str(error)
    assert isinstance(code, str) and CODE.fullmatch(code), f"code {code!r}"
    assert text.strip(), f"{code} has no sentence"
    assert len(text) < MAX_SENTENCE_CHARS, f"{code}: {len(text)} characters"
    assert "Traceback" not in text and "object at 0x" not in text, text
    return code


def outcome(
    refusal: type[Exception] | tuple[type[Exception], ...],
    read: Callable[..., Any],
    *arguments: Any,
    then: Callable[[Any], Hashable] = lambda _: "good",
) -> Hashable:
    """The code of the documented refusal to read; else what ``then`` says of what was read."""
    try:
        found = read(*arguments)
    except refusal as refused:
        return coded(refused)
    return then(found)


def of_file(
    name: str,
    refusal: type[Exception] | tuple[type[Exception], ...],
    read: Callable[[Path], Any],
    then: Callable[[Any], Hashable] = lambda _: "good",
) -> Callable[[], Run]:
    """The start of a target that reads a file: of this name, with the input in it."""

    def start() -> Run:
        path = in_file(name)

        def run(data: bytes) -> Hashable:
            path.write_bytes(data)
            return outcome(refusal, read, path, then=then)

        return run

    return start


def in_file(name: str) -> Path:
    """A file in a folder of this process, in memory where the system has one; it ends with the process."""
    folder = Path(tempfile.mkdtemp(prefix="timberhand-fuzz-", dir="/dev/shm" if Path("/dev/shm").is_dir() else None))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder / name


# -- the loop ----------------------------------------------------------------------------------------------------------


def changed(rng: random.Random, data: bytes, other: bytes, words: Sequence[bytes]) -> bytes:
    """``data`` after one to six changes; ``other`` is a second known input."""
    made = bytearray(data)
    for _ in range(rng.choice((1, 1, 1, 2, 2, 3, 4, 6))):
        _change(rng, made, other, words)
    return bytes(made)


def _change(rng: random.Random, made: bytearray, other: bytes, words: Sequence[bytes]) -> None:
    size = len(made)
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
        case 9 if words:
            made[at : at + rng.choice((0, 0, 1, 8))] = rng.choice(words)
        case 10 if size > 3 and rng.random() < 0.3:
            del made[at:]
        case _ if size:
            made[at % size] = (made[at % size] + rng.choice((-1, 1))) & 0xFF


def _memory_bytes() -> tuple[int, int]:
    """What this process has mapped, and what of it is resident."""
    mapped, resident, *_ = Path("/proc/self/statm").read_text().split()
    return int(mapped) * resource.getpagesize(), int(resident) * resource.getpagesize()


def _peak_bytes() -> int:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss << 10


def _alarm(_number: int, _frame: FrameType | None) -> None:
    raise Hang(f"an input took more than {HANG_S:g} s of processor time")


def judged(run: Run, data: bytes) -> Hashable:
    """The judgement of one input.

    Raises:
        Broken: the target raised, hung, or took too much memory.
    """
    peak, (mapped, resident) = _peak_bytes(), _memory_bytes()
    limits = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (mapped + 2 * MEMORY_BYTES, limits[1]))
    signal.signal(signal.SIGVTALRM, _alarm)
    signal.setitimer(signal.ITIMER_VIRTUAL, HANG_S)
    try:
        fate = run(data)
        if _peak_bytes() > peak and _peak_bytes() - resident > MEMORY_BYTES:
            raise Broken(f"an input took {(_peak_bytes() - resident) >> 20} MiB of memory")
        return fate
    except Hang as hang:
        raise Broken(str(hang)) from hang
    except Broken:
        raise
    except Exception as error:
        raise Broken(f"{type(error).__name__}: {error}") from error
    finally:
        signal.setitimer(signal.ITIMER_VIRTUAL, 0.0)
        resource.setrlimit(resource.RLIMIT_AS, limits)


def fuzz(
    target: Target,
    seed: int = 1,
    *,
    runs: int | None = None,
    units: int | None = None,
    seconds: float | None = None,
) -> Result:
    """Run a target until a number of inputs or units or a time is reached, or a contract breaks."""
    result, rng = Result(target.name, target.unit), random.Random(f"{target.name} {seed}")
    known = list(target.seeds())
    seeds, outcomes, base_bytes = iter(known[:]), set(), 0
    begun = time.monotonic()
    run, since = target.start(), []
    while True:
        result.seconds = time.monotonic() - begun
        reached = ((result.runs, runs), (result.units, units), (result.seconds, seconds))
        if any(limit is not None and value >= limit for value, limit in reached):
            return result
        data = next(seeds, None)
        if data is None:
            data = changed(rng, rng.choice(known), rng.choice(known), target.words)[: target.max_bytes]
            if target.mend is not None and rng.random() < 0.8:
                data = target.mend(data)
        if len(since) >= target.runs_per_state:
            run, since = target.start(), []
        if target.runs_per_state == FOREVER:
            since.clear()
        since.append(data)
        result.runs += 1
        try:
            fate = judged(run, data)
        except Broken as broken:
            result.failure, result.inputs = str(broken), since
            return result
        result.units += target.count(data)
        if fate not in outcomes and len(known) < KNOWN_LIMIT:
            known.append(data)
        outcomes.add(fate)
        result.outcomes = len(outcomes)
        if result.runs == 2000:
            base_bytes = _memory_bytes()[1]
        if base_bytes and result.runs % 5000 == 0:
            result.grown_bytes = max(result.grown_bytes, _memory_bytes()[1] - base_bytes)
            if result.grown_bytes > GROWTH_BYTES:
                result.failure, result.inputs = f"memory grew by {result.grown_bytes >> 20} MiB", since
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
    run = target.start()
    for data in given:
        judged(run, data)


def smallest(target: Target, given: Sequence[bytes]) -> list[bytes]:
    """Fewer inputs, the last of them shorter, that break the contract as well."""

    def breaks(some: list[bytes]) -> bool:
        try:
            replay(target, some)
        except Broken:
            return True
        return False

    kept = list(given)
    if not breaks(kept):
        return kept
    kept = kept[-1:] if breaks(kept[-1:]) else _without_needless(kept, breaks)
    return [*kept[:-1], _without_needless(kept[-1], lambda last: breaks([*kept[:-1], last]))]


def _without_needless(whole: _S, breaks: Callable[[_S], bool]) -> _S:
    """The whole without the pieces that it can do without and still breaks the contract."""
    step = (len(whole) + 1) // 2
    while step:
        at = 0
        while at < len(whole):
            less = whole[:at] + whole[at + step :]
            if breaks(less):
                whole = less
            else:
                at += step
        step //= 2
    return whole


def save(target: Target, given: Sequence[bytes]) -> Path:
    """Write inputs into the folder of regressions, which the tests replay."""
    data = packed(given)
    path = REGRESSIONS / target.name / f"{hashlib.sha256(data).hexdigest()[:12]}.inputs"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data)
    return path
