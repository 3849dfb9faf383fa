"""Turns the signals of one message into flat Python functions: decode, receive and encode.

The source text is generated once at start-up and compiled with ``exec``; its only inputs are numbers and signal names
of a DBC, and a name enters the text only if it is a plain identifier.  The fast path has shifts, masks and one chained
comparison per signal.  Anything unusual (a sentinel, a value out of range, None) goes to the reference code in
``signals``, so that there is one definition of what is refused.
"""

from __future__ import annotations

import hashlib
import importlib
import keyword
import math
import struct
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

from can_dbc.dbc.signals import (
    FLOAT_MAX,
    FrameRefused,
    Refusal,
    Scaling,
    SignalInfo,
    Value,
    integer_raw,
    pack_float,
    unpack_float,
)
from runtime.errors import InputRefused

Values = tuple[Any, ...]
Decoder = Callable[[bytes], Values]
Encoder = Callable[..., bytes]
STRUCT_CODES: Final = {
    (8, False): "B",
    (8, True): "b",
    (16, False): "H",
    (16, True): "h",
    (32, False): "I",
    (32, True): "i",
    (64, False): "Q",
    (64, True): "q",
}
STRUCT_FLOATS: Final = {16: "e", 32: "f", 64: "d"}


def compile_message(name: str, length: int, signals: Sequence[SignalInfo]) -> tuple[Decoder, Decoder, Encoder, str]:
    """Generate (decode, receive, encode, source) of a message of ``length`` bytes."""
    signals = tuple(signals)
    multiplexed = any(s.parent is not None for s in signals)
    space: dict[str, Any] = {
        "_integer_raw": integer_raw,
        "_pack_float": pack_float,
        "_unpack_float": unpack_float,
        "_from_bytes": int.from_bytes,
        "_round": round,
        "_int": int,
        "_len": len,
        "_slow_encode": _slow_encoder(name, length, signals),
        "_slow_receive": _slow_receiver(signals),
        "_unknown": _refuser(Refusal.MULTIPLEXER, name),
        "_length": _refuser(Refusal.LENGTH, name),
    }
    aligned = None if multiplexed else _struct_layout(length, signals)
    if aligned is not None:
        space["_unpack"] = aligned.unpack
    elif length == 8:
        space["_unpack_little"] = struct.Struct("<Q").unpack
        space["_unpack_big"] = struct.Struct(">Q").unpack
    if multiplexed:
        lines = _multiplexed_decode(length, signals)
        space["encode"] = _multiplexed_encoder(name, length, signals)
        space["_extract"] = _extractor(signals)
        lines += ["def receive(data):", " return _slow_receive(_extract(data, decode(data)))"]
    else:
        lines = _flat_decode("decode", length, signals, aligned is not None, checked=False)
        lines += _flat_decode("receive", length, signals, aligned is not None, checked=True)
        lines += _flat_encode(length, signals)
    source = "\n".join(lines) + "\n"
    exec(compile(source, f"<codec of {name}>", "exec"), space)  # text of ours, see above  # nosec B102
    compiled = AHEAD_OF_TIME.get(key_of(source))
    if compiled is not None:
        made = compiled(space["_slow_receive"], space["_slow_encode"], space["_length"])
        return space["decode"], made.receive, made.encode, source
    return space["decode"], space["receive"], space["encode"], source


def key_of(source: str) -> str:
    """Compute the key of a message's generated text among the functions that were compiled ahead of time."""
    return hashlib.sha256(source.encode()).hexdigest()[:32]


def _ahead_of_time() -> Mapping[str, Any]:
    """Load the classes with compiled ``receive`` and ``encode`` by `key_of`; empty on the interpreter."""
    try:
        codecs: Mapping[str, Any] = importlib.import_module("can_dbc.dbc.compiled_codecs").CODECS
    except ImportError:
        return {}
    return codecs


AHEAD_OF_TIME: Final = _ahead_of_time()


# -- decode ------------------------------------------------------------------------------------------------


