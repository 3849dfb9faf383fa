"""Describes how the recorded and the replayed outputs of a tick differ."""

from __future__ import annotations

from collections.abc import Sequence

from can_dbc.dbc.codec import Database, load
from can_dbc.frame import RawFrame, describe
from can_dbc.messages import datagrams
from can_dbc.messages.envelope import DatagramRefused

Outputs = tuple[Sequence[RawFrame], Sequence[RawFrame], bytes, bytes]
"""Frames on crane0, frames on mach0, crane report, vehicle report."""


def differing_lines(recorded: Outputs, replayed: Outputs) -> dict[str, list[str]]:
    """The outputs of either side in words, without the lines that both have."""
    databases = load("crane"), load("machine")
    lines = []
    for crane, machine, *reports in (recorded, replayed):
        described = [_frame_text(databases[0], *frame) for frame in crane] + [
            _frame_text(databases[1], *frame) for frame in machine
        ]
        lines.append(described + [line for report in reports for line in _report_text(report)])
    before, now = lines
    return {
        "recorded": [line for line in before if line not in now] or before,
        "replayed": [line for line in now if line not in before] or now,
    }


def _frame_text(database: Database, key: int, data: bytes) -> str:
    codec = database.find(key)
    raw = f"{describe(key)}#{data.hex().upper()}"
    if codec is None or len(data) != codec.length:
        return raw
    values = codec.named(codec.decode(data))
    return f"{raw} {codec.name} " + " ".join(f"{name}={value:g}" for name, value in values.items())


def _report_text(report: bytes) -> list[str]:
    if not report:
        return []
    try:
        return [str(datagrams.decode(report))]
    except DatagramRefused:
        return [f"report {report.hex()}"]
