"""A machine of one's own: a crane on the desk whose joints move as fast as their valves are open, without hydraulics.

Replace the integration by your own simulator, or by the inputs and outputs of your controller card.
"""

from __future__ import annotations

import time
from collections.abc import Callable

from can_dbc.dbc.codec import load
from can_dbc.plc.map import N_AXES, Command, Feedback, Mode, State
from can_dbc.protocols.e2e import Sender

START = (0.1, 0.7, -1.6, 0.5, 0.0)
"""Slew, lift, tilt [rad], telescope [m], rotator [rad] at the start."""
FULL_SPEED = (0.5, 0.22, 0.4, 0.3, 1.2)
"""Speed of each joint with its valve fully open [rad/s, m/s]."""
DEAD_BAND = 0.12
"""A valve is shut below this share of its full opening."""
SILENCE_NS = 50_000_000
"""Without a command for this long the valves are neutral."""


class DeskCrane:
    """Connect, act, observe, disconnect (the contract of `can_dbc.plc.machine.Machine`), in role "valves"."""

    def __init__(self, clock_ns: Callable[[], int] = time.monotonic_ns) -> None:
        self._clock_ns = clock_ns
        self._connected = False
        self._estop = load("crane").message("EstopStat")
        self._safety = Sender(self._estop.data_ids or bytes(16))
        self._position, self._cycles, self._command = list(START), 0, Command()
        self._acted_ns = self._moved_ns = clock_ns()

    def connect(self) -> None:
        """Connect; a real machine opens its socket here.  Until the first command its valves are neutral."""
        self._connected, self._command = True, Command()

    def act(self, command: Command) -> None:
        """Give the valves the shares of full opening in ``command.reference`` from now on."""
        if not self._connected:
            raise OSError("the desk is not connected")
        self._move()
        self._command, self._acted_ns = command, self._clock_ns()

    def observe(self) -> Feedback:
        """Return the joints as the encoders measure them now, and the safety module's frame."""
        if not self._connected:
            raise OSError("the desk is not connected")
        self._move()
        self._cycles += 1
        # Both channels closed and the pilot supply on; a real one comes from the safety module, as it sent it.
        values = {"ChannelA": 1, "ChannelB": 1, "PilotSupply": 1}
        estop = self._estop.encode(*(values.get(signal.name, 0) for signal in self._estop.signals))
        return Feedback(
            heartbeat=self._cycles & 0xFFFF,
            state=State.EXECUTE if self._commanded() else State.HOLD,
            position=(*self._position, *(0.0,) * (N_AXES - len(START))),
            opening=1.0,
            estop_frame=self._safety.protect(estop),
            sampled_us=self._clock_ns() // 1000 & 0xFFFF,
            output=self._command.reference if self._commanded() else (0.0,) * N_AXES,
        )

    def disconnect(self) -> None:
        """Disconnect; nothing moves any more."""
        self._move()
        self._connected, self._command = False, Command()

    def _commanded(self) -> bool:
        fresh = self._clock_ns() - self._acted_ns <= SILENCE_NS
        return fresh and self._command.armed and self._command.mode is Mode.VALVES

    def _move(self) -> None:
        now_ns = self._clock_ns()
        elapsed_s, self._moved_ns = (now_ns - self._moved_ns) * 1e-9, now_ns
        if not self._commanded():
            return
        for i, full in enumerate(FULL_SPEED):
            opening = self._command.reference[i]
            open_share = max(0.0, abs(opening) - DEAD_BAND) / (1.0 - DEAD_BAND)
            self._position[i] += (full if opening > 0.0 else -full) * open_share * elapsed_s
