"""Checks a DBC or KCD file: whether it loads, whether the compiled codecs equal cantools, and lint.

``check(path, frames, seed)`` returns a ``Report``; it never raises for a bad file.  The comparison drives both codecs
with the same random payloads and values; where cantools refuses a value, the codec must refuse it, too.  Lint finds
what a loader does not report: overlapping bits, ranges that the bits cannot hold, missing units and cycle times,
duplicate identifiers.  Deterministic for a seed.
"""

from __future__ import annotations

import math
import random
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

from can_dbc.dbc.codec import FrameRefused, MessageCodec, Policy, SignalInfo, parse, resolve, usable
from can_dbc.dbc.signals import ERROR, NOT_AVAILABLE
from can_dbc.frame import describe
from runtime.errors import ConfigError, InputRefused

MAX_EXAMPLES: Final = 5


@dataclass(frozen=True, slots=True)
class Finding:
    """One lint warning: ``where`` is message or message.signal, ``rule`` a short name, ``text`` a sentence."""

    where: str
    rule: str
    text: str


@dataclass(frozen=True, slots=True)
class Report:
    """The result for one file.  ``error`` is the reason why it cannot be loaded, else empty; ``differences`` are the
    first cases where codec and cantools disagree, ``different`` counts them all."""

    path: str
    error: str
    messages: int
    signals: int
    decoded: int
    encoded: int
    different: int
    differences: tuple[str, ...]
    warnings: tuple[Finding, ...]


def check(name_or_path: str, frames: int, seed: int) -> Report:
    """Load, lint and compare one file over ``frames`` random payloads and value sets per message."""
    try:
        path = resolve(name_or_path)
    except ConfigError as error:
        return Report(str(name_or_path), str(error), 0, 0, 0, 0, 0, (), ())
    try:
        database = parse(path)
        pairs = [(message, usable(message, path)) for message in database.messages]
    except ConfigError as error:
        try:
            findings = lint(parse(path, strict=False))
        except ConfigError:
            findings = ()
        return Report(str(path), str(error), 0, 0, 0, 0, 0, (), findings)
    rng = random.Random(seed)
    differences: list[str] = []
    decoded = encoded = 0
    for message, codec in pairs:
        for _ in range(frames):
            payload = random_payload(rng, codec)
            values = random_values(rng, codec, payload)
            decoded += 1
            differences += compare_decode(message, codec, payload)
            if values is not None:
                encoded += 1
                differences += compare_encode(message, codec, values)
    return Report(
        str(path),
        "",
        len(pairs),
        sum(len(codec.signals) for _, codec in pairs),
        decoded,
        encoded,
        len(differences),
        tuple(differences[:MAX_EXAMPLES]),
        lint(database),
    )


# -- comparison ------------------------------------------------------------------------------------------------


def _refusals() -> tuple[type[Exception], ...]:
    """Return the exceptions of cantools for data that it refuses."""
    import bitstruct  # type: ignore[import-untyped]
    from cantools.database.errors import Error

    return (Error, bitstruct.Error, ValueError, OverflowError, KeyError, TypeError)


def random_payload(rng: random.Random, codec: MessageCodec) -> bytes:
    """Draw random bytes, in three of four cases with known multiplexer values."""
    payload = rng.randbytes(codec.length)
    if rng.random() < 0.25 or not any(s.is_multiplexer for s in codec.signals):
        return payload
    for i, s in enumerate(codec.signals):
        ids = sorted({mux for other in codec.signals if other.parent == i for mux in other.parent_ids})
        if s.is_multiplexer and ids:
            order = "big" if s.big_endian else "little"
            mask = (1 << s.bits) - 1
            word = int.from_bytes(payload, order) & ~(mask << s.shift)  # type: ignore[arg-type]
            word |= (rng.choice(ids) & mask) << s.shift
            payload = word.to_bytes(codec.length, order)  # type: ignore[arg-type]
    return payload


def random_values(rng: random.Random, codec: MessageCodec, payload: bytes) -> list[Any] | None:
    """Draw values around those of a payload: unchanged, off the grid, at and beyond the limits; None if unreadable."""
    try:
        values = list(codec.decode(payload))
    except FrameRefused:
        return None
    for i, s in enumerate(codec.signals):
        if values[i] is not None and not s.is_multiplexer:
            values[i] = _near(rng, s, values[i])
    return values


def _near(rng: random.Random, s: SignalInfo, value: float) -> float:
    low = s.physical(s.raw_min) if s.minimum is None else s.minimum
    high = s.physical(s.raw_max) if s.maximum is None else s.maximum
    if s.is_float and (s.minimum is None or s.maximum is None):
        low, high = -1e3, 1e3
    kind = rng.random()
    if kind < 0.1:
        return rng.choice((low, high)) + rng.choice((-1.0, -1e-7, 0.0, 1e-7, 1.0)) * abs(s.scale)
    if kind < 0.3 and math.isfinite(value):
        return value
    if kind < 0.4:
        return low + round((high - low) / abs(s.scale) * rng.random() * 2) / 2 * abs(s.scale)
    return low + (high - low) * rng.random()


def compare_decode(message: Any, codec: MessageCodec, payload: bytes) -> list[str]:
    """Find the differences (none or one) between cantools and the codec for one payload."""
    try:
        want = message.decode(payload, decode_choices=False)
    except _refusals():
        want = None
    try:
        got = codec.named(codec.decode(payload))
    except FrameRefused:
        got = None
    if got == want or (got and want and got.keys() == want.keys() and all(map(_same, got.values(), want.values()))):
        return []
    return [f"{codec.name} decode {payload.hex()}: ours {got}, cantools {want}"]


