"""Whether a saved result still speaks for the sources of today.

A result names the commit that measured it, the registry the sources on its path.  It is *stale* when one of them has
changed since, *unverifiable* when its commit is not in the history or had changes that nobody committed.  A change of
comments, docstrings or the layout of Python code is none: its syntax tree stays the same.  A source may name some
definitions of a module, as in ``experiment.py:jobs_of,FIRST_SEED``: the rest of it only reads finished outcomes.
"""

from __future__ import annotations

import ast
import subprocess
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from functools import cache
from pathlib import Path
from typing import Final

from experiments.common.registry import Entry
from experiments.common.result import ROOT

SUFFIXES: Final = (".py", ".toml", ".dbc", ".eds", ".onnx", ".geojson")
"""Files on which a measurement depends."""
ALL: Final[frozenset[str]] = frozenset()
"""No selection: every definition of a module counts."""
CHANGES: Final = "+changes"
UNKNOWN: Final = "unknown"
"""The end of the commit of a checkout with changes, and the commit outside git (`experiments.common.result.commit`)."""


class Standing(StrEnum):
    """What a result is worth today; in words."""

    CURRENT = "current"
    STALE = "stale"
    UNVERIFIABLE = "unverifiable"


@dataclass(frozen=True, slots=True)
class Verdict:
    """A standing, one sentence that says why (empty for a current result), and the files that changed."""

    standing: Standing
    why: str = ""
    changed: tuple[str, ...] = ()


def judge(commit: str, entry: Entry, root: Path = ROOT) -> Verdict:
    """Judge the standing of a result measured at ``commit``, by the git history of the checkout ``root``."""
    if commit.endswith(CHANGES):
        return Verdict(Standing.UNVERIFIABLE, f"It was measured at `{commit}`, with changes that nobody committed.")
    changed = changed_since(commit, entry.sources, root)
    if changed is None:
        return Verdict(Standing.UNVERIFIABLE, f"Its commit `{commit}` is not in the history.")
    if not changed:
        return Verdict(Standing.CURRENT)
    return Verdict(Standing.STALE, f"Sources on its path have changed since its commit `{commit}`.", changed)


@cache
def changed_since(commit: str, sources: tuple[str, ...], root: Path) -> tuple[str, ...] | None:
    """List files of ``sources`` whose meaning differs from that at ``commit``; None if the history does not hold it."""
    if _git(root, "merge-base", "--is-ancestor", commit, "HEAD") is None:
        return None
    only = {path: frozenset(names.split(",")) for path, _, names in (s.partition(":") for s in sources) if names}
    paths = [s.partition(":")[0] for s in sources]
    listed = _git(root, "diff", "--name-only", "--no-renames", "-z", commit, "--", *paths)
    names = [name for name in (listed or b"").decode().split("\0") if name.endswith(SUFFIXES)]
    then = _contents(root, commit, names)
    return tuple(n for n, old in zip(names, then, strict=True) if _differs(n, old, root / n, only.get(n, ALL)))


def _contents(root: Path, commit: str, names: Sequence[str]) -> list[bytes | None]:
    """Read the files as they were at a commit; None for one that it does not hold."""
    object_names = "".join(f"{commit}:{name}\n" for name in names).encode()
    batch_output = _git(root, "cat-file", "--batch", given=object_names) or b""
    contents: list[bytes | None] = []
    for _ in names:
        head, _, batch_output = batch_output.partition(b"\n")
        if head.endswith(b" missing"):
            contents.append(None)
            continue
        size = int(head.rsplit(b" ", 1)[1])
        contents.append(batch_output[:size])
        batch_output = batch_output[size + 1 :]
    return contents


def _differs(name: str, then: bytes | None, path: Path, only: frozenset[str]) -> bool:
    now = path.read_bytes() if path.is_file() else None
    if then is None or now is None or not name.endswith(".py"):
        return then != now
    return meaning(then, only) != meaning(now, only)


@cache
def meaning(source: bytes, only: frozenset[str] = ALL) -> str:
    """Return the syntax tree of Python code without docstrings and positions, as text; of the definitions ``only``."""
    tree = ast.parse(source)
    tree.body = [statement for statement in tree.body if not only or only & _defined(statement)]
    for node in ast.walk(tree):
        body = getattr(node, "body", None)
        if isinstance(body, list):
            # A string that stands alone is a docstring, or the documentation of the constant above it.
            node.body = [s for s in body if not _is_text(s)]  # type: ignore[attr-defined]
    return ast.dump(tree)


def _defined(statement: ast.stmt) -> set[str]:
    """Return the names that a statement of a module defines."""
    if isinstance(statement, ast.FunctionDef | ast.ClassDef):
        return {statement.name}
    return {n.id for n in ast.walk(statement) if isinstance(n, ast.Name) and isinstance(n.ctx, ast.Store)}


def _is_text(statement: ast.stmt) -> bool:
    value = statement.value if isinstance(statement, ast.Expr) else None
    return isinstance(value, ast.Constant) and isinstance(value.value, str)


def _git(root: Path, *arguments: str, given: bytes = b"") -> bytes | None:
    """Run git with the standard input ``given`` and return what it prints; None when it fails or is missing."""
    command = ["git", "-C", str(root), *arguments]
    try:
        return subprocess.run(command, input=given, capture_output=True, check=True).stdout
    except (OSError, subprocess.CalledProcessError):
        return None


def marked(page: str, verdict: Verdict) -> str:
    """Put a sentence on its standing below the title of the page; none when it is current.

    The sentence does not name the files that changed, so that a page is written anew once and not with every commit.
    """
    if verdict.standing is Standing.CURRENT:
        return page
    title, _, rest = page.partition("\n\n")
    hint = "`timberhand report --check` says more."
    return f"{title}\n\n> **{verdict.standing.capitalize()}.** {verdict.why} The figures are of then; {hint}\n\n{rest}"


def has_history(root: Path = ROOT) -> bool:
    """Tell whether the checkout has its git history, without which nothing can be said: neither cut off, nor a copy of
    the files in a commit of their own.
    """
    whole = (_git(root, "rev-parse", "--is-shallow-repository") or b"").strip() == b"false"
    return whole and _git(root, "rev-parse", "--verify", "-q", "HEAD^") is not None
