"""The PLC's command arbiter: registers and datagrams in, at most one commander, every command checked as a whole.

Pure.  A write changes the writer's own draft of the command block; writing a sequence register that advances commits
the draft, as a whole or not at all.  The commander keeps the command until its heartbeat has been missing for the
watchdog's time, or its connection has ended; until then others may read, and their writes are answered "busy".  A
value out of range is refused, latched as a fault, and changes nothing; nothing is clamped.
"""

from __future__ import annotations

import secrets
from collections.abc import Callable, Hashable, Sequence
from functools import partial

from can_dbc.plc import map as plc
from can_dbc.plc.datagram import Header, decode_command
from can_dbc.plc.map import Bounds, Command, Fault, MapError, Mode, WordOrder
from can_dbc.plc.modbus import RegisterRefused
from runtime.errors import InputRefused

# -- The PLC's half of the handshake over UDP: sessions, numbers that only increase, and proof that a datagram is
# new.
#
# Pure.  A hello (session 0, neutral) gets an offer: a number that was never used.  The first command with that
# number opens the session and ends the one before; it must be neutral too.  Within a session a command counts when
# its number is greater than every one before, whatever the silence between, and when it echoes a reply of the last
# 50 ms.  So a recorded datagram never counts again: not after a silence, not after a restart of either side.


MAX_ECHO_NS = 50_000_000
SENT_COUNT = 64  # replies whose time is kept


def is_neutral(command: Command) -> bool:
    """Tell whether a command may begin a session."""
    return command.mode is Mode.NEUTRAL and not command.armed and not command.reset and not command.grapple


