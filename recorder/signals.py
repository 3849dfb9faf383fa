"""Decodes the frames of a bus for a recording: message name, and values under their DBC names.

Values are physical and unchecked (``codec.decode``): a recording shows what was on the bus, including values out of
range and frames that a receiver refuses.  Only a frame of wrong length has no values.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import msgspec

from can_dbc.dbc.codec import Database, MessageCodec


class BusSignals:
    """The messages of one bus, from one or more databases."""

    def __init__(self, databases: Iterable[Database]) -> None:
        self._databases = tuple(databases)
        self._found: dict[int, tuple[MessageCodec, tuple[str, ...]] | None] = {}

    def messages(self) -> list[MessageCodec]:
        """Every message that can be decoded, in the order of the databases."""
        return [codec for database in self._databases for codec in database.messages.values()]

    def decode(self, key: int, data: bytes) -> tuple[str, dict[str, Any]] | None:
        """Message name and values of a frame; None for a foreign frame or a wrong length."""
        try:
            found = self._found[key]
        except KeyError:
            found = self._found[key] = self._find(key)
        if found is None or len(data) != found[0].length:
            return None
        codec, names = found
        return codec.name, dict(zip(names, codec.decode(data), strict=True))

    def _find(self, key: int) -> tuple[MessageCodec, tuple[str, ...]] | None:
        for database in self._databases:
            if codec := database.find(key):
                return codec, tuple(s.name for s in codec.signals)
        return None


def json_schema(codec: MessageCodec) -> bytes:
    """The JSON schema of a message's values, with units and value tables in the descriptions."""
    properties: dict[str, Any] = {}
    for signal in codec.signals:
        table = ", ".join(f"{raw} {label}" for raw, label in sorted(signal.choices.items()))
        text = "; ".join(part for part in (signal.comment, signal.unit and f"[{signal.unit}]", table) if part)
        properties[signal.name] = {"type": "number", "description": text}
    return msgspec.json.encode({"type": "object", "description": codec.comment, "properties": properties})
