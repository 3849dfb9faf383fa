"""JSON schemas of the reports as they are recorded: flat, so that a viewer can offer their fields for a plot."""

from __future__ import annotations

from dataclasses import fields
from typing import Any, Final, get_args, get_origin, get_type_hints

import msgspec

_SIMPLE: Final = {int: "integer", float: "number", bool: "boolean", str: "string"}


def flat_schema(report: type[Any]) -> bytes:
    """Write the schema of a dataclass whose fields are numbers, texts and tuples of numbers.

    Viewers do not follow references, so there are none, and a number that is unknown (null) counts as a number.

    Raises:
        TypeError: a field is something else.
    """
    hints = get_type_hints(report)
    properties = {field.name: _type(hints[field.name]) for field in fields(report)}
    return msgspec.json.encode({"type": "object", "title": report.__name__, "properties": properties})


def _type(hint: Any) -> dict[str, Any]:
    if hint in _SIMPLE:
        return {"type": _SIMPLE[hint]}
    kinds = {kind for kind in get_args(hint) if kind is not Ellipsis}
    if get_origin(hint) is tuple and len(kinds) == 1:
        return {"type": "array", "items": _type(kinds.pop())}
    raise TypeError(f"{hint} has no flat JSON schema")
