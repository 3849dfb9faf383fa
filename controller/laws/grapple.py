"""Open-loop grapple of paper A III-A: fully open or fully closed, by time, and by pressure and opening where measured.

Inputs: the planner's grapple command, pressures of the closing and the opening side [bar] and the opening [%] (NaN
while unknown), time.  Outputs: spool command [%] (+ opens), ``GrappleMode`` of ``ValveCmdB`` and the state.

A pressure counts when it persists, so that a kick of the spool does not.  A grapple that closed fully with nothing in
it is CLOSED; one that stopped before is HOLDING, and so is one in which a weight shows when it is lifted.  While the
planner still requests CLOSE, a bundle whose logs settled and came loose is gripped again.  Jaws that were pressed
together, or into wood, with the force that opens them may jam: an opening that does not begin is freed by closing for a
moment.  After closing the grapple holds until it is told to open: neither a lost planner nor a stop opens it.
"""

from __future__ import annotations

from enum import IntEnum
from typing import Final

from can_dbc.messages.crane import GrappleCommand
from machine.profile import Grapple

_OVERTIME_RATIO: Final = 1.5
_OPEN_PCT: Final = 98.0
_SHUT_PCT: Final = 3.0
_FULL_STROKE_SHARE: Final = 0.9
"""Without a sensor, closing that took this share of the closing time met nothing."""
_LOOSE_SHARE: Final = 0.7
"""Below this share of the hold pressure the jaws no longer squeeze their load."""
_PERSISTS_NS: Final = 60_000_000
"""A pressure that persists this long is no kick of the spool."""
_JAMMED_NS: Final = 1_000_000_000
"""An opening begins within this time, or the jaws are jammed."""
_JAMMED_PCT: Final = 2.0
_PRESSES_NS: Final = 1_200_000_000
"""A joint comes to rest on its oil within half of its slowest period (2.5 s)."""
_SHAKE_NS: Final = 300_000_000
_MAX_SHAKES: Final = 3
LOADED_KG: Final = 30.0
"""Twice the friction of the lift seen as a load; the lightest log worth a cycle weighs more."""
_LOADED_NS: Final = 500_000_000
"""A load that persists this long is no swing of the empty grapple."""


class GrappleState(IntEnum):
    """State of the grapple as the law estimates it; the numbers are those of ``GrappleStat.State``."""

    UNKNOWN = 0
    OPEN = 1
    OPENING = 2
    CLOSING = 3
    CLOSED = 4
    """Fully closed, with nothing in it."""
    HOLDING = 5
    """Stopped by its load."""


_SHUT: Final = (GrappleState.CLOSED, GrappleState.HOLDING)


