"""Compiles DBC files to flat codecs: the contract between bytes on the bus and numbers in the program.

``load("crane")`` (or ``"machine"``, ``"gnss"``, or a path to any DBC or KCD) reads the file with cantools
once, at start-up, and returns a ``Database`` of ``MessageCodec``.  A codec is plain data with three
compiled functions:

* ``decode(data)``: physical values in signal order, equal to cantools' ``decode(decode_choices=False)``;
  checks the length only.  Signals that a multiplexer leaves out are None.
* ``receive(data)``: the same for a live system.  A frame with a value out of range is refused as a whole
  (``FrameRefused``); a raw value labelled NotAvailable or Error becomes None.
* ``encode(*values)``: bytes from physical values in signal order.  Never wraps: raises ``InputRefused``, or takes
  the nearest valid value if the DBC says saturate.  None writes NotAvailable.  Values round half to even.

A file that cannot be used raises ``ConfigError`` with file, line if known, and reason.
"""

from __future__ import annotations

import functools
import re
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final

from can_dbc.dbc.codegen import Decoder, Encoder, Values, compile_message
from can_dbc.dbc.signals import FrameRefused, Policy, Refusal, SignalInfo
from can_dbc.frame import EXTENDED, describe
from can_dbc.text import decoded
from runtime.errors import ConfigError

__all__ = [
    "SHIPPED",
    "Database",
    "FrameRefused",
    "MessageCodec",
    "Policy",
    "Refusal",
    "SignalInfo",
    "compile_one",
    "load",
    "parse",
    "pgn_key",
    "resolve",
    "usable",
]
SHIPPED: Final = ("crane", "machine", "gnss")
PDU2_MASK: Final = EXTENDED | 0x03FF_FF00
PDU1_MASK: Final = EXTENDED | 0x03FF_0000


@dataclass(frozen=True, slots=True)
class MessageCodec:
    """One message: identity, timing, E2E Data IDs (None without E2E) and the three compiled functions.

    ``key`` follows ``can_dbc.frame``; times are in ns, 0 if the DBC gives none.  ``index`` maps a signal name to its
    place in a value tuple.  ``by_pgn``: matched with any priority and source address (J1939, NMEA 2000).
    """

    name: str
    key: int
    length: int
    cycle_time_ns: int
    timeout_ns: int
    signals: tuple[SignalInfo, ...] = field(repr=False)
    senders: tuple[str, ...]
    comment: str = field(repr=False)
    data_ids: bytes | None
    by_pgn: bool
    decode: Decoder = field(repr=False, compare=False)
    receive: Decoder = field(repr=False, compare=False)
    encode: Encoder = field(repr=False, compare=False)
    index: Mapping[str, int] = field(repr=False, compare=False)
    source: str = field(repr=False, compare=False)

    def named(self, values: Values) -> dict[str, Any]:
        """Return a value tuple as a dictionary without the absent signals."""
        return {s.name: v for s, v in zip(self.signals, values, strict=True) if v is not None}


@dataclass(frozen=True, slots=True)
class Database:
    """All messages of one file, by name and by key, and the PGN-matched ones by ``pgn_key``."""

    path: Path
    messages: Mapping[str, MessageCodec]
    by_key: Mapping[int, MessageCodec]
    by_pgn: Mapping[int, MessageCodec]

    def message(self, name: str) -> MessageCodec:
        """Return the codec of a message; raises ConfigError if the file has no such message."""
        codec = self.messages.get(name)
        if codec is None:
            raise ConfigError("dbc.unknown-message", f"{self.path}: there is no message {name}")
        return codec

    def find(self, key: int) -> MessageCodec | None:
        """Find the codec for a received key: an exact match first, then by PGN; None for a foreign frame."""
        return self.by_key.get(key) or (self.by_pgn.get(pgn_key(key)) if key & EXTENDED else None)


def pgn_key(key: int) -> int:
    """Strip an extended key of priority, source address and (for PDU1 formats) destination address."""
    return key & (PDU2_MASK if key >> 16 & 0xFF >= 240 else PDU1_MASK)


