"""Every reason of the controller: number, reaction, detection bound, sentence, remedy, and what is measured."""

from __future__ import annotations

from machine.status.evidence import EVIDENCE
from machine.status.faults import FAULTS
from machine.status.reasons import Reason
from timberhand.reference.markdown import generated, table


def page() -> str:
    """docs/reference/faults.md."""
    rows = (
        (
            int(reason), f"`{reason.name}`", fault.reaction.name.lower(), fault.bound_ms or "at once",
            fault.sentence.format("*the part*"), fault.advice, _measured(reason),
        )
        for reason, fault in sorted(FAULTS.items())
    )  # fmt: skip
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
