"""The bridge's half of the handshake with the PLC: sequence numbers and heartbeats out, checked answers in.

Pure.  A command gets a sequence number and a heartbeat; the PLC's echo of the number gives the round-trip time, and
proves how old an answer can be at most: one to a command of more than 50 ms ago is refused.  The PLC is alive while its
own heartbeat changes.  An answer that is damaged, of another map or of another word order is not used at all;
``problem`` tells why.

Over UDP every datagram belongs to a session, whose number the PLC draws.  Without one the bridge asks for it with
neutral commands of session 0 (hello); only an answer to one of these begins a session.  Within it the numbers of both
sides only increase, whatever the silence between; after 300 ms without a good answer the session is over.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

from can_dbc.plc import datagram
from can_dbc.plc import map as plc
from can_dbc.plc.datagram import Header
from can_dbc.plc.machine import Machine
from can_dbc.plc.map import Command, Feedback, MapError, State, WordOrder
from can_dbc.timing.durations import Durations
from runtime.errors import InputRefused

FRESH_NS: Final = 50_000_000
"""After this long without a good answer nothing of the PLC is passed on (docs/reference/can-bus.md section 10:
hold).
"""
SESSION_NS: Final = plc.WATCHDOG_DEFAULT_MS * 1_000_000
"""After this long the PLC has ended the session by its own watchdog."""
_U32: Final = 0xFFFF_FFFF
_SENT_COUNT: Final = 64
"""Number of sent commands whose time is kept for the round trip."""


class Handshake:
    """One exchange with a PLC.  ``feedback`` is its newest good answer, None before the first.

    ``sessions`` counts the conversations that began: sessions over UDP, connections otherwise.  ``replayed``
    counts datagrams that were good and old: of another session, with a number that is not new, or to an old command.
    """

    def __init__(
        self, order: WordOrder = WordOrder.HIGH_FIRST, *, key: bytes | None = None, first_sequence: int = 0
    ) -> None:
        """``key`` authenticates datagrams; a ``first_sequence`` that nobody can guess makes old answers worthless."""
        self.order = order
        self.feedback: Feedback | None = None
        self.round_trip = Durations()
        self.sent = self.answers = self.refused = self.dropped = self.replayed = self.sessions = 0
        self.problem = "The PLC has not answered yet."
        self._key = key
        self._sequence = first_sequence
        self._session = self._echo = 0
        self._hellos = 0  # commands of session 0 in a row
        self._sent_ns = [0] * _SENT_COUNT
        self._alive_ns = self._acknowledged_ns = 0

    def fresh(self, now_ns: int) -> bool:
        """Tell whether the PLC lives and has read its inputs: a good answer with a new heartbeat, at most 50 ms ago."""
        feedback = self.feedback
        return feedback is not None and feedback.state is not State.INIT and now_ns - self._alive_ns <= FRESH_NS

    def acknowledged(self, now_ns: int) -> bool:
        """Tell whether the PLC accepts the commands: it echoed a newer one at most 50 ms ago."""
        return now_ns - self._acknowledged_ns <= FRESH_NS and self._acknowledged_ns > 0

    def connected(self) -> None:
        """Count a connection that has been made."""
        self.sessions += 1

    def registers(self, command: Command, now_ns: int) -> list[int]:
        """Build the command block of the next Modbus exchange; raises MapError."""
        block = plc.command_registers(command, self._sequence + 1, self._sequence + 1, self.order)
        self._note_sent(now_ns)
        return block

    def datagram(self, command: Command, now_ns: int) -> bytes:
        """Build the next UDP command, a hello while there is no session; raises MapError."""
        if self._session and now_ns - self._alive_ns > SESSION_NS:
            self._session = self._echo = 0
        self._hellos = 0 if self._session else self._hellos + 1
        header = Header(self._session, self._sequence + 1, now_ns // 1000, self._echo)
        data = datagram.encode_command(header, command if self._session else Command(), self._key)
        self._note_sent(now_ns)
        return data

    def exchange(self, machine: Machine, command: Command, now_ns: int) -> bool:
        """Make one exchange with a machine in this process, which takes every command; raises what it raises."""
        self._note_sent(now_ns)
        machine.act(command)
        return self._accept(replace(machine.observe(), accepted=self._sequence & 0xFFFF), now_ns)

    def accept_registers(self, registers: Sequence[int], now_ns: int) -> bool:
        """Use the status block of an exchange; False, and nothing used, when it is of another map or late."""
        try:
            feedback, _ = plc.read_status(registers, self.order)
        except MapError as error:
            self.dropped += 1
            self.problem = f"{error}."
            return False
        if self.sent and now_ns - self._sent_ns[self._sequence % _SENT_COUNT] > FRESH_NS:
            self.dropped += 1
            self.problem = "The PLC's answer came too late."
            return False
        return self._accept(feedback, now_ns)

    def accept_datagram(self, data: bytes, now_ns: int) -> bool:
        """Use a UDP reply; False when it is damaged or old."""
        try:
            header, feedback = datagram.decode_reply(data, self._key)
        except InputRefused as refused:
            self.dropped += 1
            self.problem = f"A datagram was refused: {refused}."
            return False
        if not self._is_new(header, now_ns):
            self.replayed += 1
            return False
        if header.session != self._session:
            self._session = header.session
            self.sessions += 1
        self._echo = header.sequence
        return self._accept(feedback, now_ns)

    def exchange_failed(self, why: str) -> None:
        """Count an exchange that failed, and note the reason."""
        self.dropped += 1
        self.problem = f"{why}."

    def command_refused(self, code: int) -> None:
        """Count a command that the PLC answered with a Modbus exception."""
        self.refused += 1
        self.problem = f"The PLC refused a command with Modbus exception {code}."

    def _note_sent(self, now_ns: int) -> None:
        self._sequence = (self._sequence + 1) & _U32
        self.sent += 1
        self._sent_ns[self._sequence % _SENT_COUNT] = now_ns

    def _is_new(self, header: Header, now_ns: int) -> bool:
        """Tell whether a reply answers a command of the last 50 ms, in this session or to begin one."""
        behind = (self._sequence - header.echo) & _U32
        sent_ns = self._sent_before_ns(behind)
        if sent_ns is None or now_ns - sent_ns > FRESH_NS:
            return False
        if self._session:
            return header.session == self._session and header.sequence > self._echo
        return header.session != 0 and behind < self._hellos

    def _sent_before_ns(self, behind: int) -> int | None:
        """Tell when the command was sent that is ``behind`` the newest one; None for one never sent, or long ago."""
        known = behind < min(self.sent, _SENT_COUNT)
        return self._sent_ns[(self._sequence - behind) % _SENT_COUNT] if known else None

    def _accept(self, feedback: Feedback, now_ns: int) -> bool:
        self.answers += 1
        before = self.feedback
        if before is None or feedback.heartbeat != before.heartbeat:
            self._alive_ns = now_ns
        if before is None or feedback.accepted != before.accepted:
            self._note_echo(feedback.accepted, now_ns)
        self.feedback, self.problem = feedback, ""
        return True

    def _note_echo(self, accepted: int, now_ns: int) -> None:
        """Measure the round trip of the newest command that the PLC echoes; a foreign number proves nothing."""
        sent_ns = self._sent_before_ns((self._sequence - accepted) & 0xFFFF)
        if sent_ns is not None:
            self._acknowledged_ns = now_ns
            self.round_trip.add(now_ns - sent_ns)
