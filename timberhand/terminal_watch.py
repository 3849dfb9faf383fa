"""The watch from a terminal: every heartbeat is an answer of the person's own terminal.

A program that runs on the machine's computer goes on when the network between it and the person is cut, and so would a
timer in it.  Therefore the terminal is asked five times a second whether it is there (DSR, ECMA-48 8.3.35); each answer
is a heartbeat with the time of its question as stamp.  `TerminalWatch` is pure: times and bytes in, stamps out;
`watch` is its shell.
"""

from __future__ import annotations

import contextlib
import os
import re
import select
import termios
import time
import tty
from collections import deque
from collections.abc import Callable
from typing import Final

from can_dbc.messages.crane import WATCH_PERIOD_NS
from runtime.errors import InputRefused

QUESTION: Final = b"\x1b[5n"
MAX_QUESTIONS: Final = 16
"""No more are asked while so many wait for an answer."""
FIRST_ANSWER_NS: Final = 3_000_000_000
_ANSWER: Final = re.compile(rb"\x1b\[[0-9]n")
_PART: Final = re.compile(rb"\x1b(\[[0-9]?)?\Z")
"""The beginning of an answer, at the end of what was read."""


class TerminalWatch:
    """``limit_ns``: an answer that took so long is no heartbeat."""

    def __init__(self, limit_ns: int) -> None:
        self._limit_ns = limit_ns
        self._asked: deque[int] = deque()
        self._next_ns = 0
        self._begun_ns = 0
        self._rest = b""
        self._answered = False

    def ask(self, now_ns: int) -> bool:
        """Tell whether to ask now.

        Raises:
            InputRefused: it has never answered.
        """
        self._begun_ns = self._begun_ns or now_ns
        if not self._answered and now_ns - self._begun_ns >= FIRST_ANSWER_NS:
            raise InputRefused(
                "operator.silent-terminal",
                "this terminal does not answer (DSR), so a lost link would not be seen; use another, or the page",
            )
        if now_ns < self._next_ns or len(self._asked) >= MAX_QUESTIONS:
            return False
        self._next_ns = now_ns + WATCH_PERIOD_NS
        self._asked.append(now_ns)
        return True

    def read(self, data: bytes, now_ns: int) -> int | None:
        """Return the stamp of the newest heartbeat in what the terminal sent, None for none; keys are ignored."""
        text = self._rest + data
        part = _PART.search(text)
        self._rest = part[0] if part else b""
        stamp_ns: int | None = None
        for _ in range(min(len(_ANSWER.findall(text)), len(self._asked))):
            self._answered = True
            asked_ns = self._asked.popleft()
            if now_ns - asked_ns < self._limit_ns:
                stamp_ns = asked_ns
        return stamp_ns


def _read(reading: int) -> bytes:
    data = b""
    with contextlib.suppress(OSError):
        data = os.read(reading, 1024)
    if not data:
        raise InputRefused("operator.terminal-gone", "the terminal is gone, so nobody watches: the machine holds")
    return data


def watch(send: Callable[[int], None], limit_ns: int, reading: int = 0, writing: int = 1) -> None:
    """Call ``send`` with the stamp of every heartbeat, until KeyboardInterrupt; ``reading`` and ``writing`` are the
    file descriptors of the terminal.

    Raises:
        InputRefused: it is none, or does not answer.
    """
    if not (os.isatty(reading) and os.isatty(writing)):
        raise InputRefused(
            "operator.no-terminal", "input and output are no terminal, so nobody can be there; run it in one"
        )
    before = termios.tcgetattr(reading)
    tty.setcbreak(reading)  # an answer comes without a line's end, and Ctrl-C still interrupts
    try:
        terminal = TerminalWatch(limit_ns)
        while True:
            if terminal.ask(time.monotonic_ns()):
                os.write(writing, QUESTION)
            if select.select([reading], [], [], WATCH_PERIOD_NS * 0.25e-9)[0]:
                stamp_ns = terminal.read(_read(reading), time.monotonic_ns())
                if stamp_ns is not None:
                    send(stamp_ns)
    finally:
        termios.tcsetattr(reading, termios.TCSANOW, before)
