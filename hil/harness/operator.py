"""An emulated operator: arms the machine, and arms it again after a stop.

A supervising person presses ARM when the machine is in STANDBY, and again after a controlled stop once the reason is
clear.  `Operator` does the same in demos and tests, through the same operator datagrams, and gives up after a number of
stops.  Pure: state reports in, datagrams out.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

from can_dbc.messages.crane import OperatorAction, OperatorCommand, StateReport
from can_dbc.messages.datagrams import encode
from machine.status.modes import Mode

REACTION_NS: Final = 1_000_000_000
REPEAT_NS: Final = 2_000_000_000
MAX_STOPS: Final = 20
"""Default number of stops after which the operator gives up."""
STOPPED: Final = (Mode.STOP, Mode.FAULT)
"""A stop that turns into a latched fault counts as one stop."""


class Operator:
    """Presses ARM and RESET; ``stops`` counts the stops, ``gave_up`` tells whether there were too many."""

    def __init__(
        self, profile_hash: int, on_press: Callable[[OperatorAction, StateReport], None], max_stops: int = MAX_STOPS
    ) -> None:
        self.stops = 0
        self._max_stops = max_stops
        self._profile_hash = profile_hash
        self._on_press = on_press
        self._sequence = 0
        self._mode: int = Mode.BOOT
        self._since_ns = 0
        self._next_ns = 0

    @property
    def gave_up(self) -> bool:
        """Whether the machine has stopped more than ``max_stops`` times."""
        return self.stops > self._max_stops

    def step(self, report: StateReport) -> bytes | None:
        """The operator command in answer to this report, as a datagram; None when there is none."""
        if report.mode != self._mode:
            self.stops += report.mode in STOPPED and self._mode not in STOPPED
            self._mode, self._since_ns = report.mode, report.stamp_ns
        action = {
            Mode.STANDBY: OperatorAction.ARM,
            Mode.STOP: OperatorAction.ARM,
            Mode.FAULT: OperatorAction.RESET,
        }
        ready = report.stamp_ns - self._since_ns >= REACTION_NS and report.stamp_ns >= self._next_ns
        if self._mode not in action or not ready or self.gave_up:
            return None
        self._next_ns = report.stamp_ns + REPEAT_NS
        self._sequence += 1
        press = action[Mode(self._mode)]
        self._on_press(press, report)
        return encode(OperatorCommand(self._sequence, self._profile_hash, report.stamp_ns, press))
