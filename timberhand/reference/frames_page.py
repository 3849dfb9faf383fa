"""The frames of both buses, from the DBC files."""

from __future__ import annotations

from can_dbc.dbc.codec import Database, MessageCodec, load
from can_dbc.frame import EXTENDED
from timberhand.reference.markdown import generated, table

BUSES = {"crane": "crane0: CANopen and own PDOs", "machine": "mach0: J1939", "gnss": "mach0: NMEA 2000"}


def page() -> str:
    """docs/reference/frames.md."""
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
