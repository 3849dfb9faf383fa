"""What the controller's tables say: its reasons, its modes, and the texts of ``journalctl -x`` about a stop."""

from __future__ import annotations

from controller.transitions import TRANSITIONS, Event
from machine.status.evidence import EVIDENCE
from machine.status.explanation import message_id
from machine.status.faults import FAULTS
from machine.status.modes import Mode
from machine.status.reasons import Fault, Reaction, Reason
from timberhand.reference.markdown import generated, table


def faults() -> str:
    """docs/reference/faults.md."""
    rows = (
        (
            int(reason),
            f"`{reason.name}`",
            fault.reaction.name.lower(),
            fault.bound_ms or "at once",
            fault.sentence.format("*the part*"),
            fault.advice,
            _measured(reason),
        )
        for reason, fault in sorted(FAULTS.items())
    )
    head = generated(
        "Faults and refusals",
        "`machine.status.faults.FAULTS` and `machine.status.evidence.EVIDENCE`",
        "Every reason that the controller gives. The number travels in `CtrlStatus.Reason` and in state reports; the\n"
        "console, the terminal, the journal and the recording show the sentence with the numbers in the last column.\n"
        "[safety.md](safety.md), section 4, explains the reactions. The bound is the time from the fault to its\n"
        "detection. [Why it stopped](../how-to/why-it-stopped.md) shows a stop with all of this.",
    )
    names = ("no.", "reason", "reaction", "bound [ms]", "what it says", "what to do", "numbers")
    return head + "\n" + table(names, rows) + "\n"


def _measured(reason: Reason) -> str:
    """Names of the numbers; the unit of a joint's is that of the joint."""
    found = EVIDENCE.get(reason)
    return "" if found is None else ", ".join(name for name in (found.signal, found.limit, found.other) if name)


def transitions() -> str:
    """docs/reference/transitions.md."""
    events = [event for event in Event if any(known is event for _, known in TRANSITIONS)]
    rows = (
        (
            f"**{mode.name}**",
            *(f"{TRANSITIONS[mode, event].name}" if (mode, event) in TRANSITIONS else "" for event in events),
        )
        for mode in Mode
    )
    head = generated(
        "Modes and transitions",
        "`controller.transitions.TRANSITIONS`",
        "Rows are modes, columns events; a cell is the mode that follows, and an empty cell changes nothing. Only a\n"
        "person's ARM leads from STANDBY or STOP to ARMED. Valves move in ACTIVE, and while a stop ramps down.",
    )
    return head + "\n" + table(("mode", *(event.name for event in events)), rows) + "\n"


def catalog() -> str:
    """deploy/system/timberhand.catalog; the fields in ``@`` are those of `recorder.journal.stop_fields`."""
    head = "# generated from `machine.status.faults.FAULTS` by `python -m timberhand.reference`; do not edit\n"
    stops = (entry for entry in sorted(FAULTS.items()) if entry[1].reaction >= Reaction.HOLD)
    return head + "".join(_entry(reason, fault) for reason, fault in stops)


def _entry(reason: Reason, fault: Fault) -> str:
    sentence = fault.sentence.format("@TIMBERHAND_PART@")
    return f"""
-- {message_id(reason)}
Subject: {reason.name}: {sentence}
Defined-By: timberhand

{sentence}.
The mode changed from @TIMBERHAND_MODE_BEFORE@ to @TIMBERHAND_MODE@.
Measured: @TIMBERHAND_MEASURED@.

What to do: {fault.advice}

What happened around the stop: timberhand why @TIMBERHAND_FILE@
"""