def resolve(name_or_path: str | Path) -> Path:
    """Find the path of a shipped database (a name without suffix) or of a file; raises ConfigError if there is none."""
    path = Path(name_or_path)
    if str(name_or_path) in SHIPPED:
        return Path(__file__).parents[1] / f"{name_or_path}.dbc"
    if not path.is_file():
        raise ConfigError("dbc.no-file", f"{path}: no such file; shipped databases are {', '.join(SHIPPED)}")
    return path


def load(name_or_path: str | Path) -> Database:
    """Read and compile a database: one of ``SHIPPED`` (once in a process) or a DBC or KCD file; raises ConfigError."""
    return _shipped(str(name_or_path)) if str(name_or_path) in SHIPPED else _read(resolve(name_or_path))


@functools.cache
def _shipped(name: str) -> Database:
    return _read(resolve(name))


def _read(path: Path) -> Database:
    database = parse(path)
    messages = [usable(message, path) for message in database.messages]
    if _is_j1939(database):
        messages = [replace(m, by_pgn=True) if m.key & EXTENDED else m for m in messages]
    for field_name, counts in (
        ("name", Counter(m.name for m in messages)),
        ("identifier", Counter(describe(m.key) for m in messages)),
    ):
        duplicates = [value for value, n in counts.items() if n > 1]
        if duplicates:
            raise ConfigError("dbc.duplicate", f"{path}: two messages share the {field_name} {duplicates[0]}")
    pgns = Counter(pgn_key(m.key) for m in messages if m.by_pgn)
    return Database(
        path,
        MappingProxyType({m.name: m for m in messages}),
        MappingProxyType({m.key: m for m in messages}),
        # two layouts for one PGN differ by source address, so only the exact identifier can tell them apart
        MappingProxyType({k: m for m in messages if m.by_pgn and pgns[k := pgn_key(m.key)] == 1}),
    )


def _is_j1939(database: Any) -> bool:
    """Tell whether a database is of J1939 as a whole: it says so, and not of each message with ``VFrameFormat``."""
    if database.dbc is None:  # a KCD
        return False
    given, known = database.dbc.attributes, database.dbc.attribute_definitions
    protocol = given.get("ProtocolType") or known.get("ProtocolType")
    value = "" if protocol is None else getattr(protocol, "value", None) or getattr(protocol, "default_value", "")
    return "VFrameFormat" not in known and str(value).upper() == "J1939"


def usable(message: Any, path: Path) -> MessageCodec:
    """Compile as `compile_one`, also for numbers that cantools accepts but no codec can use (infinite scale)."""
    try:
        return compile_one(message, path)
    except ConfigError:
        raise
    except (ArithmeticError, ValueError, TypeError, SyntaxError, MemoryError, RecursionError) as error:
        raise ConfigError("dbc.invalid", f"{path}: message {message.name} cannot be used: {error}") from error


def parse(path: Path, *, strict: bool = True) -> Any:
    """Read the cantools database of a file; raises ConfigError, with the line if known."""
    import cantools
    from cantools.database.errors import Error

    kind = path.suffix.lower().removeprefix(".")
    if kind not in ("dbc", "kcd"):
        raise ConfigError("dbc.wrong-suffix", f"{path}: not a .dbc or .kcd file")
    try:
        text = "\n".join(re.split("\r\n?|\n", decoded(path.read_bytes(), "cp1252" if kind == "dbc" else "utf-8")))
        return cantools.database.load_string(text, database_format=kind, strict=strict)
    except (OSError, UnicodeError) as error:
        raise ConfigError("dbc.unreadable", f"{path}: cannot be read: {error}") from error
    except (
        Error,
        ValueError,
        LookupError,
        TypeError,
        SyntaxError,
        AttributeError,
        ArithmeticError,
        AssertionError,
        MemoryError,
        RecursionError,
    ) as error:
        reason = re.sub(r"^(DBC|KCD): ", "", str(error)).strip('"') or type(error).__name__
        raise ConfigError("dbc.invalid", f"{path}{_line_of(reason, text)}: {reason}") from error


