"""Writes the generated reference pages, the README's table of results and the journal's catalog.

Commands, error codes and CAN frames change with every second commit and are not committed: `docs/conf.py` writes them
whenever the site is built.  The others are read in review.  With ``--check`` it only says which of those are stale.

Exit codes: 0 fine, 2 usage, 6 a page is stale (``--check``).
"""

from __future__ import annotations

import argparse
import ast
import html
import re
import sys
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, Final

from can_dbc.dbc.codec import Database, MessageCodec, load
from can_dbc.frame import EXTENDED
from controller.transitions import TRANSITIONS, Event
from experiments.common import overview
from experiments.common.registry import EXPERIMENTS
from experiments.common.standing import has_history, judge
from host.exit_codes import ExitCode
from machine.status.evidence import EVIDENCE
from machine.status.explanation import message_id
from machine.status.faults import FAULTS
from machine.status.modes import Mode
from machine.status.reasons import Fault, Reaction, Reason

# -- Small parts of generated Markdown.


def table(head: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """Write a table; bars in cells are escaped."""

    def line(cells: Sequence[object]) -> str:
        return "| " + " | ".join(str(cell).replace("|", "\\|").replace("\n", " ") for cell in cells) + " |"

    return "\n".join([line(head), "|" + "---|" * len(head), *map(line, rows)])


def generated(title: str, source: str, introduction: str) -> str:
    """Write the head of a generated page: title, where it comes from, what it says."""
    return (
        f"# {title}\n\n<!-- generated from {source} by `python -m timberhand.reference`; do not edit -->\n\n"
        f"{introduction}\n"
    )


# -- Every command with its options, as ``--help`` prints them.


def cli_page() -> str:
    """Return the text of docs/reference/cli.md."""
    from typer.cli import get_docs_for_click
    from typer.main import get_command

    from timberhand.cli import app

    command = get_command(app)
    _show_whole_sentences(command)
    made: Any = command.make_context("timberhand", [], resilient_parsing=True)
    with made as context:
        text = get_docs_for_click(obj=command, ctx=context, name="timberhand", title="x")
    text = html.unescape(re.sub(r"</?span[^>]*>", "", text)).split("\n", 1)[1]
    # Examples are lines indented by two blanks: without a fence Markdown would join them.
    text = re.sub(r"(?m)(?:^  timberhand.*(?:\n\n?|$))+", lambda found: _fenced(found[0]), text)
    # Typer's help says `<int>` outside code in places; that would be HTML.
    text = re.sub(r"(?m)^\* (`[^`]*`)", r"* \1", text)
    head = generated(
        "Command line",
        "the commands of `timberhand`",
        "Every command and option, as `--help` prints them.",
    )
    return head + re.sub(r"\n{3,}", "\n\n", text).rstrip() + "\n"


def _show_whole_sentences(command: Any) -> None:
    """Let lists of commands show the first sentence of their help; Click would cut it at 45 characters."""
    for sub in getattr(command, "commands", {}).values():
        if sub.help and not sub.short_help:
            sub.short_help = " ".join(sub.help.split("\n\n")[0].split())
        _show_whole_sentences(sub)


def _fenced(examples: str) -> str:
    lines = [line[2:] for line in examples.split("\n") if line.strip()]
    return "```console\n" + "\n".join(lines) + "\n```\n\n"


# -- Every error code: found in the source, at the places that raise it.

PACKAGES = (
    "autonomy",
    "can_dbc",
    "console",
    "controller",
    "deploy",
    "experiments",
    "hil",
    "host",
    "machine",
    "recorder",
    "ros2",
    "runtime",
    "sim",
    "timberhand",
    "training",
)
CODE = re.compile(r"[a-z0-9]+(-[a-z0-9]+)*(\.[a-z0-9]+(-[a-z0-9]+)*)+")


def codes(repository: Path) -> dict[str, list[tuple[str, str, str]]]:
    """Map code -> (class or function that takes it, file, sentence with ``…`` for what varies) of each place."""
    occurrences: dict[str, list[tuple[str, str, str]]] = defaultdict(list)
    for package in PACKAGES:
        for path in sorted((repository / package).rglob("*.py")):
            for code, taker, sentence in _codes_of(ast.parse(path.read_text())):
                occurrences[code].append((taker, path.relative_to(repository).as_posix(), sentence))
    return dict(sorted(occurrences.items()))


def _codes_of(tree: ast.Module) -> Iterator[tuple[str, str, str]]:
    """Find calls whose first two arguments are a code and a sentence."""
    for node in ast.walk(tree):
        if not isinstance(node, ast.Call) or len(node.args) < 2:
            continue
        first = node.args[0]
        if not (isinstance(first, ast.Constant) and isinstance(first.value, str) and CODE.fullmatch(first.value)):
            continue
        taker = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
        sentence = _sentence(node.args[1])
        if sentence and (taker.endswith(("Error", "Refused", "Failed")) or taker[:1].isupper() or " " in sentence):
            yield first.value, taker, sentence


def _sentence(node: ast.expr) -> str:
    """Return the text of a string or an f-string; ``…`` stands for what is put in."""
    match node:
        case ast.Constant(value=str(text)):
            return text
        case ast.JoinedStr(values=parts):
            return "".join(_sentence(part) if isinstance(part, ast.Constant) else "…" for part in parts)
        case ast.BinOp(left=left, right=right):
            return _sentence(left) + _sentence(right)
        case _:
            return "…"


def errors_page(repository: Path) -> str:
    """Return the text of docs/reference/errors.md."""
    rows = dict.fromkeys(
        (f"`{code}`", sentence, f"`{file}`")
        for code, places in codes(repository).items()
        for _, file, sentence in places
    )
    head = generated(
        "Error codes",
        "the places that raise them",
        "An error has a sentence, which may be reworded, and a code, which is stable. The command line prints the\n"
        "code in brackets after the sentence; programs compare `error.code`. `…` stands for what varies.",
    )
    return head + "\n" + table(("code", "sentence", "raised in"), rows) + "\n"


# -- The frames of both buses, from the DBC files.

BUSES = {"crane": "crane0: CANopen and own PDOs", "machine": "mach0: J1939", "gnss": "mach0: NMEA 2000"}


def frames_page() -> str:
    """Return the text of docs/reference/frames.md."""
    head = generated(
        "CAN frames",
        "`can_dbc/*.dbc`",
        "Every message that timberhand sends or reads. *Time-out* is the age at which a value counts as unknown;\n"
        "*E2E* marks frames with CRC, counter and data ID. Why the buses look like this: [can-bus.md](can-bus.md).",
    )
    return head + "".join(_bus(title, load(name)) for name, title in BUSES.items())


def _bus(title: str, database: Database) -> str:
    messages = sorted(database.messages.values(), key=lambda message: message.key & ~EXTENDED)
    return f"\n## {title}\n" + "".join(_message(message) for message in messages)


def _message(message: MessageCodec) -> str:
    identifier = f"{message.key & ~EXTENDED:0{8 if message.key & EXTENDED else 3}X}h"
    facts = [
        f"identifier {identifier}" + (" (by PGN)" if message.by_pgn else ""),
        f"{message.length} bytes",
        f"from {', '.join(message.senders)}" if message.senders else "",
        f"every {message.cycle_time_ns // 1_000_000} ms" if message.cycle_time_ns else "",
        f"time-out {message.timeout_ns // 1_000_000} ms" if message.timeout_ns else "",
        "E2E" if message.data_ids else "",
    ]
    comment = f"{message.comment}\n\n" if message.comment else ""
    rows = (
        (
            signal.name,
            signal.bits,
            f"{signal.scale:g}",
            f"{signal.offset:g}",
            signal.unit,
            "" if signal.minimum is None else f"{signal.minimum:g} to {signal.maximum:g}",
            ", ".join(f"{raw} {label}" for raw, label in signal.choices.items()) or signal.comment,
        )
        for signal in message.signals
    )
    columns = ("signal", "bits", "scale", "offset", "unit", "range", "values or meaning")
    return f"\n### {message.name}\n\n{', '.join(filter(None, facts))}\n\n{comment}{table(columns, rows)}\n"


# -- What the controller's tables say: its reasons, its modes, and the texts of ``journalctl -x`` about a stop.


def faults() -> str:
    """Return the text of docs/reference/faults.md."""
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
    """Name the numbers; the unit of a joint's is that of the joint."""
    evidence = EVIDENCE.get(reason)
    return (
        ""
        if evidence is None
        else ", ".join(name for name in (evidence.signal, evidence.limit, evidence.other) if name)
    )


def transitions() -> str:
    """Return the text of docs/reference/transitions.md."""
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
    """Return the text of deploy/system/timberhand.catalog.

    The fields in ``@`` are those of `recorder.__main__.stop_fields`.
    """
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


# -- The table of results in the README, from the saved results.

BEGIN: Final = "<!-- results: generated by `python -m timberhand.reference` -->\n"
END: Final = "<!-- end of results -->"
SHOWN: Final = ("grasp-configs", "forwarding-mission", "log-localization", "detector", "crane-accuracy")
"""Experiments whose comparisons with the papers are in the README."""


def readme(repository: Path) -> str:
    """Return the README with its table of today; as it is where no git history says what the figures are worth."""
    text = (repository / "README.md").read_text()
    if not has_history():
        return text
    before, rest = text.split(BEGIN)
    _, after = rest.split(END)
    return f"{before}{BEGIN}\n{_table(repository / 'docs')}\n\n{END}{after}"


def _table(docs: Path) -> str:
    rows, results = [], overview.results_in(docs)
    standings = {name: judge(result.commit, EXPERIMENTS[name]).standing for name, result in results.items()}
    for entry, (question, *answers) in overview.compared(results):
        if entry.experiment in SHOWN:
            linked = f"[{question}](docs/{entry.experiment}.md)"
            rows.append((linked, *answers, standings[entry.experiment]))
    return f"{overview.summary(results, standings)}\n\n{table((*overview.COLUMNS, 'sources'), rows)}"


REPOSITORY = Path(__file__).resolve().parents[2]


BUILT: Final[dict[str, Callable[[], str]]] = {
    "docs/reference/cli.md": cli_page,
    "docs/reference/errors.md": lambda: errors_page(REPOSITORY),
    "docs/reference/frames.md": frames_page,
}
"""Pages that are not committed."""


def committed(repository: Path = REPOSITORY) -> dict[Path, str]:
    """Return the text of every generated page that is committed, by its path."""
    made = {
        "docs/reference/faults.md": faults(),
        "docs/reference/transitions.md": transitions(),
        "deploy/system/timberhand.catalog": catalog(),
        "README.md": readme(repository),
    }
    return {repository / name: text for name, text in made.items()}


def stale(made: dict[Path, str]) -> list[Path]:
    """List the pages whose text on disk is not this one."""
    return [path for path, text in made.items() if not path.is_file() or path.read_text() != text]


def write(made: dict[Path, str]) -> None:
    """Write the pages that are stale, and say which."""
    for path in stale(made):
        path.write_text(made[path])
        print(f"{path.relative_to(REPOSITORY)} written")


def write_built() -> None:
    """Write the pages that are not committed."""
    write({REPOSITORY / name: page() for name, page in BUILT.items()})


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; return the exit code."""
    parser = argparse.ArgumentParser(prog="python -m timberhand.reference", description="Generate the reference pages.")
    parser.add_argument("--check", action="store_true", help="write nothing; fail if a committed page is stale")
    options = parser.parse_args(arguments)
    if options.check:
        old = stale(committed())
        for path in old:
            print(f"{path.relative_to(REPOSITORY)} is stale; run `python -m timberhand.reference`.", file=sys.stderr)
        return ExitCode.FIGURE_MISSED if old else ExitCode.OK
    write(committed())
    write_built()
    return ExitCode.OK


if __name__ == "__main__":
    sys.exit(main())
