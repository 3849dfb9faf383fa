"""One signal of a DBC: the place of its bits, their meaning, and the exact conversion in both directions.

This is the reference for the generated code of ``codegen``.  Conversions repeat cantools' floating-point expressions
term by term, so that results are equal bit for bit.  Encoding never wraps: a value that is not finite, or out of range
with the policy *refuse*, raises ``InputRefused``; *saturate* takes the nearest valid value.  A raw value that the
value table labels ``NotAvailable`` or ``Error`` is not a measurement: ``valid`` turns it into None, and encoding None
writes the raw value labelled ``NotAvailable``.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum, StrEnum
from typing import Final

from runtime.errors import InputRefused

Value = int | float | None
FLOAT_FORMATS: Final = {16: "<e", 32: "<f", 64: "<d"}
FLOAT_MAX: Final = {16: 65504.0, 32: 3.4028234663852886e38, 64: 1.7976931348623157e308}
NOT_AVAILABLE: Final = "NotAvailable"
ERROR: Final = "Error"


class Refusal(StrEnum):
    """Why a received frame is refused as a whole."""

    LENGTH = "wrong length"
    RANGE = "value out of range"
    MULTIPLEXER = "unknown multiplexer value"


class FrameRefused(ValueError):
    """A received frame must not be used; ``reason`` says why, ``where`` names the message or signal."""

    def __init__(self, reason: Refusal, where: str) -> None:
        super().__init__(f"{where}: {reason.value}")
        self.reason = reason
        self.where = where


class Policy(StrEnum):
    """What encoding does with a finite value outside the signal's range."""

    REFUSE = "refuse"
    SATURATE = "saturate"


class Scaling(Enum):
    """The three conversions cantools distinguishes; they differ in rounding and in the type of the result."""

    IDENTITY = 0
    INTEGER = 1
    LINEAR = 2


