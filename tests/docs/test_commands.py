"""Every command on a page exists: the real command line parses it, make has the target, Python the module."""

from __future__ import annotations

import re
import shlex
from functools import cache
from importlib.util import find_spec
from typing import Any

import click
import pytest
from typer.main import get_command

from tests.docs.pages import PAGES, ROOT, text_of
from timberhand.cli import app

FENCED = re.compile(r"(?ms)^```(?:sh|console|bash|shell)\n(.*?)^```")
INDENTED = re.compile(r"(?m)^    (?=(?:sudo |[A-Z_]+=\S+ )*(?:timberhand|make|python -m) )(.*(?:\\\n.*)*)$")
INLINE = re.compile(r"`((?:sudo )?(?:timberhand|make|python -m) [^`]+)`")
PLACEHOLDER = re.compile(r"[^a-z]*[A-Z][A-Z0-9_./:=,-]*|.*[<{\[|…].*|\.\.\.")
REDIRECTION = re.compile(r"\d?[<>]")
TARGETS = set(re.findall(r"(?m)^([a-z0-9-]+):", (ROOT / "Makefile").read_text()))


def commands(text: str) -> list[list[str]]:
    """The commands of a page to type, as words, without what stands before and behind them."""
    blocks = [m[1] for m in FENCED.finditer(text)]
    return _words(blocks + [m[1] for m in INDENTED.finditer(FENCED.sub("", text))])


def mentions(text: str) -> list[list[str]]:
    """The commands that its sentences name, perhaps without their arguments."""
    return _words([m[1].replace("\n", " ") for m in INLINE.finditer(FENCED.sub("", text))])


def _words(blocks: list[str]) -> list[list[str]]:
    found = []
    for line in "\n".join(blocks).replace("\\\n", " ").splitlines():
        for part in re.split(r"\s(?:&&|\|\|?|;|&)(?:\s|$)|\s{3,}(?![-<])", line.strip().removeprefix("$ ")):
            try:
                words = shlex.split(part, comments=True)
            except ValueError:  # a sentence with an apostrophe
                continue
            while words and (words[0] == "sudo" or re.fullmatch(r"[A-Z_]+=.*", words[0])):
                words = words[1:]
            words = [w for i, w in enumerate(words) if not (REDIRECTION.match(w) or (i and words[i - 1] in "<>>"))]
            if (words and words[0].rsplit("/", 1)[-1] in ("timberhand", "make")) or words[:2] in (["python", "-m"],):
                found.append(words)
    return found


def problem(words: list[str], mention: bool = False) -> str:
    """What is wrong with a command; empty if nothing is.  A mention may lack arguments."""
    if words[0] == "make":
        wrong = [w for w in words[1:] if "=" not in w and not w.startswith("-") and w not in TARGETS]
        return f"make has no target {wrong[0]}" if wrong and not PLACEHOLDER.fullmatch(wrong[0]) else ""
    if words[0] == "python":
        return "" if PLACEHOLDER.fullmatch(words[2]) or _has_module(words[2]) else f"there is no module {words[2]}"
    wrong = _parsed([w for w in words[1:] if not re.fullmatch(r"\.\.\.|\[.*", w)])
    return "" if mention and ("MissingParameter" in wrong or "requires an argument" in wrong) else wrong


def _has_module(name: str) -> bool:
    try:
        return find_spec(name) is not None
    except ModuleNotFoundError:
        return False


@cache
def the_command() -> Any:
    """The whole command line."""
    return get_command(app)


def _parsed(arguments: list[str]) -> str:
    """Parse the command as the command line does, and run nothing."""
    command = the_command()
    name = "timberhand"
    try:
        while True:
            context = command.make_context(name, list(arguments))
            if not hasattr(command, "resolve_command"):
                return ""
            rest = [*getattr(context, "_protected_args", []), *context.args]
            if not rest or PLACEHOLDER.fullmatch(rest[0]):
                return ""
            name, command, arguments = command.resolve_command(context, rest)
    except click.exceptions.Exit:
        return ""  # --help and --version end there
    except Exception as error:  # noqa: BLE001 - Typer vendors its own click, whose errors are others
        return _sentence(error, arguments)


def _sentence(error: Exception, arguments: list[str]) -> str:
    kind = type(error).__name__
    placeholders = any(PLACEHOLDER.fullmatch(w) for w in arguments)
    if kind in ("Exit", "NoArgsIsHelpError"):
        return ""  # the name of a command
    if kind == "BadParameter" and placeholders:
        return ""
    return f"{kind}: {getattr(error, 'message', error)}"


@pytest.mark.parametrize("page", PAGES)
def test_every_command_on_a_page_exists(page: str) -> None:
    text = text_of(page)
    # A usage line stands for every way to complete it.
    wrong = {" ".join(words): problem(words, mention="[OPTIONS]" in words) for words in commands(text)}
    wrong |= {" ".join(words): problem(words, mention=True) for words in mentions(text)}
    assert {command: why for command, why in wrong.items() if why} == {}


def test_commands_are_found_and_wrong_ones_are_noticed() -> None:
    text = (
        "```sh\ntimberhand demo --lockstep --sed 3   # words\nsudo timberhand experiment nothing\nmake all\n```\n"
        "Then `timberhand experiment NAME --docs docs` and `python -m timberhand.nowhere`.\n\n"
        "    timberhand report --check\n"
    )
    found = commands(text)
    assert [w[1] for w in found] == ["demo", "experiment", "all", "report"]
    assert [bool(problem(w)) for w in found] == [True, True, True, False]
    named = mentions(text)
    assert [w[1] for w in named] == ["experiment", "-m"]
    assert [bool(problem(w, mention=True)) for w in named] == [False, True]
    assert problem(["timberhand", "replay"]) and not problem(["timberhand", "replay"], mention=True)
