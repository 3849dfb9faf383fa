"""Every fault that can be injected, by name, with PX4's word for it and what it needs.

PX4's words (docs.px4.io, "System Failure Injection") are kept unchanged: off, stuck, garbage, wrong, slow, delayed,
intermittent.  A fault is found by its name (`encoder-stuck`) or by component and word (`encoder-lift stuck`).  One row
here is one fault; what it does is in `sim.plant_faults` (the machine), `hil.wire.faults` (the bus),
`hil.faults.injector` (the planner's datagrams) and `hil.faults.injector` (processes).
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from enum import StrEnum
from typing import Final

from can_dbc.messages.crane import ModeSwitch
from machine.crane_nodes import CraneNode
from machine.joints import JOINTS
from runtime.errors import InputRefused

JOINT_NAMES: Final = tuple(j.name.lower() for j in JOINTS)


class Word(StrEnum):
    """PX4's words for what is wrong with a component."""

    OFF = "off"
    STUCK = "stuck"
    GARBAGE = "garbage"
    WRONG = "wrong"
    SLOW = "slow"
    DELAYED = "delayed"
    INTERMITTENT = "intermittent"


class Edge(StrEnum):
    """Where a fault acts."""

    PLANT = "plant"
    BUS = "bus"
    PLANNER = "planner"
    PROCESS = "process"
    LINK = "link"
    """The Ethernet cable of a PLC."""
    OPERATOR = "operator"
    """The link of the operator who watches."""


class Part(StrEnum):
    """What the part of an order names."""

    NOTHING = ""
    JOINT = "joint"
    MESSAGE = "message"
    NODE = "node"
    BUS = "bus"
    PROCESS = "process"
    POSITION = "position"


@dataclass(frozen=True, slots=True)
class FaultKind:
    """One row: component and word, the edge, what its part names with a default, its size with unit and default, and
    whether `timberhand inject` can do it in a live run ("": it can, else the reason).
    """

    component: str
    word: Word
    edge: Edge
    summary: str
    part: Part = Part.NOTHING
    default_part: str = ""
    unit: str = ""
    size: float = 0.0
    not_live: str = ""


_VIRTUAL: Final = "only a virtual bus can do this; on a real bus disturb the cable itself"
_WORKS_ALONE: Final = "a live planner cannot be made to send this; in lockstep it can"
_P, _B, _U, _S = Edge.PLANT, Edge.BUS, Edge.PLANNER, Edge.PROCESS
_J, _M, _N = Part.JOINT, Part.MESSAGE, Part.NODE

