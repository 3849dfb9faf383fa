"""The questions of the questionnaire one by one, with the example's answer as a proposal; and answers as TOML."""

from __future__ import annotations

import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Final, get_args, get_origin

import msgspec

from machine.draft.answers import Answers, answers_of, read_answers
from machine.draft.toml_text import value_text

EXAMPLE: Final = Path(__file__).with_name("truck_loader.toml")
"""Answers about a truck-mounted timber loader."""
NONE: Final = "-"
"""What a person types for an answer that does not apply."""


@dataclass(frozen=True, slots=True)
class Question:
    """One answer: key path, text for people, type to check, and the example's answer (None: does not apply)."""

    path: tuple[str, ...]
    text: str
    kind: Any
    proposal: Any

    def parse(self, typed: str) -> Any:
        """Parse the answer that a person typed; None for `NONE`.

        Raises:
            ValueError: it is not of the question's type, in words.
        """
        if typed.strip() == NONE:
            value = None
        else:
            try:
                value = tomllib.loads(f"v = {typed}")["v"]
            except tomllib.TOMLDecodeError:
                value = typed.strip()
        return msgspec.convert(value, self.kind)


def example() -> Answers:
    """Return the example's answers."""
    return answers_of(read_answers(EXAMPLE), EXAMPLE.name)


def questions(answers: Answers) -> list[Question]:
    """List every question in the order of the answers, with their values as proposals."""
    return list(_questions(answers, ()))


def _questions(struct: msgspec.Struct, path: tuple[str, ...]) -> Iterator[Question]:
    """Yield the plain values of a table before its tables, as TOML wants it."""
    subtables = []
    for field in msgspec.structs.fields(struct):
        value = getattr(struct, field.name)
        if isinstance(value, msgspec.Struct):
            subtables.append((value, (*path, field.name)))
        elif get_origin(field.type) is Annotated:
            meta = next(m for m in get_args(field.type)[1:] if isinstance(m, msgspec.Meta))
            yield Question((*path, field.name), meta.description or "", field.type, value)
    for value, table_path in subtables:
        yield from _questions(value, table_path)


def answers_text(answers: Answers) -> str:
    """Write all answers as TOML, each with its question behind it; what does not apply is left out."""
    out = [f"# Answers about {answers.title}; SI units: m, rad, s, kg, Pa", ""]
    table: tuple[str, ...] = ()
    for question in questions(answers):
        if question.path[:-1] != table:
            table = question.path[:-1]
            out += ["", f"[{'.'.join(table)}]"]
        if question.proposal is not None:
            out.append(f"{f'{question.path[-1]} = {value_text(question.proposal)}':<31}  # {question.text}")
    for name, box in answers.keep_out.items():
        out += ["", f"[keep_out.{name}]"]
        out += [f"{key} = {value_text(getattr(box, key))}" for key in box.__struct_fields__]
    return "\n".join([*out, ""])


def put(raw: dict[str, Any], path: tuple[str, ...], value: Any) -> None:
    """Set an answer in parsed answers; None leaves it out."""
    for key in path[:-1]:
        raw = raw.setdefault(key, {})
    if value is not None:
        raw[path[-1]] = list(value) if isinstance(value, tuple) else value


def merged(over: dict[str, Any], under: dict[str, Any]) -> dict[str, Any]:
    """Merge the tables of ``over``, with what only ``under`` has."""
    both = {k: merged(over[k], under[k]) for k in over.keys() & under.keys() if isinstance(over[k], dict)}
    return {**under, **over, **both}
