"""Valves that do not do what their node commands (docs/reference/safety.md section 5, cases 16 to 18)."""

from __future__ import annotations

from collections.abc import Sequence


class SpoolFaults:
    """Changes commands, -1..1 of the spool, by the name of their function.

    ``stuck`` holds a spool wherever the node wants it, ``bias`` adds to the command (the spool drifts), ``gain``
    multiplies it.  They are faults of the amplifiers: without
    pilot pressure the springs centre the spools.
    """

    def __init__(self) -> None:
        self.stuck: dict[str, float] = {}
        self.bias: dict[str, float] = {}
        self.gain: dict[str, float] = {}

    def __bool__(self) -> bool:
        return bool(self.stuck or self.bias or self.gain)

    def apply(self, names: Sequence[str], commands: Sequence[float]) -> list[float]:
        """The commands that reach the spools; ``names`` in the order of ``commands``."""
        out = list(commands)
        for i, name in enumerate(names[: len(out)]):
            out[i] = self.stuck.get(name, out[i] * self.gain.get(name, 1.0) + self.bias.get(name, 0.0))
        return out
