"""The PLC's half of the handshake over UDP: sessions, numbers that only increase, and proof that a datagram is new.

Pure.  A hello (session 0, neutral) gets an offer: a number that was never used.  The first command with that number
opens the session and ends the one before; it must be neutral too.  Within a session a command counts when its number is
greater than every one before, whatever the silence between, and when it echoes a reply of the last 50 ms.  So a
recorded datagram never counts again: not after a silence, not after a restart of either side.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable

from can_dbc.plc.datagram import Header
from can_dbc.plc.map import Command, Mode

MAX_ECHO_NS = 50_000_000
SENT_COUNT = 64  # replies whose time is kept


def is_neutral(command: Command) -> bool:
    """Whether a command may begin a session."""
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
        """Whether a command is new; its number is then used up.

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
        """The header of the next reply in the open session."""
        return self._header(self.number, self._sequence, now_ns)

    def _header(self, session: int, echo: int, now_ns: int) -> Header:
        self._replies += 1
        self._sent_ns[self._replies % SENT_COUNT] = now_ns
        return Header(session, self._replies, now_ns // 1000, echo)

    def _echoes(self, echo: int, now_ns: int) -> bool:
        """Whether a number is that of a reply of the last 50 ms."""
        behind = self._replies - echo
        known = 0 <= behind < min(self._replies, SENT_COUNT)
        return known and now_ns - self._sent_ns[echo % SENT_COUNT] <= MAX_ECHO_NS
