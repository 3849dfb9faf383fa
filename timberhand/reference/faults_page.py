"""Every reason of the controller: number, reaction, detection bound, sentence, remedy."""

from __future__ import annotations

from machine.status.faults import FAULTS
from timberhand.reference.markdown import generated, table


def page() -> str:
    """docs/reference/faults.md."""
    rows = (
        (
            int(reason), f"`{reason.name}`", fault.reaction.name.lower(), fault.bound_ms or "at once",
            fault.sentence.format("*the part*"), fault.advice,
        )
        for reason, fault in sorted(FAULTS.items())
    )  # fmt: skip
    head = generated(
        "Faults and refusals",
        "`machine.status.faults.FAULTS`",
        "Every reason that the controller gives. The number travels in `CtrlStatus.Reason` and in state reports; the\n"
        "console, the terminal and the recording show the sentence. [safety.md](safety.md), section 4, explains the\n"
        "reactions. The bound is the time from the fault to its detection.",
    )
    return head + "\n" + table(("no.", "reason", "reaction", "bound [ms]", "what it says", "what to do"), rows) + "\n"