def _struct_layout(length: int, signals: Sequence[SignalInfo]) -> struct.Struct | None:
    """Find a struct for a message whose signals are all whole aligned integers or floats of one byte order."""
    if not signals or len({s.big_endian for s in signals if s.bits > 8}) > 1:
        return None
    big = any(s.big_endian for s in signals if s.bits > 8)
    position, codes = 0, ""
    for s in signals:
        code = STRUCT_FLOATS.get(s.bits) if s.is_float else STRUCT_CODES.get((s.bits, s.signed))
        first_bit = 8 * length - s.shift - s.bits if s.big_endian else s.shift
        if code is None or first_bit % 8 or first_bit // 8 < position:
            return None
        codes += "x" * (first_bit // 8 - position) + code
        position = first_bit // 8 + s.bits // 8
    return struct.Struct((">" if big else "<") + codes + "x" * (length - position))


def _read_words(length: int, signals: Sequence[SignalInfo]) -> list[str]:
    lines = []
    for order, variable, used in (
        ("little", "w", any(not s.big_endian for s in signals)),
        ("big", "b", any(s.big_endian for s in signals)),
    ):
        if used and length == 8:
            lines.append(f" ({variable},) = _unpack_{order}(data)")
        elif used:
            lines.append(f" {variable} = _from_bytes(data, '{order}')")
    return lines


def _raw_expression(s: SignalInfo, length: int) -> str:
    word = "b" if s.big_endian else "w"
    text = f"{word} >> {s.shift}" if s.shift else word
    if s.shift + s.bits < 8 * length:
        text += f" & {(1 << s.bits) - 1}"
    if s.is_float:
        return f"_unpack_float({text}, {s.bits})"
    if s.signed:
        text = f"({text} ^ {1 << s.bits - 1}) - {1 << s.bits - 1}"
    return f"({text})"


def _physical_expression(s: SignalInfo, raw: str) -> str:
    if s.scaling is Scaling.IDENTITY:
        return raw
    if s.scaling is Scaling.INTEGER:
        scale, offset = int(s.scale), int(s.offset)
        text = raw if scale == 1 else f"{raw} * {scale}"
        return f"{text} + {offset}" if offset else text
    text = f"{raw} * {s.scale!r}"
    # adding 0 only turns -0.0 into 0.0, which does not result from an integer times a positive scale
    return text if s.offset == 0 and s.scale > 0 and not s.is_float else f"{text} + {s.offset!r}"


def _flat_decode(
    function: str, length: int, signals: Sequence[SignalInfo], aligned: bool, *, checked: bool
) -> list[str]:
    checks = [check for i, s in enumerate(signals) for check in receive_checks(s, f"r{i}")] if checked else []
    lines = [f"def {function}(data):", f" if _len(data) != {length}: _length()"]
    raws = [f"r{i}" for i in range(len(signals))]
    if aligned:
        if not checks and all(s.scaling is Scaling.IDENTITY for s in signals):
            return [*lines, " return _unpack(data)"]
        lines.append(f" {', '.join(raws)}, = _unpack(data)")
    else:
        lines += _read_words(length, signals)
        expressions = [_raw_expression(s, length) for s in signals]
        if checks:
            lines += [f" {raw} = {text}" for raw, text in zip(raws, expressions, strict=True)]
        else:
            raws = expressions
    values = "".join(f"{_physical_expression(s, raw)}, " for s, raw in zip(signals, raws, strict=True))
    if not checks:
        return [*lines, f" return ({values})"]
    return [
        *lines,
        f" if {' and '.join(checks)}: return ({values})",
        f" return _slow_receive(({', '.join(raws)},))",
    ]


def receive_checks(s: SignalInfo, raw: str) -> list[str]:
    """List the conditions under which the fast path may use a raw value."""
    if s.is_float:
        low = -math.inf if s.minimum is None else min(s.physical(s.convert(s.minimum)), s.minimum)
        high = math.inf if s.maximum is None else max(s.physical(s.convert(s.maximum)), s.maximum)
        low, high = max(low, -FLOAT_MAX[s.bits]), min(high, FLOAT_MAX[s.bits])
        return [f"{low!r} <= {_physical_expression(s, raw)} <= {high!r}"] if s.scale > 0 else ["False"]
    low, high = s.raw_low, s.raw_high
    special = set(s.sentinels)
    while high in special:
        special.discard(high)
        high -= 1
    while low in special:
        special.discard(low)
        low += 1
    if low > s.raw_min and high < s.raw_max:
        checks = [f"{low} <= {raw} <= {high}"]
    else:
        checks = [f"{raw} >= {low}"] if low > s.raw_min else []
        checks += [f"{raw} <= {high}"] if high < s.raw_max else []
    return checks + [f"{raw} != {value}" for value in sorted(special) if low <= value <= high]


def _slow_receiver(signals: tuple[SignalInfo, ...]) -> Callable[[Sequence[Any]], Values]:
    def slow_receive(raws: Sequence[Any]) -> Values:
        return tuple(None if raw is None else s.valid(raw) for s, raw in zip(signals, raws, strict=True))

    return slow_receive


def _refuser(reason: Refusal, name: str) -> Callable[[], None]:
    def refuse() -> None:
        raise FrameRefused(reason, name)

    return refuse


# -- encode ------------------------------------------------------------------------------------------------


def parameters(signals: Sequence[SignalInfo]) -> list[str]:
    names = [s.name for s in signals]
    plain = all(n.isascii() and n.isidentifier() and not keyword.iskeyword(n) and n[0] != "_" for n in names)
    return names if plain and len(set(names)) == len(names) else [f"v{i}" for i in range(len(names))]


def fast_limits(s: SignalInfo) -> tuple[float, float]:
    """Find the physical interval in which rounding provably stays within range and bits; empty if none is found."""
    tolerance = abs(s.scale) * 1e-6
    low = -math.inf if s.minimum is None else s.minimum - tolerance
    high = math.inf if s.maximum is None else s.maximum + tolerance
    if s.is_float:
        reach = FLOAT_MAX[s.bits] * min(abs(s.scale), 1.0) / 4 - abs(s.offset)
        return max(low, -reach), min(high, reach)
    ends = sorted((s.physical(s.raw_min), s.physical(s.raw_max)))
    low, high = max(low, ends[0]), min(high, ends[1])
    for _ in range(64):
        if low > high or all(s.raw_min <= s.convert(end) <= s.raw_max for end in (low, high)):
            return low, high
        low, high = math.nextafter(low, math.inf), math.nextafter(high, -math.inf)
    return 1.0, 0.0


def _encode_expression(s: SignalInfo, value: str) -> str:
    if s.is_float:
        raw = value if s.scaling is Scaling.IDENTITY else f"({value} - {s.offset!r}) / {s.scale!r}"
        return f"_pack_float({raw}, {s.bits})"
    if s.scaling is Scaling.INTEGER:
        shifted = f"{value} - {int(s.offset)}" if s.offset else value
        raw = f"_round({shifted})" if s.scale == 1 else f"_integer_raw({shifted}, {int(s.scale)})"
    elif s.scaling is Scaling.IDENTITY:
        raw = f"_round({value})"
    else:
        raw = f"_round(({value} - {s.offset!r}) / {s.scale!r})" if s.offset else f"_round({value} / {s.scale!r})"
    return f"({raw} & {(1 << s.bits) - 1})" if s.signed else raw


def _flat_encode(length: int, signals: Sequence[SignalInfo]) -> list[str]:
    names = parameters(signals)
    bit_fields = {False: ["0"], True: ["0"]}
    checks = []
    for s, name in zip(signals, names, strict=True):
        low, high = fast_limits(s)
        checks.append(f"{low!r} <= {name} <= {high!r}")
        bits = _encode_expression(s, name)
        bit_fields[s.big_endian].append(f"{bits} << {s.shift}" if s.shift else bits)
    little, big = (" | ".join(bit_fields[order][1:] or ["0"]) for order in (False, True))
    if not any(s.big_endian for s in signals):
        result = f"({little}).to_bytes({length}, 'little')"
    elif all(s.big_endian for s in signals):
        result = f"({big}).to_bytes({length}, 'big')"
    else:
        swapped = f"_from_bytes(({little}).to_bytes({length}, 'little'), 'big')"
        result = f"({swapped} | {big}).to_bytes({length}, 'big')"
    if not signals:
        return ["def encode():", f" return {bytes(length)!r}"]
    return [
        f"def encode({', '.join(names)}):",
        " try:",
        f"  if {' and '.join(checks)}:",
        f"   return {result}",
        " except TypeError: pass",
        f" return _slow_encode({', '.join(names)})",
    ]


def _slow_encoder(name: str, length: int, signals: tuple[SignalInfo, ...]) -> Encoder:
    def slow_encode(*values: Value) -> bytes:
        return _assemble(name, length, signals, values, range(len(signals)))

    return slow_encode


def _assemble(
    name: str, length: int, signals: Sequence[SignalInfo], values: Sequence[Value], active: Sequence[int]
) -> bytes:
    little = big = 0
    for i in active:
        s = signals[i]
        try:
            bits = s.encode(values[i])
        except InputRefused as error:
            raise InputRefused(error.code, f"{name}.{error}") from None
        if s.big_endian:
            big |= bits << s.shift
        else:
            little |= bits << s.shift
    return bytes(a | b for a, b in zip(little.to_bytes(length, "little"), big.to_bytes(length, "big"), strict=True))


# -- multiplexed messages ------------------------------------------------------------------------------------


def _children(signals: Sequence[SignalInfo], parent: int | None, mux: int | None) -> list[int]:
    return [i for i, s in enumerate(signals) if s.parent == parent and (mux is None or mux in s.parent_ids)]


def _mux_ids(signals: Sequence[SignalInfo], parent: int) -> set[int]:
    """Collect the valid multiplexer values: those with signals of their own, and those of the value table."""
    ids = {mux for s in signals if s.parent == parent for mux in s.parent_ids}
    return ids | set(signals[parent].choices)


def _multiplexed_decode(length: int, signals: Sequence[SignalInfo]) -> list[str]:
    absent = [f"s{i}" for i, s in enumerate(signals) if s.parent is not None]
    lines = ["def decode(data):", f" if _len(data) != {length}: _length()"]
    lines += [*_read_words(length, signals), f" {' = '.join(absent)} = None"]

    def node(parent: int | None, mux: int | None, indent: str) -> None:
        members = _children(signals, parent, mux)
        if not members:
            lines.append(f"{indent}pass")
        for i in members:
            lines.append(f"{indent}s{i} = {_physical_expression(signals[i], _raw_expression(signals[i], length))}")
        for i in members:
            if not signals[i].is_multiplexer:
                continue
            groups: dict[tuple[int, ...], list[int]] = {}
            for value in sorted(_mux_ids(signals, i)):
                groups.setdefault(tuple(_children(signals, i, value)), []).append(value)
            lines.append(f"{indent}m{i} = _int(s{i})")
            branch = "if"
            for values in groups.values():
                condition = f"== {values[0]}" if len(values) == 1 else f"in {{{', '.join(map(str, values))}}}"
                lines.append(f"{indent}{branch} m{i} {condition}:")
                node(i, values[0], indent + " ")
                branch = "elif"
            lines.append(f"{indent}else: _unknown()" if groups else f"{indent}_unknown()")

    node(None, None, " ")
    lines.append(f" return ({', '.join(f's{i}' for i in range(len(signals)))},)")
    return lines


def _multiplexed_encoder(name: str, length: int, signals: tuple[SignalInfo, ...]) -> Encoder:
    def active(values: Sequence[Value], parent: int | None, mux: int | None) -> list[int]:
        active_indices = child_indices = _children(signals, parent, mux)
        for i in child_indices:
            if signals[i].is_multiplexer:
                value = values[i]
                if not isinstance(value, (int, float)) or not math.isfinite(value):
                    raise InputRefused(
                        "codec.multiplexer", f"{name}.{signals[i].name} = {value!r} is not a multiplexer value"
                    )
                if int(value) not in _mux_ids(signals, i):
                    raise InputRefused(
                        "codec.multiplexer", f"{name}.{signals[i].name} = {value} is not a known multiplexer value"
                    )
                active_indices = active_indices + active(values, i, int(value))
        return active_indices

    def encode(*values: Value) -> bytes:
        if len(values) != len(signals):
            raise TypeError(f"{name} takes {len(signals)} values, {len(values)} given")
        used = active(values, None, None)
        surplus = [s.name for i, s in enumerate(signals) if values[i] is not None and i not in used]
        if surplus:
            raise InputRefused(
                "codec.absent-signal", f"{name}: {', '.join(surplus)} is absent for this multiplexer value; give None"
            )
        return _assemble(name, length, signals, values, used)

    return encode


def _extractor(signals: tuple[SignalInfo, ...]) -> Callable[[bytes, Values], list[Any]]:
    def extract(data: bytes, values: Values) -> list[Any]:
        little, big = int.from_bytes(data, "little"), int.from_bytes(data, "big")
        return [None if value is None else s.extract(little, big) for s, value in zip(signals, values, strict=True)]

    return extract
