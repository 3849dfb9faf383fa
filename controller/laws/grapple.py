"""Open-loop grapple of paper A III-A: fully open or fully closed, by time, pressure and opening where they
are known.

Inputs: the planner's grapple command, clamp pressure [bar] and opening [%] (NaN when unknown),
time.  Outputs: spool command [%] (+ opens), ``GrappleMode`` of ``ValveCmdB`` and the state.  After a close it
holds until it is told to open: neither a lost planner nor a stop opens it.
"""

from __future__ import annotations

from enum import IntEnum
from typing import Final

from can_dbc.setpoint import GrappleCommand
from machine.profile import Grapple

_OVERTIME: Final = 1.5
_OPEN_PCT: Final = 98.0


class GrappleState(IntEnum):
    """What the law believes; the numbers are those of ``GrappleStat.State``."""

    UNKNOWN = 0
    OPEN = 1
    OPENING = 2
    CLOSING = 3
    HOLDING = 5


class GrappleLaw:
    """The grapple's sequence; `step` while active, `release` in every other mode."""

    __slots__ = ("_close_ns", "_hold_bar", "_open_ns", "_since_ns", "mode", "spool_pct", "state")

    def __init__(self, grapple: Grapple) -> None:
        self._close_ns = int(grapple.close_time_s * 1e9)
        self._open_ns = int(grapple.open_time_s * 1e9)
        self._hold_bar = grapple.hold_pressure_bar
        self._since_ns = 0
        self.state = GrappleState.UNKNOWN
        self.spool_pct = 0.0
        self.mode = GrappleCommand.NEUTRAL

    def step(self, wanted: GrappleCommand, clamp_bar: float, opening_pct: float, now_ns: int) -> None:
        """One tick in which the planner's ``wanted`` is valid."""
        state = self.state
        if wanted is GrappleCommand.OPEN and state not in (GrappleState.OPEN, GrappleState.OPENING):
            self.state, self._since_ns = GrappleState.OPENING, now_ns
        elif wanted is GrappleCommand.CLOSE and state not in (GrappleState.CLOSING, GrappleState.HOLDING):
            self.state, self._since_ns = GrappleState.CLOSING, now_ns
        elif wanted is GrappleCommand.HOLD:
            self.state = GrappleState.HOLDING
        elif wanted is GrappleCommand.NEUTRAL:
            self._interrupt()
        elapsed_ns = now_ns - self._since_ns
        # Without feedback (NaN, which equals nothing) the time alone decides.
        if self.state is GrappleState.OPENING:
            late = self._open_ns if opening_pct != opening_pct else self._open_ns * _OVERTIME
            if opening_pct >= _OPEN_PCT or elapsed_ns >= late:
                self.state = GrappleState.OPEN
        elif self.state is GrappleState.CLOSING:
            late = self._close_ns if clamp_bar != clamp_bar else self._close_ns * _OVERTIME
            if clamp_bar >= self._hold_bar or elapsed_ns >= late:
                self.state = GrappleState.HOLDING
        self._output()

    def release(self) -> None:
        """Stops moving: an opening grapple stands still, a closing or closed one holds."""
        self._interrupt()
        self._output()

    def _interrupt(self) -> None:
        if self.state is GrappleState.OPENING:
            self.state = GrappleState.UNKNOWN
        elif self.state is GrappleState.CLOSING:
            self.state = GrappleState.HOLDING

    def _output(self) -> None:
        match self.state:
            case GrappleState.OPENING:
                self.spool_pct, self.mode = 100.0, GrappleCommand.OPEN
            case GrappleState.CLOSING:
                self.spool_pct, self.mode = -100.0, GrappleCommand.CLOSE
            case GrappleState.HOLDING:
                self.spool_pct, self.mode = 0.0, GrappleCommand.HOLD
            case _:
                self.spool_pct, self.mode = 0.0, GrappleCommand.NEUTRAL
