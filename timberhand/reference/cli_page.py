"""Every command with its options, as ``--help`` prints them."""

from __future__ import annotations

import html
import re
from typing import Any

from timberhand.reference.markdown import generated


def page() -> str:
    """docs/reference/cli.md."""
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
    """Lists of commands show the first sentence of their help; Click would cut it at 45 characters."""
    for sub in getattr(command, "commands", {}).values():
        if sub.help and not sub.short_help:
            sub.short_help = " ".join(sub.help.split("\n\n")[0].split())
        _show_whole_sentences(sub)


def _fenced(examples: str) -> str:
    lines = [line[2:] for line in examples.split("\n") if line.strip()]
    return "```console\n" + "\n".join(lines) + "\n```\n\n"
