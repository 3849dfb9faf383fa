"""Open-loop grapple of paper A III-A: fully open or fully closed, by time, pressure and opening where they are known.

Inputs: the planner's grapple command, pressures of the closing and the opening side [bar] and the opening [%] (NaN
when unknown), time. Outputs: spool command [%] (+ opens), ``GrappleMode`` of ``ValveCmdB`` and the state. A pressure
counts when it stands, not when a spool kicks. Closed at the end of its way without anything in between is CLOSED,
stopped before by what it holds is HOLDING; so is what turns out to weigh something when it is lifted.  A planner that
goes on asking to close has a bundle gripped again whose logs settled between the tongs and left them loose.  Tongs
that were driven together, or into wood, with the force that shall open them may stick: an opening that does not begin
is shaken loose by closing for a moment. After a close it holds until it is told to open: neither a lost planner nor a
stop opens it.
"""

from __future__ import annotations

from enum import IntEnum
from typing import Final

from can_dbc.setpoint import GrappleCommand
from machine.profile import Grapple

_OVERTIME: Final = 1.5
_OPEN_PCT: Final = 98.0
_SHUT_PCT: Final = 3.0
_FULL_WAY: Final = 0.9
"""Without a sensor, closing that took this share of the time met nothing."""
_LOOSE: Final = 0.7
"""Under this share of the pressure that says gripped the tongs no longer squeeze what they hold."""
_STANDS_NS: Final = 60_000_000
"""A pressure that stands this long is no kick of the spool."""
_STUCK_NS: Final = 1_000_000_000
"""An opening begins within this time, or the tongs stick."""
_STUCK_PCT: Final = 2.0
_SHAKE_NS: Final = 300_000_000
_SHAKES: Final = 3
LOADED_KG: Final = 30.0
"""Twice what friction in the lift looks like; the lightest log that is worth a cycle weighs more."""
_WEIGHS_NS: Final = 500_000_000
"""A load that hangs this long is no swing of the empty tongs."""


class GrappleState(IntEnum):
    """What the law believes; the numbers are those of ``GrappleStat.State``."""

    UNKNOWN = 0
    OPEN = 1
    OPENING = 2
    CLOSING = 3
    CLOSED = 4
    """At the end of its way, nothing in it."""
    HOLDING = 5
    """Stopped by what it holds."""


_HELD: Final = (GrappleState.CLOSED, GrappleState.HOLDING)