class GrappleLaw:
    """The grapple's sequence; `step` while active, `release` in every other mode."""

    __slots__ = (
        "_close_ns",
        "_from_pct",
        "_high_ns",
        "_hold_bar",
        "_load_ns",
        "_loose_ns",
        "_open_ns",
        "_presses_until_ns",
        "_shakes",
        "_shaking_until_ns",
        "_since_ns",
        "_squeezed",
        "loaded",
        "mode",
        "spool_pct",
        "state",
    )

    def __init__(self, grapple: Grapple) -> None:
        self._close_ns = int(grapple.close_time_s * 1e9)
        self._open_ns = int(grapple.open_time_s * 1e9)
        self._hold_bar = grapple.hold_pressure_bar
        self._since_ns = self._shaking_until_ns = self._presses_until_ns = 0
        self._load_ns = -1
        """Since when a load is measured; -1: none is."""
        self.loaded = False
        """Whether it is closed and a weight hangs in it; a log on the ground weighs nothing."""
        self._high_ns = -1
        """Since when the pressure that ends the movement persists; -1: it does not."""
        self._loose_ns = -1
        """Since when the pressure on the load is low; -1: it is not."""
        self._squeezed = False
        """Whether the last closing ended by pressure."""
        self._from_pct = 0.0
        self._shakes = 0
        self.state = GrappleState.UNKNOWN
        self.spool_pct = 0.0
        self.mode = GrappleCommand.NEUTRAL

    def presses(self, now_ns: int) -> bool:
        """Tell whether the jaws move, or did until `_PRESSES_NS` ago: what they press or let go moves every joint."""
        return now_ns < self._presses_until_ns

    @property
    def at_work(self) -> bool:
        """Whether the tongs move or hold, so that logs between them may turn or hold the rotator."""
        return self.mode is not GrappleCommand.NEUTRAL

    def step(
        self, wanted: GrappleCommand, clamp_bar: float, opening_pct: float, release_bar: float, now_ns: int
    ) -> None:
        """Run one tick in which the planner's command ``wanted`` is valid."""
        state = self.state
        if wanted is GrappleCommand.OPEN and state not in (GrappleState.OPEN, GrappleState.OPENING):
            self._begin(GrappleState.OPENING, opening_pct, now_ns)
        elif wanted is GrappleCommand.CLOSE and self._should_close(clamp_bar, now_ns):
            self._begin(GrappleState.CLOSING, opening_pct, now_ns)
        elif wanted is GrappleCommand.HOLD and state not in _SHUT:
            self.state = GrappleState.HOLDING
        elif wanted is GrappleCommand.NEUTRAL:
            self._interrupt()
        # Without feedback (NaN, which is neither more nor less than anything) only the time decides.
        if self.state is GrappleState.OPENING:
            self._open(opening_pct, release_bar, now_ns)
        elif self.state is GrappleState.CLOSING:
            self._close(clamp_bar, opening_pct, now_ns)
        self._output(now_ns)
        if self.spool_pct != 0.0:
            self._presses_until_ns = now_ns + _PRESSES_NS

    def observe_load(self, load_kg: float, now_ns: int) -> None:
        """Use a measurement of the load in the grapple [kg], NaN while unknown; several times per second."""
        if self.state not in _SHUT or not load_kg >= LOADED_KG:
            self._load_ns = -1
        elif self._load_ns < 0:
            self._load_ns = now_ns
        self.loaded = self._load_ns >= 0 and now_ns - self._load_ns >= _LOADED_NS
        if self.loaded:
            self.state = GrappleState.HOLDING

    def release(self) -> None:
        """Stop moving: an opening grapple stands still, a closing or closed one holds."""
        self._interrupt()
        self._output(self._shaking_until_ns)

    def _begin(self, state: GrappleState, opening_pct: float, now_ns: int) -> None:
        # Jaws of unknown state may be open already.
        self._shakes = 0 if self.state in _SHUT else _MAX_SHAKES
        self.state, self._since_ns, self._shaking_until_ns = state, now_ns, now_ns
        self._high_ns, self._loose_ns, self._from_pct = -1, -1, opening_pct

    def _open(self, opening_pct: float, release_bar: float, now_ns: int) -> None:
        if now_ns < self._shaking_until_ns:
            self._since_ns, self._high_ns = now_ns, -1
            return
        elapsed_ns = now_ns - self._since_ns
        persists = self._pressure_persists(release_bar, now_ns)
        if opening_pct == opening_pct:
            done = opening_pct >= _OPEN_PCT or elapsed_ns >= self._open_ns * _OVERTIME_RATIO
            jammed = opening_pct < self._from_pct + _JAMMED_PCT and elapsed_ns >= _JAMMED_NS
        else:
            # Without a sensor, full pressure at once means that the jaws did not move.
            jammed = persists and elapsed_ns < _JAMMED_NS
            done = persists or elapsed_ns >= self._open_ns
        if jammed and self._shakes < _MAX_SHAKES:
            self._shakes += 1
            self._shaking_until_ns = now_ns + _SHAKE_NS
        elif done:
            self.state = GrappleState.OPEN

    def _close(self, clamp_bar: float, opening_pct: float, now_ns: int) -> None:
        elapsed_ns = now_ns - self._since_ns
        persists = self._pressure_persists(clamp_bar, now_ns)
        limit_ns = self._close_ns if clamp_bar != clamp_bar else self._close_ns * _OVERTIME_RATIO
        if not (persists or elapsed_ns >= limit_ns):
            return
        self._squeezed = persists
        sensed = opening_pct == opening_pct
        full_stroke = opening_pct <= _SHUT_PCT if sensed else elapsed_ns >= _FULL_STROKE_SHARE * self._close_ns
        # Without a sensor and by time alone there may be a load: hold it.
        certain = persists or sensed
        self.state = GrappleState.CLOSED if full_stroke and certain else GrappleState.HOLDING

    def _pressure_persists(self, bar: float, now_ns: int) -> bool:
        """Tell whether the pressure has been at its end value for a while."""
        if not bar >= self._hold_bar:
            self._high_ns = -1
            return False
        if self._high_ns < 0:
            self._high_ns = now_ns
        return now_ns - self._high_ns >= _PERSISTS_NS

    def _should_close(self, bar: float, now_ns: int) -> bool:
        """Tell whether closing begins: from every state but CLOSED and CLOSING, and from HOLDING when the pressure
        [bar] that ended the closing has been low for a while.
        """
        if self.state is not GrappleState.HOLDING:
            return self.state not in (GrappleState.CLOSING, GrappleState.CLOSED)
        if not self._squeezed or not bar < _LOOSE_SHARE * self._hold_bar:
            self._loose_ns = -1
            return False
        if self._loose_ns < 0:
            self._loose_ns = now_ns
        return now_ns - self._loose_ns >= _PERSISTS_NS

    def _interrupt(self) -> None:
        if self.state is GrappleState.OPENING:
            self.state = GrappleState.UNKNOWN
        elif self.state is GrappleState.CLOSING:
            self.state = GrappleState.HOLDING

    def _output(self, now_ns: int) -> None:
        match self.state:
            case GrappleState.OPENING if now_ns < self._shaking_until_ns:
                self.spool_pct, self.mode = -100.0, GrappleCommand.CLOSE
            case GrappleState.OPENING:
                self.spool_pct, self.mode = 100.0, GrappleCommand.OPEN
            case GrappleState.CLOSING:
                self.spool_pct, self.mode = -100.0, GrappleCommand.CLOSE
            case GrappleState.CLOSED | GrappleState.HOLDING:
                self.spool_pct, self.mode = 0.0, GrappleCommand.HOLD
            case _:
                self.spool_pct, self.mode = 0.0, GrappleCommand.NEUTRAL
