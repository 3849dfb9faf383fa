"""Events of the planning process: JSON lines on stdout."""

from __future__ import annotations

import sys
import time

import msgspec


def emit(event: str, **fields: object) -> None:
    """Write one event with the time and its fields; fields that are None are left out."""
    line = {"event": event, "t_s": round(time.monotonic(), 3), **{k: v for k, v in fields.items() if v is not None}}
    sys.stdout.write(msgspec.json.encode(line).decode() + "\n")
    sys.stdout.flush()