class Session:
    """``number`` of the open session, 0 without one, and its ``client``; ``draw`` gives random 32-bit numbers."""

    def __init__(self, draw: Callable[[], int]) -> None:
        self._draw = draw
        self.number = self._offer = 0
        self.client: Hashable = None
        self._offered_to: Hashable = None
        self._sequence = self._hello = 0
        self._replies = 0
        self._sent_ns = [0] * SENT_COUNT

    def close(self) -> None:
        """End the session; the next command needs a new one."""
        self.number = 0

    def greet(self, client: Hashable, hello: Header, now_ns: int) -> Header:
        """Offer a session to whoever asks for one, in the answer with this header; an open one goes on until then."""
        if client != self._offered_to or not self._offer:
            self._offer = 0
            while self._offer in (0, self.number):
                self._offer = self._draw()
            self._offered_to = client
        self._hello = hello.sequence
        return self._header(self._offer, hello.sequence, now_ns)

    def admits(self, client: Hashable, header: Header, command: Command, now_ns: int) -> bool:
        """Tell whether a command is new; its number is then used up.

        The number of one that only echoes an old reply is used up too, so that the next reply echoes it: after a
        silence in both directions this is how the two ends find each other again.
        """
        current, member = self._echoes(header.echo, now_ns), (header.session, client)
        if self._offer and member == (self._offer, self._offered_to):
            if not current or header.sequence <= self._hello or not is_neutral(command):
                return False
            self.number, self.client, self._offer = self._offer, client, 0
        elif not self.number or member != (self.number, self.client) or header.sequence <= self._sequence:
            return False
        self._sequence = header.sequence
        return current

    def reply_header(self, now_ns: int) -> Header:
        """Make the header of the next reply in the open session."""
        return self._header(self.number, self._sequence, now_ns)

    def _header(self, session: int, echo: int, now_ns: int) -> Header:
        self._replies += 1
        self._sent_ns[self._replies % SENT_COUNT] = now_ns
        return Header(session, self._replies, now_ns // 1000, echo)

    def _echoes(self, echo: int, now_ns: int) -> bool:
        """Tell whether a number is that of a reply of the last 50 ms."""
        behind = self._replies - echo
        known = 0 <= behind < min(self._replies, SENT_COUNT)
        return known and now_ns - self._sent_ns[echo % SENT_COUNT] <= MAX_ECHO_NS


# -- The PLC's command arbiter


MS = 1_000_000
MAX_DRAFT_COUNT = 16  # clients whose uncommitted drafts are stored


class CommandArbiter:
    """The commanding side of the PLC.  ``command`` is the newest accepted one; times are in ns.  ``replayed`` counts
    datagrams that were good and not new.
    """

    def __init__(
        self, bounds: Bounds, order: WordOrder, draw: Callable[[], int] | None = None, key: bytes | None = None
    ) -> None:
        """Create the arbiter; ``draw`` numbers UDP sessions, by default at random; ``key`` authenticates datagrams."""
        self._bounds, self.order = bounds, order
        self.watchdog_ms = plc.WATCHDOG_DEFAULT_MS
        self.command = Command()
        self.sequence = 0
        self.fault, self.fault_axis = Fault.NONE, plc.NO_AXIS
        self.accepted = self.refused = self.dropped = self.replayed = 0
        self.session = Session(draw or partial(secrets.randbits, 32))
        self.key = key
        self._neutral = plc.command_registers(self.command, 0, 0, order)
        self._block = self._neutral
        self._drafts: dict[Hashable, list[int]] = {}
        self._commander: Hashable = None
        self._accepted_ns = self._alive_ns = 0
        self._reset_seen = self._commander_disconnected = False

    def commander(self, now_ns: int) -> Hashable:
        """Return the client that commands now; None without one."""
        alive = self._commander is not None and now_ns - self._alive_ns <= self.watchdog_ms * MS
        return self._commander if alive else None

    def disconnected(self, client: Hashable) -> None:
        """Record that the client's connection has ended.

        Its command stays valid for the usual time, but any client may take over.
        """
        self._drafts.pop(client, None)
        self._commander_disconnected = self._commander_disconnected or (
            client is not None and client == self._commander
        )

    def commanded(self) -> bool:
        """Tell whether any client has commanded since the last `release`."""
        return self._commander is not None

    def age_ns(self, now_ns: int) -> int:
        """Return the age of the newest accepted command."""
        return now_ns - self._accepted_ns

    def release(self) -> None:
        """End the command and the session; the next command may come from any client."""
        self._commander = None
        self.command = Command()
        self.session.close()

    def latch_fault(self, fault: Fault, axis: int = plc.NO_AXIS) -> None:
        """Keep the first fault until a reset."""
        if self.fault is Fault.NONE:
            self.fault, self.fault_axis = fault, axis

    def take_reset_edge(self) -> bool:
        """Tell whether the newest command began to request a reset; faults are then cleared."""
        before, self._reset_seen = self._reset_seen, self.command.reset
        edge = self._reset_seen and not before
        if edge:
            self.fault, self.fault_axis = Fault.NONE, plc.NO_AXIS
        return edge

    def write(self, client: Hashable, address: int, values: Sequence[int], now_ns: int) -> None:
        """Take a Modbus write.

        Raises:
            RegisterRefused: wrong address, illegal value or another commander; nothing has changed.
        """
        last = address + len(values)
        if address == plc.WATCHDOG_AT and len(values) == 1:
            self._require_command_right(client, now_ns)
            if not plc.WATCHDOG_MS[0] <= values[0] <= plc.WATCHDOG_MS[1]:
                self._refuse_value(MapError("plc.watchdog-out-of-range", "the watchdog time is out of range"))
            self.watchdog_ms = values[0]
            return
        if not (address >= plc.COMMAND_AT and last <= plc.COMMAND_AT + plc.COMMAND_COUNT):
            raise RegisterRefused(RegisterRefused.ADDRESS)
        self._require_command_right(client, now_ns)
        draft = list(self._drafts.get(client, self._neutral))
        draft[address - plc.COMMAND_AT : last - plc.COMMAND_AT] = values
        try:
            for offset, value in enumerate(values):
                plc.check_single(address + offset, value)
            if address <= plc.SEQUENCE_AT < last:
                self._commit(client, draft, now_ns)
        except MapError as error:
            self._refuse_value(error)
        if address <= plc.HEARTBEAT_AT < last and client == self._commander:
            if draft[0] != self._block[0]:
                self._alive_ns = now_ns
            self._block = [draft[0], *self._block[1:]]
        self._remember(client, draft)

    def _commit(self, client: Hashable, draft: list[int], now_ns: int) -> None:
        sequence = draft[plc.SEQUENCE_AT - plc.COMMAND_AT]
        command = plc.read_command(draft, self.order)
        if client != self.commander(now_ns) or plc.advances(sequence, self.sequence):
            self._accept(client, sequence, command, now_ns)
            self._block = list(draft)

    def datagram(self, client: Hashable, data: bytes, now_ns: int) -> Header | None:
        """Take a UDP command.  A damaged or old one, and one of a stranger, is dropped and counted.

        Returns the header of the answer to a hello, which is due at once, and None for every other datagram.
        """
        try:
            header, command = decode_command(data, self.key)
            if not self._may_command(client, now_ns):
                self.dropped += 1
            elif not header.session:
                return self.session.greet(client, header, now_ns)
            elif self.session.admits(client, header, command, now_ns):
                self._accept(client, header.sequence, command, now_ns)
            else:
                self.replayed += 1
        except InputRefused:
            self.dropped += 1
        except MapError as error:
            if self._may_command(client, now_ns):
                self.latch_fault(Fault.ILLEGAL_VALUE, error.axis)
            self.refused += 1
        return None

    def _accept(self, client: Hashable, sequence: int, command: Command, now_ns: int) -> None:
        """Take a new command; raises MapError."""
        self._bounds.check(command)
        self.command, self.sequence, self._commander = command, sequence, client
        self._accepted_ns = self._alive_ns = now_ns
        self._commander_disconnected = False
        self.accepted += 1

    def _may_command(self, client: Hashable, now_ns: int) -> bool:
        """Tell whether this client may command."""
        return self._commander_disconnected or self.commander(now_ns) in (None, client)

    def _require_command_right(self, client: Hashable, now_ns: int) -> None:
        if not self._may_command(client, now_ns):
            raise RegisterRefused(RegisterRefused.BUSY)

    def _refuse_value(self, error: MapError) -> None:
        self.refused += 1
        self.latch_fault(Fault.ILLEGAL_VALUE, error.axis)
        raise RegisterRefused(RegisterRefused.VALUE) from error

    def _remember(self, client: Hashable, draft: list[int]) -> None:
        self._drafts.pop(client, None)
        self._drafts[client] = draft
        while len(self._drafts) > MAX_DRAFT_COUNT:
            self._drafts.pop(next(iter(self._drafts)))

    def command_block(self) -> list[int]:
        """Return the accepted command block, for reading back."""
        return list(self._block)
