"""The swing-arm controller (source address 30h): spool commands of the four arms and the two float valves.

The spools follow ArmCmdA and the float valves ArmCmdB while both (E2E valid, ArmKey 0xA) and GuardAlive (Enable 0xA)
are at most 100 ms old, the commands are not late by their number (`can_dbc.protocols.punctuality`), and the emergency
stop is released.  Otherwise the arms hold: spools neutral, float valves closed.  A loss while active, and a command
that opens both float valves (which would let the machine roll), are a fault until fresh frames disarm.  The node
reports the heights on which the controller closes its loop.
"""

from __future__ import annotations

from collections.abc import Callable
from enum import IntEnum

from can_dbc.dbc.codec import Database
from can_dbc.protocols.punctuality import Punctuality
from sim.nodes import Outbox
from sim.nodes.j1939 import J1939Node
from sim.nodes.messages import ARM_KEY, MS, PeriodicTimer, ProtectedInput, ProtectedMessage

ADDRESS = 0x30
SUSPENSION_FUNCTION = 21  # J1939 NAME function of a suspension system controller
COMMAND_NS, GUARD_NS = 90 * MS, 100 * MS
CYCLE_NS = 20 * MS
ARM_COUNT = 4


class ArmState(IntEnum):
    """ArmHeightA.State."""

    HOLD = 0
    ACTIVE = 1
    FAULT = 3


class ArmNode(J1939Node):
    """The present outputs are ``spools`` (-1..1, + raises the frame; fl fr rl rr), ``float_front`` and ``float_rear``.

    The plant sets ``heights_mm`` relative to mid travel, ``roll_deg`` (+ right side down), ``pitch_deg`` (+ nose up).
    """

    def __init__(self, machine: Database, outbox: Outbox, pilot_on: Callable[[], bool]) -> None:
        super().__init__(ADDRESS, SUSPENSION_FUNCTION, machine, outbox)
        self._pilot_on = pilot_on
        self._a, self._b = (
            ProtectedInput(machine, name, Punctuality(CYCLE_NS, COMMAND_NS)) for name in ("ArmCmdA", "ArmCmdB")
        )
        self._guard = ProtectedInput(machine, "GuardAlive")
        self._inputs = {i.key: i for i in (self._a, self._b, self._guard)}
        self._height_a, self._height_b = (
            ProtectedMessage(machine, "ArmHeightA"),
            ProtectedMessage(machine, "ArmHeightB"),
        )
        self._period = PeriodicTimer(CYCLE_NS, phase_ns=5 * MS)
        self.heights_mm = (0.0,) * ARM_COUNT
        self.roll_deg = self.pitch_deg = 0.0
        self.state = ArmState.HOLD
        self._hold()

    def _hold(self) -> None:
        self.spools = [0.0] * ARM_COUNT
        self.float_front = self.float_rear = False

    def receive(self, key: int, data: bytes, now_ns: int) -> None:
        source = self._inputs.get(key)
        if source is None:
            super().receive(key, data, now_ns)
        elif source.accept(data, now_ns) and source is not self._guard and source.get("ArmKey") != ARM_KEY:
            self.state = ArmState.HOLD

    def decide(self, now_ns: int) -> None:
        """Set the outputs for this physics step."""
        a, b = self._a, self._b
        guarded = self._guard.fresh(now_ns, GUARD_NS) and self._guard.get("Enable") == ARM_KEY
        commanded = a.fresh(now_ns, COMMAND_NS) and b.fresh(now_ns, COMMAND_NS) and not (a.late or b.late)
        ready = commanded and guarded and self._pilot_on() and not self.address_lost
        armed = a.get("ArmKey") == b.get("ArmKey") == ARM_KEY
        front, rear = b.get("FloatFront") == 1, b.get("FloatRear") == 1
        if (self.state is ArmState.ACTIVE and not ready) or (ready and armed and front and rear):
            self.state = ArmState.FAULT
        elif self.state is not ArmState.FAULT:
            self.state = ArmState.ACTIVE if ready and armed else ArmState.HOLD
        if self.state is not ArmState.ACTIVE:
            self._hold()
            return
        self.spools = [(percent or 0.0) / 100.0 for percent in a.last(ARM_COUNT)]
        self.float_front, self.float_rear = front, rear

    def cycle(self, now_ns: int) -> None:
        if self._period.due(now_ns):
            self.outbox.append(self._height_a.frame(self.state, *self.heights_mm))
            floats = (int(self.float_front), int(self.float_rear))
            self.outbox.append(self._height_b.frame(self.state, *floats, self.roll_deg, self.pitch_deg))
