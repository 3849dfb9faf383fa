"""The acceptance protocol of a machine: what a person checks, and what the checks come to.  Pure.

A protocol is accepted when a named person has passed every check; one failed check is enough to refuse it.  What the
steps of the joints showed is added by the server, never by whoever fills in the form.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Annotated, Any, Final

import msgspec

from runtime.errors import InputRefused

MAX_JSON_BYTES: Final = 65_536


class Result(StrEnum):
    """What a check came to."""

    OPEN = "open"
    PASS = "pass"
    FAIL = "fail"


class Verdict(StrEnum):
    """What a protocol comes to."""

    INCOMPLETE = "incomplete"
    ACCEPTED = "accepted"
    REFUSED = "refused"


@dataclass(frozen=True, slots=True)
class Check:
    """One line of the form: what to do, and what passes."""

    id: str
    title: str
    how: str
    value: str = ""
    """What is to be written down, with its unit; empty where nothing is."""


CHECKS: Final = (
    Check("identity", "The machine is the one of the profile", "Compare plate, profile and serial number."),
    Check(
        "estop",
        "Emergency stop",
        "Arm, then press each emergency stop: the page shows ESTOP_PRESSED, pilot supply off; it latches.",
    ),
    Check("stop", "STOP on the page", "Move a joint, press STOP on every page in use: it stops.", "ms to standstill"),
    Check("link", "Loss of the operator's link", "Armed, cut the network of the page: it holds.", "s until it holds"),
    Check(
        "controller",
        "Loss of the controller",
        "Stop the controller's service while a joint moves: neutral.",
        "s to standstill",
    ),
    Check("guard", "Loss of the guard", "Stop the guard's service: neutral, pilot supply off."),
    Check("lever", "Hand levers win", "Armed, move each hand lever: LEVER_MOVED, neutral without a ramp."),
    Check("signs", "Every joint moves the right way", "Step each joint: it goes where its sign says."),
    Check("steps", "Every joint follows its reference", "Step each joint out and back; its error is within the limit."),
    Check("zeros", "Encoder zeros", "Survey the hanger pin at three poses against the page.", "mm, largest"),
    Check("limits", "Ends of the joints", "Step towards each end: the step is refused or ends before the stop."),
    Check("load", "Load", "Lift a known mass: the page shows it.", "kg shown for kg hung"),
    Check("zone", "The zone is kept clear", "Signs, barriers and the person in charge are in place."),
)
IDS: Final = tuple(check.id for check in CHECKS)
Text = Annotated[str, msgspec.Meta(max_length=400)]
Line = Annotated[str, msgspec.Meta(max_length=80)]


class Entry(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What a person wrote for one check."""

    id: str
    result: Result = Result.OPEN
    value: Line = ""
    remark: Text = ""


class Protocol(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A form as it is filled in."""

    entries: tuple[Entry, ...]
    machine: Line = ""
    """Serial number or name of the machine."""
    inspector: Line = ""
    place: Line = ""


def read_protocol(data: bytes) -> Protocol:
    """Read the form in a document.

    Raises:
        InputRefused: it is none, or does not have every check once.
    """
    try:
        protocol = msgspec.json.decode(data, type=Protocol)
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise InputRefused("acceptance.document", f"this is no acceptance protocol: {error}") from None
    if sorted(entry.id for entry in protocol.entries) != sorted(IDS):
        sentence = f"the protocol has not every check once; it needs {', '.join(IDS)}"
        raise InputRefused("acceptance.checks", sentence)
    return protocol


def judge(protocol: Protocol) -> tuple[Verdict, list[str]]:
    """Judge what a protocol comes to, and write a sentence for each reason why it is not accepted."""
    titles = {check.id: check.title for check in CHECKS}
    failed = [f"{titles[e.id]}: failed." for e in protocol.entries if e.result is Result.FAIL]
    missing = [f"{titles[e.id]}: not checked." for e in protocol.entries if e.result is Result.OPEN]
    missing += [
        f"{field_name} is missing."
        for field_name, value in (
            ("The machine's serial number", protocol.machine),
            ("The inspector's name", protocol.inspector),
        )
        if not value.strip()
    ]
    if failed:
        return Verdict.REFUSED, failed + missing
    return (Verdict.INCOMPLETE, missing) if missing else (Verdict.ACCEPTED, [])


def document(protocol: Protocol, facts: dict[str, Any]) -> dict[str, Any]:
    """Return the protocol as it is kept: with its verdict, and ``facts`` that the server knows."""
    verdict, reasons = judge(protocol)
    contents: dict[str, Any] = msgspec.to_builtins(protocol)
    return {**facts, **contents, "verdict": verdict.value, "reasons": reasons}
