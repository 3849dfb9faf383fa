"""Bus signals recorded during spool tests: commands, spools, joint positions and lift pressures, with their times.

Frames go in as they arrive (`BusTrace.accept`, any number at a time); columns over a period come out.  Nothing here
sends.  Positions are the encoder's counts through the profile, not the controller's estimate.  Commands and spools
carry the profile's sign, so that + is positive joint motion everywhere.
"""

from __future__ import annotations

from array import array
from collections.abc import Iterable
from dataclasses import dataclass
from math import nan
from typing import Final

import numpy as np

from can_dbc.dbc.codec import Database, MessageCodec
from can_dbc.frame import Frame
from machine.joints import JOINTS, Joint
from machine.profile import Encoder, Profile, joint
from machine.sensing import lift_moment_nm, position_from_counts

GRID_S: Final = 0.005
FINE_FACTOR: Final = 4
_NS: Final = 1e-9


class SignalColumn:
    """Times [ns] and values of one signal."""

    __slots__ = ("times_ns", "values")

    def __init__(self) -> None:
        self.times_ns, self.values = array("q"), array("d")

    def add(self, stamp_ns: int, value: float) -> None:
        """Append a sample; one older than the last is dropped."""
        if not self.times_ns or stamp_ns > self.times_ns[-1]:
            self.times_ns.append(stamp_ns)
            self.values.append(value)

    def between(self, from_ns: int, to_ns: int) -> tuple[np.ndarray, np.ndarray]:
        """Return times [s after ``from_ns``] and values of a period."""
        times = np.frombuffer(self.times_ns, np.int64)
        first, last = np.searchsorted(times, (from_ns, to_ns))
        values = np.frombuffer(self.values, float)[first:last].copy()
        return (times[first:last] - from_ns) * _NS, values


@dataclass(frozen=True, slots=True)
class SpoolTestRecord:
    """One program as it ran: joint, side, kind, and the bus signals on a grid of `GRID_S`.

    ``command`` and ``spool`` are shares of full (1 = 100 %), ``position`` is in rad or m.  ``fine_command`` has
    `FINE_FACTOR` values per grid step, for finding a dead time between them.  ``spool`` is None where the valve node
    reports none.
    """

    joint: Joint
    side: int
    kind: str
    time_s: np.ndarray
    command: np.ndarray
    fine_command: np.ndarray
    spool: np.ndarray | None
    position: np.ndarray


class BusTrace:
    """All valve and joint signals since the start."""

    def __init__(self, profile: Profile, database: Database) -> None:
        self._profile = profile
        self.commands = [SignalColumn() for _ in JOINTS]
        self.spools = [SignalColumn() for _ in JOINTS]
        self.positions = [SignalColumn() for _ in JOINTS]
        self.grapple_state, self.opening, self.grapple_spool = SignalColumn(), SignalColumn(), SignalColumn()
        self.lift_bar = (SignalColumn(), SignalColumn())
        """Pressures of the lift cylinder: the lifting side, the other."""
        self._readers: dict[int, tuple[MessageCodec, list[tuple[int, float, SignalColumn]]]] = {}
        for message, columns in (("ValveCmdA", self.commands), ("ValveCmdB", self.commands)):
            self._read_valves(database, message, "", columns)
        for message in ("ValveFbA", "ValveFbB"):
            self._read_valves(database, message, "Spool", self.spools)
        grapple = database.message("ValveFbB")
        self._readers[grapple.key][1].append((grapple.index["SpoolGrapple"], 0.01, self.grapple_spool))
        status = database.message("GrappleStat")
        signals = [(status.index["State"], 1.0, self.grapple_state), (status.index["Opening"], 1.0, self.opening)]
        self._readers[status.key] = (status, signals)
        press = database.message("PressA")
        sides = zip(("LiftA", "LiftB"), self.lift_bar, strict=True)
        self._readers[press.key] = (press, [(press.index[name], 1.0, column) for name, column in sides])
        self._encoders: dict[int, tuple[MessageCodec, int, Encoder, SignalColumn]] = {}
        for j in JOINTS:
            encoder = joint(profile, j).encoder
            if encoder is not None:
                codec = database.message(encoder.message)
                self._encoders[codec.key] = (codec, codec.index["Position"], encoder, self.positions[j])

    def _read_valves(self, database: Database, message: str, prefix: str, columns: list[SignalColumn]) -> None:
        codec = database.message(message)
        valve_signals = []
        for j in JOINTS:
            valve = joint(self._profile, j).valve
            if f"{prefix}{valve.signal}" in codec.index:
                valve_signals.append((codec.index[f"{prefix}{valve.signal}"], 0.01 * valve.sign, columns[j]))
        self._readers[codec.key] = (codec, valve_signals)

    @property
    def keys(self) -> tuple[int, ...]:
        """The keys of the frames it uses."""
        return (*self._readers, *self._encoders)

    def accept(self, frames: Iterable[Frame]) -> None:
        """Store frames as they arrive; unreadable ones are dropped."""
        for stamp_ns, key, data in frames:
            if (encoder := self._encoders.get(key)) is not None:
                codec, at, spec, column = encoder
                if len(data) == codec.length:
                    column.add(stamp_ns, position_from_counts(spec, int(codec.decode(data)[at])))
            elif (reader := self._readers.get(key)) is not None and len(data) == reader[0].length:
                values = reader[0].decode(data)
                for at, scale, column in reader[1]:
                    if values[at] is not None:
                        column.add(stamp_ns, scale * values[at])

    def lift_moment_nm(self, position: float, from_ns: int, to_ns: int) -> float:
        """Compute the mean moment at a resting lift joint at ``position`` [rad], by the pressures; NaN without any."""
        a, b = (column.between(from_ns, to_ns)[1] for column in self.lift_bar)
        if not (len(a) and len(b)):
            return nan
        return lift_moment_nm(self._profile, position, float(np.mean(a)), float(np.mean(b)))

    def test(self, which: Joint, side: int, kind: str, from_ns: int, to_ns: int) -> SpoolTestRecord:
        """Return the record of one joint between two times."""
        grid = np.arange(0.0, (to_ns - from_ns) * _NS, GRID_S)
        times, commands = self.commands[which].between(from_ns, to_ns)
        # A command holds until the next one; a spool and a joint move between their samples.
        fine = (np.arange(len(grid) * FINE_FACTOR) - FINE_FACTOR + 1) * (GRID_S / FINE_FACTOR)
        index = np.clip(np.searchsorted(times, fine, side="right") - 1, 0, None)
        held = commands[index] if len(commands) else np.zeros_like(fine)
        times, spools = self.spools[which].between(from_ns, to_ns)
        spool = np.interp(grid, times, spools) if len(spools) > 1 else None
        times, positions = self.positions[which].between(from_ns, to_ns)
        position = np.interp(grid, times, positions) if len(positions) else np.full_like(grid, np.nan)
        return SpoolTestRecord(which, side, kind, grid, held[FINE_FACTOR - 1 :: FINE_FACTOR], held, spool, position)
