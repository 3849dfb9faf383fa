"""The simple nodes of crane0: NMT state, boot-up, heartbeat, emergency, identity; emergency stop, pressures.

Unlike an encoder these nodes start by themselves (boot-up, then operational); NMT can stop and reset them.  A node
that is not operational sends heartbeats and SDO answers only; its object dictionary holds what CiA 301 demands of
every node: device type, error register, heartbeat period and identity, read only.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from can_dbc.dbc.codec import Database
from can_dbc.messages.crane import ModeSwitch
from can_dbc.protocols.canopen import HEARTBEAT_BASE, HEARTBEAT_MS, CanopenSlave, Emergency, NodeState, emergency_frame
from machine.crane_nodes import CraneNode
from sim.hydraulics.layout import PA_PER_BAR
from sim.nodes import Outbox
from sim.nodes.messages import ARM_KEY, MS, PeriodicTimer, ProtectedInput, ProtectedMessage

HEARTBEAT_NS = HEARTBEAT_MS * MS
GUARD_NS = 50 * MS


class Device(CanopenSlave):
    """A node with NMT state and heartbeat."""

    def __init__(self, node: int, outbox: Outbox) -> None:
        super().__init__(node, {})
        self.outbox = outbox
        self._heartbeat = PeriodicTimer(HEARTBEAT_NS, phase_ns=node * MS)
        self._emergency = 0

    def receive_sdo(self, key: int, data: bytes) -> None:
        """Answer an SDO request to this node; others are ignored."""
        answer = self.sdo_answer(key, data)
        if answer is not None:
            self.outbox.append(answer)

    def set_emergency(self, code: int) -> None:
        """Set (CiA 301 emergency code) or clear (0) a fault of the node; a change is sent."""
        register = bytes((int(code != 0),))
        if code != self._emergency:
            self._emergency, self.objects[0x1001, 0] = code, register
            self.outbox.append(emergency_frame(Emergency(self.node, code, register[0], bytes(5))))

    def tick(self, now_ns: int) -> None:
        """Send boot-up, heartbeat, and the node's periodic frames."""
        if self.state == NodeState.BOOT_UP:
            self.outbox.append((HEARTBEAT_BASE + self.node, b"\x00"))
            self.state = NodeState.OPERATIONAL
        elif self._heartbeat.due(now_ns):
            self.outbox.append((HEARTBEAT_BASE + self.node, bytes((self.state,))))
        if self.operational:
            self.cycle(now_ns)

    def cycle(self, now_ns: int) -> None:
        """Send the periodic frames of an operational node."""


class EstopBox(Device):
    """Safety module: two channels, reset button, and the pilot supply: hard-wired relay and guard in series.

    ``press``, ``release`` and ``reset`` are its buttons, `move_lever` is what it sees of the hand levers, and
    ``mode_switch`` is the operator's, which `turn` turns.  `receive` takes GuardPilot; a machine whose guard does not
    switch the supply (behind a PLC) never calls `decide`.
    """

    RESET_PULSE_NS = 200 * MS
    PILOT_BAR = 35.0

    def __init__(self, database: Database, outbox: Outbox) -> None:
        super().__init__(CraneNode.SAFETY_MODULE, outbox)
        self._message = ProtectedMessage(database, "EstopStat")
        self._period = PeriodicTimer(10 * MS)
        self._channels = (1, 1)
        self._source = self._events = self._lever = 0
        self.mode_switch = ModeSwitch.NOT_FITTED
        self._reset_until_ns: int | None = None
        self._wants_reset = self._changed = False
        self.relay_on = self.guard_on = True
        self._guard = ProtectedInput(database, "GuardPilot")

    @property
    def channels(self) -> tuple[int, int]:
        """The two contacts: 1 closed (released), 0 open (pressed)."""
        return self._channels

    @property
    def pilot_on(self) -> bool:
        """Whether the pilot supply valve is open."""
        return self.relay_on and self.guard_on

    def receive(self, key: int, data: bytes, now_ns: int) -> None:
        """Accept a frame of the guard; others are ignored."""
        if key == self._guard.key:
            self._guard.accept(data, now_ns)

    def decide(self, now_ns: int) -> None:
        """Switch the pilot supply for this physics step."""
        self.guard_on = self._guard.fresh(now_ns, GUARD_NS) and self._guard.get("Supply") == ARM_KEY

    @property
    def reset_pressed(self) -> bool:
        """Whether the reset button is down."""
        return self._reset_until_ns is not None

    def press(self) -> None:
        """Open both contacts; the pilot supply drops at once and stays off until ``reset``."""
        self._channels, self._source, self.relay_on = (0, 0), 1, False
        self._event()

    def release(self) -> None:
        """Pull the button out again; the pilot supply stays off."""
        self._channels = (1, 1)
        self._event()

    def reset(self) -> None:
        """Press the reset button: with the stop released the pilot supply returns."""
        self._wants_reset = True
        if self._channels == (1, 1):
            self._source, self.relay_on = 0, True
        self._event()

    def move_lever(self, moved: bool) -> None:
        """Move a hand lever as a person does, or let go of it; what the lever does to the oil is not modelled."""
        self._lever = int(moved)
        self._event()

    def turn(self, mode_switch: ModeSwitch) -> None:
        """Turn the operator's mode switch."""
        self.mode_switch = mode_switch
        self._event()

    def _event(self) -> None:
        self._events = (self._events + 1) & 0xFF
        self._changed = True

    def cycle(self, now_ns: int) -> None:
        if self._wants_reset:
            self._wants_reset, self._reset_until_ns = False, now_ns + self.RESET_PULSE_NS
        if self._reset_until_ns is not None and now_ns >= self._reset_until_ns:
            self._reset_until_ns = None
            self._event()
        due = self._period.due(now_ns)
        if due or self._changed:
            self._changed = False
            reset = int(self._reset_until_ns is not None)
            pressure = self.PILOT_BAR if self.pilot_on else 0.0
            inputs = (*self._channels, self._source, reset, int(self.pilot_on), 0, self._lever)
            self.outbox.append(self._message.frame(*inputs, pressure, self._events, self.mode_switch))


class PressureModule(Device):
    """One of three modules with four transducers each; ``sense`` reads the pressures [Pa]."""

    def __init__(
        self,
        node: int,
        message: str,
        period_ns: int,
        database: Database,
        outbox: Outbox,
        sense: Callable[[], Sequence[float]],
    ) -> None:
        super().__init__(node, outbox)
        self._message, self._period = ProtectedMessage(database, message), PeriodicTimer(period_ns)
        self._sense = sense

    def cycle(self, now_ns: int) -> None:
        if self._period.due(now_ns):
            self.outbox.append(self._message.frame(0, *(p / PA_PER_BAR for p in self._sense())))
