"""An emulated operator: arms the machine, and arms it again after a stop.

A supervising person presses ARM when the machine is in STANDBY, and again after a controlled stop once the reason is
clear.  `Operator` does the same in demos and tests, through the same operator datagrams, and gives up after a number
of stops, or when its presses have no effect.  With ``watches`` it also sends the heartbeats of a person who watches.
Pure: state reports in, datagrams out.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

from can_dbc.messages.crane import WATCH_PERIOD_NS, OperatorAction, OperatorCommand, StateReport
from can_dbc.messages.datagrams import encode
from machine.status.modes import STOPPED, Mode

REACTION_NS: Final = 1_000_000_000
REPEAT_NS: Final = 2_000_000_000
MAX_STOPS: Final = 20
"""Default number of stops after which the operator gives up."""
MAX_PRESSES: Final = 90
"""Presses of ARM or RESET that may leave the mode as it is before the operator gives up: three minutes."""
_BUTTONS: Final = {Mode.STANDBY: OperatorAction.ARM, Mode.STOP: OperatorAction.ARM, Mode.FAULT: OperatorAction.RESET}


class Operator:
    """Presses ARM and RESET; ``stops`` counts the stops, ``complaint`` says why nothing is pressed any more.

    While ``cut`` nothing that it sends arrives: its link is lost.  ``profile_check`` as in `OperatorCommand`: a guard
    that is a process of its own wants it.
    """

    def __init__(
        self,
        profile_hash: int,
        on_press: Callable[[OperatorAction, StateReport], None],
        max_stops: int = MAX_STOPS,
        watches: bool = False,
        profile_check: int = 0,
    ) -> None:
        self.stops = 0
        self.watches = watches
        self.cut = False
        self._max_stops = max_stops
        self._profile_hash, self._profile_check = profile_hash, profile_check
        self._on_press = on_press
        self._sequence = 0
        self._mode: int = Mode.BOOT
        self._since_ns = 0
        self._next_ns = 0
        self._presses = 0
        self._beat_ns = -WATCH_PERIOD_NS

    @property
    def gave_up(self) -> bool:
        """Whether there is a `complaint`."""
        return bool(self.complaint)

    @property
    def complaint(self) -> str:
        """Why the operator gave up: too many stops, or presses without effect; empty while there is hope."""
        if self.stops > self._max_stops:
            return f"the machine has stopped {self.stops} times, and the operator gave up"
        if self._presses > MAX_PRESSES:
            mode, button = Mode(self._mode), _BUTTONS[Mode(self._mode)]
            return f"the machine stays in {mode.name} after {MAX_PRESSES} presses of {button.name}; read its reason"
        return ""

    def step(self, report: StateReport) -> bytes | None:
        """Return the operator command in answer to this report, as a datagram; None when there is none."""
        sent = self._press(report)
        if sent is None and self.watches and report.stamp_ns - self._beat_ns >= WATCH_PERIOD_NS:
            self._beat_ns = report.stamp_ns
            sent = self._command(OperatorAction.WATCH, report)
        return None if self.cut else sent

    def _press(self, report: StateReport) -> bytes | None:
        if report.mode != self._mode:
            # a stop that turns into a latched fault counts as one stop
            self.stops += report.mode in STOPPED and self._mode not in STOPPED
            self._mode, self._since_ns, self._presses = report.mode, report.stamp_ns, 0
        ready = report.stamp_ns - self._since_ns >= REACTION_NS and report.stamp_ns >= self._next_ns
        if self._mode not in _BUTTONS or not ready or self.gave_up:
            return None
        self._next_ns = report.stamp_ns + REPEAT_NS
        self._presses += 1
        if self.gave_up:
            return None
        press = _BUTTONS[Mode(self._mode)]
        self._on_press(press, report)
        return self._command(press, report)

    def _command(self, action: OperatorAction, report: StateReport) -> bytes:
        self._sequence += 1
        stamp = (self._sequence, self._profile_hash, report.stamp_ns)
        return encode(OperatorCommand(*stamp, action, self._profile_check))
