"""An order: one fault at one moment of a run, written ``NAME[:WORD][/PART][@START][+DURATION][=SIZE]``."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from typing import Final

from hil.faults.table import FAULTS, JOINT_NAMES, POSITIONS, PROCESSES, Part, find
from machine.crane_nodes import CraneNode
from runtime.errors import InputRefused

FOREVER_S: Final = math.inf
_TEXT: Final = re.compile(
    r"(?P<name>[a-z0-9-]+)(:(?P<word>[a-z]+))?(/(?P<part>[A-Za-z0-9_-]+))?(@(?P<at>[0-9.]+)s?)?"
    r"(\+(?P<length>[0-9.]+)(?P<unit>ms|s)?)?(=(?P<size>-?[0-9.]+))?"
)
_JOINT_ALIASES: Final = {f"q{i + 1}": name for i, name in enumerate(JOINT_NAMES)} | {"artic": "articulation"}


@dataclass(frozen=True, slots=True)
class Order:
    """One fault: from ``at_s`` of the run for ``length_s``, on ``part``, of ``size``; ``seed`` for what it draws."""

    fault: str
    part: str = ""
    at_s: float = 0.0
    length_s: float = FOREVER_S
    size: float = math.nan
    seed: int = 0

    def sized(self) -> float:
        """The size, or the fault's default."""
        return FAULTS[self.fault].size if math.isnan(self.size) else self.size


def make(
    name: str,
    word: str = "",
    part: str = "",
    at_s: float = 0.0,
    length_s: float = FOREVER_S,
    size: float = math.nan,
    seed: int = 0,
) -> Order:
    """An order from a person's words; a part that is left out is the fault's default.

    Raises:
        InputRefused: there is no such fault, or the part does not suit it.
    """
    fault, named = find(name, word)
    kind = FAULTS[fault]
    chosen = _JOINT_ALIASES.get(part or named, part or named) or kind.default_part
    _check_part(fault, kind.part, chosen)
    if not (math.isfinite(at_s) and at_s >= 0.0 and length_s > 0.0):
        raise InputRefused(
            "fault.time", f"{fault} at {at_s:g} s for {length_s:g} s: give a time of 0 or more, and a length"
        )
    return Order(fault, chosen, at_s, length_s, size, seed)


def parse(text: str, seed: int = 0) -> Order:
    """An order from its text, as in ``encoder-lift:stuck@12.3s+500ms``.

    Raises:
        InputRefused: the text is not an order.
    """
    found = _TEXT.fullmatch(text)
    if found is None:
        raise InputRefused(
            "fault.syntax",
            f"{text!r} is not NAME[:WORD][/PART][@START][+DURATION][=SIZE], as in encoder-lift:stuck@12.3s",
        )
    try:
        at_s = float(found["at"] or 0.0)
        length_s = float(found["length"]) * (1e-3 if found["unit"] == "ms" else 1.0) if found["length"] else FOREVER_S
        size = float(found["size"]) if found["size"] else math.nan
    except ValueError:
        raise InputRefused("fault.syntax", f"{text!r}: a number in it has two decimal points") from None
    return make(found["name"], found["word"] or "", found["part"] or "", at_s, length_s, size, seed)


def _check_part(fault: str, kind: Part, part: str) -> None:
    nodes = tuple(n.name.lower().replace("_", "-") for n in CraneNode)
    known = {
        Part.JOINT: (*JOINT_NAMES, "grapple", "articulation", "steer"),
        Part.NODE: nodes,
        Part.PROCESS: PROCESSES,
        Part.BUS: ("crane0", "mach0"),
        Part.POSITION: POSITIONS,
    }.get(kind)
    if kind is Part.NOTHING and part:
        raise InputRefused("fault.part", f"{fault} acts on the whole of its component; leave {part!r} out")
    if known is not None and part not in known:
        raise InputRefused("fault.part", f"{fault}: there is no {kind} {part!r}, only {', '.join(known)}")
