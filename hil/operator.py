"""The human of a run without one: arms the machine, and after a stop looks, waits and arms again.

A person who supervises presses ARM when the machine stands by, and after a controlled stop presses it again once the
reason is clear.  This stands in for that person in demos and tests, through the same operator datagrams; it gives up
after a few stops, as a person would.  Pure: reports in, datagrams out.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

from can_dbc.setpoint import OperatorAction, OperatorCommand, StateReport, encode
from machine.modes import Mode

LOOK_NS: Final = 1_000_000_000
REPEAT_NS: Final = 2_000_000_000
PATIENCE: Final = 20
"""So many stops a person bears before calling the machine broken."""
STOPPED: Final = (Mode.STOP, Mode.FAULT)
"""A stop that ends in a latched fault is one stop."""


class Operator:
    """Presses ARM and RESET; ``stops`` counts the stops seen, ``gave_up`` that there were too many."""

    def __init__(
        self, profile_hash: int, on_press: Callable[[OperatorAction, StateReport], None], patience: int = PATIENCE
    ) -> None:
        self.stops = 0
        self._patience = patience
        self._profile_hash = profile_hash
        self._on_press = on_press
        self._sequence = 0
        self._mode: int = Mode.BOOT
        self._since_ns = 0
        self._next_ns = 0

    @property
    def gave_up(self) -> bool:
        """Whether the machine has stopped too often to arm it once more."""
        return self.stops > self._patience

    def step(self, report: StateReport) -> bytes | None:
        """The operator command that a person would give on seeing this report, if any."""
        if report.mode != self._mode:
            self.stops += report.mode in STOPPED and self._mode not in STOPPED
            self._mode, self._since_ns = report.mode, report.stamp_ns
        action = {
            Mode.STANDBY: OperatorAction.ARM,
            Mode.STOP: OperatorAction.ARM,
            Mode.FAULT: OperatorAction.RESET,
        }
        looked = report.stamp_ns - self._since_ns >= LOOK_NS and report.stamp_ns >= self._next_ns
        if self._mode not in action or not looked or self.gave_up:
            return None
        self._next_ns = report.stamp_ns + REPEAT_NS
        self._sequence += 1
        press = action[Mode(self._mode)]
        self._on_press(press, report)
        return encode(OperatorCommand(self._sequence, self._profile_hash, report.stamp_ns, press))
