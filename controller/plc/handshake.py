"""The bridge's half of the handshake with the PLC: sequence numbers and heartbeats out, checked answers in.

Pure.  A command gets a sequence number and a heartbeat; the PLC's echo of the number gives the round-trip time.  The
PLC is alive while its own heartbeat changes.  An answer that is damaged, of another map or of another word order is not
used at all; ``problem`` tells why.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from can_dbc.plc import datagram
from can_dbc.plc import map as plc
from can_dbc.plc.datagram import DatagramRefused, Header
from can_dbc.plc.map import Command, Feedback, MapError, State, WordOrder
from can_dbc.timing.durations import Durations

FRESH_NS: Final = 50_000_000
"""After this long without a good answer nothing of the PLC is passed on (docs/reference/can-bus.md section 10:
hold).
"""
_SENT_COUNT: Final = 64
"""Number of sent commands whose time is kept for the round trip."""


class Handshake:
    """One exchange with a PLC.  ``feedback`` is its newest good answer, None before the first."""

    def __init__(self, order: WordOrder = WordOrder.HIGH_FIRST) -> None:
        self.order = order
        self.feedback: Feedback | None = None
        self.round_trip = Durations()
        self.sent = self.answers = self.refused = self.dropped = 0
        self.problem = "The PLC has not answered yet."
        self._sequence = 0
        self._echo = 0
        self._sent_ns = [0] * _SENT_COUNT
        self._sent_as = [-1] * _SENT_COUNT
        self._alive_ns = self._acknowledged_ns = 0

    def fresh(self, now_ns: int) -> bool:
        """Whether the PLC is alive and has read its inputs: a good answer with a new heartbeat, at most 50 ms ago."""
        feedback = self.feedback
        return feedback is not None and feedback.state is not State.INIT and now_ns - self._alive_ns <= FRESH_NS

    def acknowledged(self, now_ns: int) -> bool:
        """Whether the PLC accepts the commands: it echoed a newer one at most 50 ms ago."""
        return now_ns - self._acknowledged_ns <= FRESH_NS and self._acknowledged_ns > 0

    def registers(self, command: Command, now_ns: int) -> list[int]:
        """The command block of the next Modbus exchange; raises MapError."""
        block = plc.command_registers(command, self._sequence + 1, self._sequence + 1, self.order)
        self._note_sent(now_ns)
        return block

    def datagram(self, command: Command, now_ns: int) -> bytes:
        """The next UDP command; raises MapError."""
        data = datagram.encode_command(Header(self._sequence + 1, now_ns // 1000, self._echo), command)
        self._note_sent(now_ns)
        return data

    def accept_registers(self, registers: Sequence[int], now_ns: int) -> bool:
        """Use the status block of an exchange; False, and nothing used, when it is of another map."""
        try:
            feedback, _ = plc.read_status(registers, self.order)
        except MapError as error:
            self.dropped += 1
            self.problem = f"{error}."
            return False
        return self._accept(feedback, now_ns)

    def accept_datagram(self, data: bytes, now_ns: int) -> bool:
        """Use a UDP reply; False when it is damaged or old."""
        try:
            header, feedback = datagram.decode_reply(data)
        except DatagramRefused as refused:
            self.dropped += 1
            self.problem = f"A datagram was refused: {refused}."
            return False
        if self.fresh(now_ns) and not plc.advances(header.sequence, self._echo, 32):
            self.dropped += 1
            return False
        self._echo = header.sequence
        return self._accept(feedback, now_ns)

    def exchange_failed(self, why: str) -> None:
        """The exchange failed."""
        self.dropped += 1
        self.problem = f"{why}."

    def command_refused(self, code: int) -> None:
        """The PLC answered with a Modbus exception."""
        self.refused += 1
        self.problem = f"The PLC refused a command with Modbus exception {code}."

    def _note_sent(self, now_ns: int) -> None:
        self._sequence += 1
        self.sent += 1
        place = self._sequence % _SENT_COUNT
        self._sent_ns[place], self._sent_as[place] = now_ns, self._sequence & 0xFFFF

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
        behind = (self._sequence - accepted) & 0xFFFF
        if behind >= _SENT_COUNT:
            return
        place = (self._sequence - behind) % _SENT_COUNT
        if self._sent_as[place] == accepted:
            self._acknowledged_ns = now_ns
            self.round_trip.add(now_ns - self._sent_ns[place])
            self._sent_as[place] = -1
