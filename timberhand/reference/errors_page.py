"""Every error code: found in the source, at the places that raise it."""

from __future__ import annotations

import ast
import re
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

from timberhand.reference.markdown import generated, table

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
    """By code: (class or function that takes it, file, sentence with ``…`` for what varies) of each place."""
    found: dict[str, list[tuple[str, str, str]]] = defaultdict(list)
    for package in PACKAGES:
        for path in sorted((repository / package).rglob("*.py")):
            for code, taker, sentence in _codes_of(ast.parse(path.read_text())):
                found[code].append((taker, path.relative_to(repository).as_posix(), sentence))
    return dict(sorted(found.items()))


def _codes_of(tree: ast.Module) -> Iterator[tuple[str, str, str]]:
    """Calls whose first two arguments are a code and a sentence."""
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
    """The text of a string or an f-string; ``…`` stands for what is put in."""
    match node:
        case ast.Constant(value=str(text)):
            return text
        case ast.JoinedStr(values=parts):
            return "".join(_sentence(part) if isinstance(part, ast.Constant) else "…" for part in parts)
        case ast.BinOp(left=left, right=right):
            return _sentence(left) + _sentence(right)
        case _:
            return "…"


def page(repository: Path) -> str:
    """docs/reference/errors.md."""
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
