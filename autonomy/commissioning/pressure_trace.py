"""The pressures of one joint's cylinder as its bus tells them."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final

from autonomy.calibration.trace import SignalColumn
from can_dbc.dbc.codec import Database
from can_dbc.frame import Frame

MESSAGES: Final = ("PressA", "PressB")


class PressureTrace:
    """``sides``: the columns of the sides A and B of a joint, bar; empty where nothing measures them."""

    def __init__(self, database: Database, joint_name: str) -> None:
        self.sides = (SignalColumn(), SignalColumn())
        names = [f"{joint_name.capitalize()}{side}" for side in "AB"]
        codecs = [database.message(name) for name in MESSAGES]
        self._codecs = [c for c in codecs if names[0] in c.index]
        self._at = [[c.index[name] for name in names] for c in self._codecs]

    @property
    def keys(self) -> tuple[int, ...]:
        """The keys of the frames that it uses."""
        return tuple(c.key for c in self._codecs)

    def accept(self, frames: Iterable[Frame]) -> None:
        """Store frames as they arrive; others are ignored."""
        for stamp_ns, key, data in frames:
            for codec, at in zip(self._codecs, self._at, strict=True):
                if key != codec.key or len(data) != codec.length:
                    continue
                values = codec.decode(data)
                for index, column in zip(at, self.sides, strict=True):
                    if values[index] is not None:
                        column.add(stamp_ns, float(values[index]))