def _same(a: float, b: float) -> bool:
    return a == b or (a != a and b != b)


def compare_encode(message: Any, codec: MessageCodec, values: Sequence[Any]) -> list[str]:
    """Find the differences (none or one) between cantools and the codec for one set of values.

    The codec may refuse more: values that are not finite, and values out of range that the value table labels as no
    measurement.
    """
    given: dict[str, Any] = {}
    stricter = False
    for s, value in zip(codec.signals, values, strict=True):
        if value is None:
            continue
        if s.policy is Policy.SATURATE and math.isfinite(value):
            value = min(max(value, s.physical(s.raw_low)), s.physical(s.raw_high)) if not s.inside(value) else value
        elif not math.isfinite(value) or (not s.inside(value) and s.convert(value) in s.sentinels):
            stricter = True
        given[s.name] = value
    try:
        want = message.encode(given, strict=True)
    except _refusals():
        want = None
    try:
        got = codec.encode(*values)
    except InputRefused:
        got = None
    if got == want or (got is None and stricter):
        return []
    return [f"{codec.name} encode {given}: ours {got.hex() if got else got}, cantools {want.hex() if want else want}"]


# -- lint ------------------------------------------------------------------------------------------------------


def lint(database: Any) -> tuple[Finding, ...]:
    """List the warnings for a cantools database that can be read (loaded with ``strict=False`` if necessary)."""
    findings: list[Finding] = []
    ids = Counter((m.frame_id, m.is_extended_frame) for m in database.messages)
    for message in database.messages:
        name = message.name
        if ids[message.frame_id, message.is_extended_frame] > 1:
            key = message.frame_id | (0x8000_0000 if message.is_extended_frame else 0)
            findings.append(Finding(name, "identifier", f"another message also has the identifier {describe(key)}"))
        if "GenMsgCycleTime" not in (message.dbc.attributes if message.dbc else {}) and not message.cycle_time:
            findings.append(Finding(name, "cycle-time", "no GenMsgCycleTime"))
        findings += _overlaps(message)
        for s in message.signals:
            findings += _signal_findings(f"{name}.{s.name}", s)
    return tuple(findings)


def _signal_findings(where: str, s: Any) -> list[Finding]:
    findings = []
    scale, offset = s.conversion.scale, s.conversion.offset
    labels = {str(label) for label in (s.choices or {}).values()} - {ERROR, NOT_AVAILABLE}
    if not s.unit and not labels and (scale != 1 or offset or s.conversion.is_float):
        findings.append(Finding(where, "unit", "a scaled value without a unit"))
    if s.conversion.is_float:
        return findings
    ends = [-(1 << s.length - 1), (1 << s.length - 1) - 1] if s.is_signed else [0, (1 << s.length) - 1]
    low, high = sorted(raw * scale + offset for raw in ends)
    slack = abs(scale) / 2 + 1e-12 * max(abs(low), abs(high))
    for limit, text in ((s.minimum, "minimum"), (s.maximum, "maximum")):
        if limit is not None and not low - slack <= limit <= high + slack:
            reach = f"{low:.12g} to {high:.12g}"
            findings.append(Finding(where, "range", f"{text} {limit} is outside the range of the bits, {reach}"))
    if s.minimum is not None and s.maximum is not None and s.minimum > s.maximum:
        findings.append(Finding(where, "range", f"minimum {s.minimum} is above maximum {s.maximum}"))
    return findings


def _bits(s: Any) -> set[int]:
    """Return the payload bits of a signal, numbered 8 * byte + significance."""
    if s.byte_order == "little_endian":
        return set(range(s.start, s.start + s.length))
    first = 8 * (s.start // 8) + 7 - s.start % 8
    return {8 * (n // 8) + 7 - n % 8 for n in range(first, first + s.length)}


def _together(a: Any, b: Any, parents: dict[str, Any]) -> bool:
    """Tell whether two signals can be present in the same frame: no common multiplexer separates them."""

    def selections(s: Any) -> dict[str, set[int]]:
        ids_by_multiplexer: dict[str, set[int]] = {}
        while s is not None and s.multiplexer_signal is not None:
            ids_by_multiplexer[s.multiplexer_signal] = set(s.multiplexer_ids or ())
            s = parents.get(s.multiplexer_signal)
        return ids_by_multiplexer

    ours, theirs = selections(a), selections(b)
    return all(ours[mux] & theirs[mux] for mux in ours.keys() & theirs.keys())


def _overlaps(message: Any) -> list[Finding]:
    findings = []
    parents = {s.name: s for s in message.signals if s.is_multiplexer}
    placed = [(s, _bits(s)) for s in message.signals]
    for i, (s, bits) in enumerate(placed):
        if max(bits) >= 8 * message.length:
            text = f"reaches beyond the {message.length} bytes of the message"
            findings.append(Finding(f"{message.name}.{s.name}", "length", text))
        for other, other_bits in placed[:i]:
            if bits & other_bits and _together(s, other, parents):
                text = f"shares {len(bits & other_bits)} bits with {other.name}"
                findings.append(Finding(f"{message.name}.{s.name}", "overlap", text))
    return findings
