"""What the simple nodes share: NMT state, boot-up, heartbeat, E2E frames; the E-stop box and the pressure modules.

Unlike an encoder these nodes start by themselves (boot-up, then operational); NMT can stop and reset them.  A node
that is not operational sends heartbeats only.
"""

from __future__ import annotations

from can_dbc.canopen import HEARTBEAT_BASE, NmtCommand, NodeState
from can_dbc.codec import Database
from can_dbc.e2e import Sender
from sim.nodes import Outbox

HEARTBEAT_NS = 100_000_000
MS = 1_000_000
PA_PER_BAR = 1e5


class Every:
    """A period on virtual time."""

    def __init__(self, period_ns: int, phase_ns: int = 0) -> None:
        self._period, self._next = period_ns, phase_ns

    def due(self, now_ns: int) -> bool:
        """Whether the period has come round since the last call; a late caller gets one, not a burst."""
        if now_ns < self._next:
            return False
        self._next += self._period * max(1, -(-(now_ns - self._next + 1) // self._period))
        return True


class ProtectedMessage:
    """Encodes one E2E message of the DBC; values in signal order without Crc and Counter."""

    def __init__(self, database: Database, name: str) -> None:
        codec = database.message(name)
        if codec.data_ids is None:
            raise ValueError(f"{name} in the DBC has no E2E Data IDs")
        self.key, self._encode, self._sender = codec.key, codec.encode, Sender(codec.data_ids)

    def frame(self, *values: float) -> tuple[int, bytes]:
        """The next frame."""
        return self.key, self._sender.protect(self._encode(0, 0, *values))


class Device:
    """A node with NMT state and heartbeat."""

    def __init__(self, node: int, outbox: Outbox) -> None:
        self.node, self.outbox = node, outbox
        self.state = NodeState.BOOT_UP
        self._heartbeat = Every(HEARTBEAT_NS, phase_ns=node * MS)

    @property
    def operational(self) -> bool:
        return self.state == NodeState.OPERATIONAL

    def receive_nmt(self, data: bytes) -> None:
        """An NMT command frame."""
        if len(data) != 2 or data[1] not in (0, self.node):
            return
        match data[0]:
            case NmtCommand.START:
                self.state = NodeState.OPERATIONAL
            case NmtCommand.STOP:
                self.state = NodeState.STOPPED
            case NmtCommand.ENTER_PRE_OPERATIONAL:
                self.state = NodeState.PRE_OPERATIONAL
            case NmtCommand.RESET_NODE | NmtCommand.RESET_COMMUNICATION:
                self.state = NodeState.BOOT_UP
                self.restart()

    def restart(self) -> None:
        """Forget run-time state after an NMT reset."""

    def tick(self, now_ns: int) -> None:
        """Boot-up, heartbeat, and what the device sends by itself."""
        if self.state == NodeState.BOOT_UP:
            self.outbox.append((HEARTBEAT_BASE + self.node, b"\x00"))
            self.state = NodeState.OPERATIONAL
        elif self._heartbeat.due(now_ns):
            self.outbox.append((HEARTBEAT_BASE + self.node, bytes((self.state,))))
        if self.operational:
            self.cycle(now_ns)

    def cycle(self, now_ns: int) -> None:
        """Periodic frames of an operational node."""


class EstopBox(Device):
    """Safety module: two channels, reset button, hard-wired pilot supply.

    ``press``, ``release`` and ``reset`` are its buttons.
    """

    RESET_PULSE_NS = 200 * MS
    PILOT_BAR = 35.0

    def __init__(self, database: Database, outbox: Outbox) -> None:
        super().__init__(0x01, outbox)
        self._message = ProtectedMessage(database, "EstopStat")
        self._period = Every(10 * MS)
        self._channels = (1, 1)
        self._source = self._events = 0
        self._reset_until_ns: int | None = None
        self._wants_reset = self._changed = False
        self.pilot_on = True

    def press(self) -> None:
        """Both contacts open; the pilot supply drops at once and stays off until ``reset``."""
        self._channels, self._source, self.pilot_on = (0, 0), 1, False
        self._event()

    def release(self) -> None:
        """Pull the button out again; the pilot supply stays off."""
        self._channels = (1, 1)
        self._event()

    def reset(self) -> None:
        """Press the reset button: with the stop released the pilot supply returns."""
        self._wants_reset = True
        if self._channels == (1, 1):
            self._source, self.pilot_on = 0, True
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
            self.outbox.append(
                self._message.frame(*self._channels, self._source, reset, int(self.pilot_on), 0, pressure, self._events)
            )


class PressureModule(Device):
    """One of three modules with four transducers each; ``pressures_pa`` is what they feel."""

    def __init__(self, node: int, message: str, period_ns: int, database: Database, outbox: Outbox) -> None:
        super().__init__(node, outbox)
        self._message, self._period = ProtectedMessage(database, message), Every(period_ns)
        self.pressures_pa: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0)

    def cycle(self, now_ns: int) -> None:
        if self._period.due(now_ns):
            self.outbox.append(self._message.frame(0, *(p / PA_PER_BAR for p in self.pressures_pa)))
