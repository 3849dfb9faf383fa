"""What a person asks for, heard by the guard itself: an operator's socket of its own, apart from the controller's.

Who is heard there: `controller.process.operator_socket`.  STOP counts whatever key, age or order it carries, and ARM
only for the file of the guard's own profile.
"""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import Final

from can_dbc.messages.crane import OperatorAction, OperatorCommand
from can_dbc.messages.datagrams import decode
from can_dbc.messages.envelope import DatagramRefused
from controller.guard.layout import GuardConfigError
from controller.process.operator_socket import OperatorSocket

AGE_NS: Final = 1_000_000_000


def action_of(command: bytes, after_ns: int, now_ns: int, profile_check: int | None = None) -> tuple[int, int]:
    """Read action and stamp [ns] of a command, (0, ``after_ns``) if it is worth nothing; each is newer than the last.

    ``profile_check``: of the file that an ARM must be meant for; None: any, in virtual time.
    """
    with contextlib.suppress(DatagramRefused):
        message = decode(command)
        if isinstance(message, OperatorCommand):
            if message.action is OperatorAction.STOP:
                return message.action, after_ns
            if message.action is OperatorAction.ARM and profile_check not in (None, message.profile_check):
                return 0, after_ns
            if max(after_ns, now_ns - AGE_NS) < message.stamp_ns <= now_ns:
                return message.action, message.stamp_ns
    return 0, after_ns


class OperatorActions:
    """What comes on the operator's socket at ``path``, for `Envelope.profile_check`; raises GuardConfigError if it
    cannot be bound.
    """

    __slots__ = ("_after_ns", "_profile_check", "_socket")

    def __init__(self, path: Path, profile_check: int) -> None:
        self._after_ns, self._profile_check = 0, profile_check
        try:
            self._socket = OperatorSocket(path)
        except OSError as error:
            raise GuardConfigError(
                "guard.operator",
                f"{path}: no socket for the operator there: {error.strerror}; give another --operator.",
            ) from error

    def receive(self, now_ns: int) -> list[int]:
        """Return the actions that have come, 0 for what is worth nothing."""
        commands: list[bytes] = []
        self._socket.receive(commands, [])
        heard = []
        for command in commands:
            action, self._after_ns = action_of(command, self._after_ns, now_ns, self._profile_check)
            heard.append(action)
        return heard

    def close(self) -> None:
        """Remove the socket and its credential."""
        self._socket.close()