@dataclass(frozen=True, slots=True)
class SignalInfo:
    """A compiled signal.

    ``minimum`` and ``maximum`` are physical, None if the DBC gives none.  ``shift`` counts from the least significant
    bit of the payload read as one little-endian (or, with ``big_endian``, big-endian) number.  ``parent`` is the index
    of the multiplexer and ``parent_ids`` its values for which this signal is present.  Derived: ``raw_min`` and
    ``raw_max`` are the limits of the bits, ``raw_low`` and ``raw_high`` those of the declared range, ``sentinels`` the
    raw values that mean "no measurement", ``not_available`` the one that encoding None writes.
    """

    name: str
    unit: str
    minimum: float | None
    maximum: float | None
    scale: float
    offset: float
    policy: Policy
    choices: Mapping[int, str]
    comment: str
    bits: int
    shift: int
    big_endian: bool
    signed: bool
    is_float: bool
    is_multiplexer: bool = False
    parent: int | None = None
    parent_ids: frozenset[int] = frozenset()

    scaling: Scaling = field(init=False)
    raw_min: int = field(init=False)
    raw_max: int = field(init=False)
    raw_low: int = field(init=False)
    raw_high: int = field(init=False)
    sentinels: frozenset[int] = field(init=False)
    not_available: int | None = field(init=False)

    def __post_init__(self) -> None:
        sentinels = {raw: label for raw, label in self.choices.items() if label in (NOT_AVAILABLE, ERROR)}
        whole = float(self.scale).is_integer() and float(self.offset).is_integer() and not self.is_float
        identity = self.scale == 1 and self.offset == 0
        derived = {
            "scaling": Scaling.IDENTITY if identity else Scaling.INTEGER if whole else Scaling.LINEAR,
            "raw_min": -(1 << self.bits - 1) if self.signed else 0,
            "raw_max": (1 << self.bits - int(self.signed)) - 1,
            "sentinels": frozenset(sentinels),
            "not_available": next((raw for raw, label in sentinels.items() if label == NOT_AVAILABLE), None),
        }
        for name, value in derived.items():
            object.__setattr__(self, name, value)
        for name, limit in zip(("raw_low", "raw_high"), self._raw_bounds(), strict=True):
            object.__setattr__(self, name, limit)

    def physical(self, raw: int | float) -> int | float:
        """Convert a raw to a physical value [unit], as cantools computes it."""
        if self.scaling is Scaling.IDENTITY:
            return raw
        if self.scaling is Scaling.INTEGER:
            return raw * int(self.scale) + int(self.offset)
        return raw * self.scale + self.offset

    def convert(self, value: int | float) -> int | float:
        """Convert a physical to a raw value without any check; integers round half to even."""
        if self.scaling is Scaling.IDENTITY:
            return value if self.is_float else round(value)
        if self.scaling is Scaling.INTEGER:
            return integer_raw(value - int(self.offset), int(self.scale))
        raw = (value - self.offset) / self.scale
        return raw if self.is_float else round(raw)

    def inside(self, value: int | float) -> bool:
        """Tell whether a physical value lies in the declared range, with cantools' tolerance of 1e-6 steps."""
        tolerance = abs(self.scale) * 1e-6
        return (self.minimum is None or value >= self.minimum - tolerance) and (
            self.maximum is None or value <= self.maximum + tolerance
        )

    def valid(self, raw: int | float) -> Value:
        """Return the physical value of a received raw value, None for a sentinel; FrameRefused if out of range."""
        if raw in self.sentinels:
            return None
        value = self.physical(raw)
        good = math.isfinite(raw) and self.inside(value) if self.is_float else self.raw_low <= raw <= self.raw_high
        if good or raw in self.choices:
            return value
        raise FrameRefused(Refusal.RANGE, self.name)

    def encode(self, value: Value) -> int:
        """Encode a physical value or None as bits (unsigned, ``bits`` wide); raises InputRefused."""
        if value is None:
            raw: int | float | None = self.not_available
            if raw is None:
                raise InputRefused("codec.no-not-available", f"{self.name} has no raw value for 'not available'")
            return self._pack(raw)
        if not isinstance(value, (int, float)) or (isinstance(value, float) and not math.isfinite(value)):
            raise InputRefused("codec.not-finite", f"{self.name} = {value!r} is not a finite number")
        try:
            raw = self.convert(value)
            if not self.inside(value) and (raw not in self.choices or raw in self.sentinels):
                if self.policy is Policy.REFUSE:
                    raise InputRefused("codec.out-of-range", f"{self.name} = {value} is outside {self._limits()}")
                raw = self.convert(self._clamped(value))
            if not self.is_float and not self.raw_min <= raw <= self.raw_max:
                if self.policy is Policy.REFUSE:
                    raise InputRefused("codec.does-not-fit", f"{self.name} = {value} does not fit in {self.bits} bits")
                raw = min(max(raw, self.raw_min), self.raw_max)
            return self._pack(raw)
        except OverflowError:
            raise InputRefused(
                "codec.does-not-fit", f"{self.name} = {value} does not fit in {self.bits} bits"
            ) from None

    def extract(self, little: int, big: int) -> int | float:
        """Extract the raw value from the payload read as a little-endian and as a big-endian number."""
        bits = (big if self.big_endian else little) >> self.shift & ((1 << self.bits) - 1)
        if self.is_float:
            return unpack_float(bits, self.bits)
        return bits - (1 << self.bits) if self.signed and bits >> self.bits - 1 else bits

    def _pack(self, raw: int | float) -> int:
        if self.is_float:
            return pack_float(raw, self.bits)
        return int(raw) & ((1 << self.bits) - 1)

    def _clamped(self, value: float) -> float:
        low = value if self.minimum is None else max(value, self.minimum)
        return low if self.maximum is None else min(low, self.maximum)

    def _limits(self) -> str:
        unit = f" {self.unit}" if self.unit else ""
        return f"{self.minimum} to {self.maximum}{unit}"

    def _raw_bounds(self) -> tuple[int, int]:
        ends = [
            self.convert(limit) if limit is not None else None
            for limit in ((self.minimum, self.maximum) if self.scale > 0 else (self.maximum, self.minimum))
        ]
        low = self.raw_min if ends[0] is None else max(int(ends[0]), self.raw_min)
        high = self.raw_max if ends[1] is None else min(int(ends[1]), self.raw_max)
        return low, high


def integer_raw(value: int | float, scale: int) -> int:
    """Compute ``value / scale`` rounded half to even; exact for integers of any size."""
    quotient, remainder = divmod(value, scale)
    return round(quotient if remainder == 0 else value / scale)


def pack_float(value: float, bits: int) -> int:
    """Return the IEEE 754 bits of a number; raises OverflowError if it is too large for the width."""
    return int.from_bytes(struct.pack(FLOAT_FORMATS[bits], value), "little")


def unpack_float(raw: int, bits: int) -> float:
    """Return the number of IEEE 754 bits."""
    value: float = struct.unpack(FLOAT_FORMATS[bits], raw.to_bytes(bits // 8, "little"))[0]
    return value