FAULTS: Final[dict[str, FaultKind]] = {
    "encoder-stuck": FaultKind("encoder", Word.STUCK, _P, "repeats its last position, time stamp runs", _J, "lift"),
    "encoder-jump": FaultKind("encoder", Word.WRONG, _P, "reads an offset", _J, "lift", "rad or m", 0.2),
    "encoder-drift": FaultKind("encoder", Word.WRONG, _P, "drifts away", _J, "lift", "rad/s or m/s", 0.0087),
    "encoder-noise": FaultKind("encoder", Word.GARBAGE, _P, "noise grows by a factor", _J, "lift", "factor", 10.0),
    "encoder-scale": FaultKind("encoder", Word.WRONG, _P, "wrong scale; below 0: reversed", _J, "lift", "factor", -1.0),
    "encoder-identity": FaultKind("encoder", Word.WRONG, _P, "is another device, from its next boot on", _J, "lift"),
    "message-off": FaultKind("message", Word.OFF, _P, "is never sent", _M, "EncLift"),
    "message-stuck": FaultKind("message", Word.STUCK, _P, "the same frame again and again", _M, "ValveFbA"),
    "message-garbage": FaultKind("message", Word.GARBAGE, _P, "random bytes", _M, "ValveFbA"),
    "message-intermittent": FaultKind("message", Word.INTERMITTENT, _P, "is lost often", _M, "EncLift", "share", 0.5),
    "message-slow": FaultKind("message", Word.SLOW, _P, "only every n-th is sent", _M, "EncLift", "n", 4.0),
    "message-delayed": FaultKind("message", Word.DELAYED, _P, "is sent late", _M, "EncLift", "ms", 20.0),
    "message-masquerade": FaultKind("message", Word.WRONG, _P, "right checksum, wrong Data ID", _M, "ValveFbA"),
    "valve-stuck": FaultKind("valve", Word.STUCK, _P, "the spool stays where it is put", _J, "lift", "-1..1", 0.0),
    "valve-drift": FaultKind("valve", Word.WRONG, _P, "the spool is off its command", _J, "lift", "-1..1", 0.4),
    "valve-gain": FaultKind("valve", Word.SLOW, _P, "the spool moves by a share", _J, "lift", "factor", 0.5),
    "hose-burst": FaultKind("hose", Word.OFF, _P, "the loaded chamber loses its oil", _J, "lift"),
    "load-overload": FaultKind("load", Word.WRONG, _P, "a mass hangs on the rotator", Part.NOTHING, "", "kg", 800.0),
    "ground-tilt": FaultKind("ground", Word.WRONG, _P, "the machine rolls", Part.NOTHING, "", "rad", 0.45),
    "node-reset": FaultKind("node", Word.OFF, _P, "resets and boots", _N, "valves"),
    "estop-pressed": FaultKind("estop", Word.OFF, _P, "the button is pressed"),
    "estop-wire": FaultKind("estop", Word.WRONG, _P, "the wire of one contact breaks"),
    "person-in-zone": FaultKind("person", Word.WRONG, _P, "the safety module sees a person"),
    "lever-moved": FaultKind("lever", Word.WRONG, _P, "a person moves a hand lever"),
    "mode-switch": FaultKind("mode", Word.WRONG, _P, "the operator turns it", Part.POSITION, "idle"),
    "gnss-off": FaultKind("gnss", Word.OFF, _P, "sends nothing"),
    "gnss-jump": FaultKind("gnss", Word.WRONG, _P, "the position jumps", Part.NOTHING, "", "m", 3.0),
    "gnss-single": FaultKind("gnss", Word.GARBAGE, _P, "from RTK to a single fix"),
    "heading-flip": FaultKind("heading", Word.WRONG, _P, "turned by 180 degrees"),
    "heading-stuck": FaultKind("heading", Word.STUCK, _P, "does not change"),
    "bus-drop": FaultKind("frame", Word.INTERMITTENT, _B, "a message is lost", _M, "EncLift", "share", 1.0),
    "bus-corrupt": FaultKind("frame", Word.GARBAGE, _B, "two bits flip, undetected by CAN", _M, "ValveFbA"),
    "bus-repeat": FaultKind("frame", Word.STUCK, _B, "a message arrives twice", _M, "ValveFbA", "ms", 1.0),
    "bus-babble": FaultKind("bus", Word.GARBAGE, _B, "a node fills the bus", Part.BUS, "crane0"),
    "bus-cut": FaultKind("bus", Word.OFF, _B, "the cable is open", Part.BUS, "crane0"),
    "bus-stub": FaultKind("bus", Word.STUCK, _B, "the controller's stub is open", Part.BUS, "crane0"),
    "bus-errors": FaultKind("bus", Word.INTERMITTENT, _B, "our frames fail", Part.BUS, "crane0", "share", 1.0),
    "bus-foreign": FaultKind("bus", Word.WRONG, _B, "another controller sends commands", Part.BUS, "crane0"),
    "planner-off": FaultKind("planner", Word.OFF, _U, "sends nothing"),
    "planner-nan": FaultKind("planner", Word.WRONG, _U, "values that are no numbers", not_live=_WORKS_ALONE),
    "planner-range": FaultKind("planner", Word.WRONG, _U, "goals out of range", not_live=_WORKS_ALONE),
    "planner-speed": FaultKind("planner", Word.WRONG, _U, "too fast", not_live=_WORKS_ALONE),
    "planner-jump": FaultKind("planner", Word.WRONG, _U, "a step in the reference", not_live=_WORKS_ALONE),
    "planner-replay": FaultKind("planner", Word.STUCK, _U, "the same datagram again"),
    "planner-future": FaultKind("planner", Word.WRONG, _U, "future stamp", unit="ms", size=500, not_live=_WORKS_ALONE),
    "planner-delayed": FaultKind("planner", Word.DELAYED, _U, "late", unit="ms", size=150.0, not_live=_WORKS_ALONE),
    "planner-garbage": FaultKind("planner", Word.GARBAGE, _U, "damaged datagrams"),
    "planner-arms": FaultKind("planner", Word.WRONG, _U, "forged ARM and RESET of an operator"),
    "operator-off": FaultKind(
        "operator", Word.OFF, Edge.OPERATOR, "link is cut", not_live="cut the network of the browser that watches"
    ),
    "plc-off": FaultKind("plc", Word.OFF, Edge.LINK, "cable is open", not_live="pull its cable or end its process"),
    "process-off": FaultKind("process", Word.OFF, _S, "is killed", Part.PROCESS, "planner"),
    "process-stuck": FaultKind("process", Word.STUCK, _S, "does not run for a while", Part.PROCESS, "controller"),
}
PROCESSES: Final = ("controller", "guard", "planner")
POSITIONS: Final = tuple(switch.name.lower().replace("_", "-") for switch in ModeSwitch)
"""Of the operator's mode switch."""


def find(name: str, word: str = "") -> tuple[str, str]:
    """Find the fault and the part that a person means: ``encoder-stuck``, or ``encoder-lift`` with the word ``stuck``.

    Raises:
        InputRefused: there is no such fault.
    """
    if not word:
        if name in FAULTS:
            return name, ""
        raise InputRefused(
            "fault.unknown", f"there is no fault {name!r}; `timberhand inject --list` shows all names and words"
        )
    component, _, part = name.partition("-")
    for fault, kind in FAULTS.items():
        if kind.component == component and kind.word == word:
            return fault, part
    fault_words = sorted({k.word.value for k in FAULTS.values() if k.component == component})
    known = f"it has {', '.join(fault_words)}" if fault_words else "see `timberhand inject --list`"
    raise InputRefused("fault.unknown-word", f"{component} has no fault {word!r}; {known}")


# -- An order: one fault at one moment of a run, written ``NAME[:WORD][/PART][@START][+DURATION][=SIZE]``.

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
        """Return the size, or the fault's default."""
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
    """Make an order from a person's words; a part that is left out is the fault's default.

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
    """Parse the text of an order, as in ``encoder-lift:stuck@12.3s+500ms``.

    Raises:
        InputRefused: the text is not an order.
    """
    order_match = _TEXT.fullmatch(text)
    if order_match is None:
        raise InputRefused(
            "fault.syntax",
            f"{text!r} is not NAME[:WORD][/PART][@START][+DURATION][=SIZE], as in encoder-lift:stuck@12.3s",
        )
    try:
        at_s = float(order_match["at"] or 0.0)
        length_s = (
            float(order_match["length"]) * (1e-3 if order_match["unit"] == "ms" else 1.0)
            if order_match["length"]
            else FOREVER_S
        )
        size = float(order_match["size"]) if order_match["size"] else math.nan
    except ValueError:
        raise InputRefused("fault.syntax", f"{text!r}: a number in it has two decimal points") from None
    return make(order_match["name"], order_match["word"] or "", order_match["part"] or "", at_s, length_s, size, seed)


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