def _line_of(reason: str, text: str) -> str:
    """Write ``:line`` of a cantools error: the line it gives, or that of the message it names."""
    given = re.search(r"line (\d+)", reason)
    if given:
        return f":{given[1]}"
    named = re.search(r"in message (\w+)", reason)
    if named:
        for number, line in enumerate(text.splitlines(), 1):
            if re.search(rf"(BO_ \d+ |name=\"){named[1]}\b", line):
                return f":{number}"
    return ""


def compile_one(message: Any, path: Path) -> MessageCodec:
    """Compile the codec of one cantools message; ``path`` is named in errors."""
    if not message.name or not all(signal.name for signal in message.signals):  # possible in KCD
        subject = f"message {message.name} has a signal" if message.name else f"message {message.frame_id:#x} is"
        raise ConfigError("dbc.invalid", f"{path}: {subject} without a name")
    signals = _signals(message)
    for s in signals:
        if s.shift < 0 or s.shift + s.bits > 8 * message.length:
            raise ConfigError("dbc.invalid", f"{path}: the signal {s.name} does not fit in message {message.name}")
    decode, receive, encode, source = compile_message(message.name, message.length, signals)
    attributes = {k: a.value for k, a in message.dbc.attributes.items()} if message.dbc else {}
    return MessageCodec(
        name=message.name,
        key=message.frame_id | (EXTENDED if message.is_extended_frame else 0),
        length=message.length,
        cycle_time_ns=int(message.cycle_time or 0) * 1_000_000,
        timeout_ns=int(attributes.get("TimeoutMs", 0)) * 1_000_000,
        signals=signals,
        senders=tuple(message.senders),
        comment=message.comment or "",
        data_ids=_data_ids(message.name, attributes, path),
        by_pgn=message.protocol == "j1939",
        decode=decode,
        receive=receive,
        encode=encode,
        index=MappingProxyType({s.name: i for i, s in enumerate(signals)}),
        source=source,
    )


def _data_ids(name: str, attributes: Mapping[str, Any], path: Path) -> bytes | None:
    if not attributes.get("E2EProfile"):
        return None
    try:
        ids = bytes.fromhex(str(attributes.get("E2EDataIds", "")))
    except ValueError:
        ids = b""
    if len(ids) != 16:
        raise ConfigError("dbc.data-ids", f"{path}: {name} needs 16 hexadecimal Data IDs in E2EDataIds")
    return ids


def _signals(message: Any) -> tuple[SignalInfo, ...]:
    """List the signals in cantools' order (by start bit), with multiplexers as indices into the result."""
    positions = {s.name: i for i, s in enumerate(message.signals) if s.is_multiplexer}
    result = []
    for s in message.signals:
        network = 8 * (s.start // 8) + 7 - s.start % 8
        attributes = {k: a.value for k, a in s.dbc.attributes.items()} if s.dbc else {}
        result.append(
            SignalInfo(
                name=s.name,
                unit=s.unit or "",
                minimum=s.minimum,
                maximum=s.maximum,
                scale=s.conversion.scale,
                offset=s.conversion.offset,
                policy=Policy.SATURATE if attributes.get("OutOfRange") in (1, "saturate") else Policy.REFUSE,
                choices=MappingProxyType({int(k): str(v) for k, v in (s.choices or {}).items()}),
                comment=s.comment or "",
                bits=s.length,
                shift=8 * message.length - network - s.length if s.byte_order == "big_endian" else s.start,
                big_endian=s.byte_order == "big_endian",
                signed=s.is_signed,
                is_float=s.conversion.is_float,
                is_multiplexer=s.is_multiplexer,
                parent=None if s.multiplexer_signal is None else positions[s.multiplexer_signal],
                parent_ids=frozenset(s.multiplexer_ids or ()),
            )
        )
    return tuple(result)