class GrappleLaw:
    """The grapple's sequence; `step` while active, `release` in every other mode."""

    __slots__ = (
        "_close_ns", "_from_pct", "_high_ns", "_hold_bar", "_loose_ns", "_open_ns", "_shaken", "_shaking_ns",
        "_since_ns", "_squeezed", "_weighs_ns", "loaded", "mode", "spool_pct", "state",
    )  # fmt: skip

    def __init__(self, grapple: Grapple) -> None:
        self._close_ns = int(grapple.close_time_s * 1e9)
        self._open_ns = int(grapple.open_time_s * 1e9)
        self._hold_bar = grapple.hold_pressure_bar
        self._since_ns = self._shaking_ns = 0
        self._weighs_ns = -1
        self.loaded = False
        """Whether it is closed and a weight hangs in it; on the ground a log weighs nothing."""
        self._high_ns = -1
        """Since when the pressure that ends the movement stands; -1: it does not."""
        self._loose_ns = -1
        """Since when the pressure of what is held is low; -1: it is not."""
        self._squeezed = False
        """Whether the last closing ended by pressure."""
        self._from_pct = 0.0
        self._shaken = 0
        self.state = GrappleState.UNKNOWN
        self.spool_pct = 0.0
        self.mode = GrappleCommand.NEUTRAL

    def step(
        self, wanted: GrappleCommand, clamp_bar: float, opening_pct: float, release_bar: float, now_ns: int
    ) -> None:
        """One tick in which the planner's ``wanted`` is valid."""
        state = self.state
        if wanted is GrappleCommand.OPEN and state not in (GrappleState.OPEN, GrappleState.OPENING):
            self._begin(GrappleState.OPENING, opening_pct, now_ns)
        elif wanted is GrappleCommand.CLOSE and self._to_close(clamp_bar, now_ns):
            self._begin(GrappleState.CLOSING, opening_pct, now_ns)
        elif wanted is GrappleCommand.HOLD and state not in _HELD:
            self.state = GrappleState.HOLDING
        elif wanted is GrappleCommand.NEUTRAL:
            self._interrupt()
        # Without feedback (NaN, which is neither more nor less than anything) the time alone decides.
        if self.state is GrappleState.OPENING:
            self._open(opening_pct, release_bar, now_ns)
        elif self.state is GrappleState.CLOSING:
            self._close(clamp_bar, opening_pct, now_ns)
        self._output(now_ns)

    def weigh(self, load_kg: float, now_ns: int) -> None:
        """The load in the grapple now, NaN where it is unknown; some times per second."""
        if self.state not in _HELD or not load_kg >= LOADED_KG:
            self._weighs_ns = -1
        elif self._weighs_ns < 0:
            self._weighs_ns = now_ns
        self.loaded = self._weighs_ns >= 0 and now_ns - self._weighs_ns >= _WEIGHS_NS
        if self.loaded:
            self.state = GrappleState.HOLDING

    def release(self) -> None:
        """Stops moving: an opening grapple stands still, a closing or closed one holds."""
        self._interrupt()
        self._output(self._shaking_ns)

    def _begin(self, state: GrappleState, opening_pct: float, now_ns: int) -> None:
        # Tongs of which nothing is known may stand open already.
        self._shaken = 0 if self.state in _HELD else _SHAKES
        self.state, self._since_ns, self._shaking_ns = state, now_ns, now_ns
        self._high_ns, self._loose_ns, self._from_pct = -1, -1, opening_pct

    def _open(self, opening_pct: float, release_bar: float, now_ns: int) -> None:
        if now_ns < self._shaking_ns:
            self._since_ns, self._high_ns = now_ns, -1
            return
        elapsed_ns = now_ns - self._since_ns
        stands = self._stands(release_bar, now_ns)
        if opening_pct == opening_pct:
            there = opening_pct >= _OPEN_PCT or elapsed_ns >= self._open_ns * _OVERTIME
            sticks = opening_pct < self._from_pct + _STUCK_PCT and elapsed_ns >= _STUCK_NS
        else:
            # Where nothing measures the opening, the full pressure at once says that the tongs did not move.
            sticks = stands and elapsed_ns < _STUCK_NS
            there = stands or elapsed_ns >= self._open_ns
        if sticks and self._shaken < _SHAKES:
            self._shaken += 1
            self._shaking_ns = now_ns + _SHAKE_NS
        elif there:
            self.state = GrappleState.OPEN

    def _close(self, clamp_bar: float, opening_pct: float, now_ns: int) -> None:
        elapsed_ns = now_ns - self._since_ns
        stands = self._stands(clamp_bar, now_ns)
        late_ns = self._close_ns if clamp_bar != clamp_bar else self._close_ns * _OVERTIME
        if not (stands or elapsed_ns >= late_ns):
            return
        self._squeezed = stands
        full_way = opening_pct <= _SHUT_PCT if opening_pct == opening_pct else elapsed_ns >= _FULL_WAY * self._close_ns
        # Blind and by time alone nothing speaks against a load: hold it.
        known = stands or opening_pct == opening_pct
        self.state = GrappleState.CLOSED if full_way and known else GrappleState.HOLDING

    def _stands(self, bar: float, now_ns: int) -> bool:
        """Whether the pressure has been at its end value for a while."""
        if not bar >= self._hold_bar:
            self._high_ns = -1
            return False
        if self._high_ns < 0:
            self._high_ns = now_ns
        return now_ns - self._high_ns >= _STANDS_NS

    def _to_close(self, bar: float, now_ns: int) -> bool:
        """Whether closing begins: from any state but closed and closing, and where the pressure [bar] that ended it has
        been low for a while.
        """
        if self.state is not GrappleState.HOLDING:
            return self.state not in (GrappleState.CLOSING, GrappleState.CLOSED)
        if not self._squeezed or not bar < _LOOSE * self._hold_bar:
            self._loose_ns = -1
            return False
        if self._loose_ns < 0:
            self._loose_ns = now_ns
        return now_ns - self._loose_ns >= _STANDS_NS

    def _interrupt(self) -> None:
        if self.state is GrappleState.OPENING:
            self.state = GrappleState.UNKNOWN
        elif self.state is GrappleState.CLOSING:
            self.state = GrappleState.HOLDING

    def _output(self, now_ns: int) -> None:
        match self.state:
            case GrappleState.OPENING if now_ns < self._shaking_ns:
                self.spool_pct, self.mode = -100.0, GrappleCommand.CLOSE
            case GrappleState.OPENING:
                self.spool_pct, self.mode = 100.0, GrappleCommand.OPEN
            case GrappleState.CLOSING:
                self.spool_pct, self.mode = -100.0, GrappleCommand.CLOSE
            case GrappleState.CLOSED | GrappleState.HOLDING:
                self.spool_pct, self.mode = 0.0, GrappleCommand.HOLD
            case _:
                self.spool_pct, self.mode = 0.0, GrappleCommand.NEUTRAL
