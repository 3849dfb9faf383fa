"""What a person asks for, heard by the guard itself: its own Unix datagram socket, apart from the controller's.

The file system decides who may send there, as for `controller.requests.operator_socket`; `action_of` decides what a
datagram is worth, and is the one place for it.  STOP counts whatever key, age or order it carries.
"""

from __future__ import annotations

import contextlib
import socket
from pathlib import Path
from typing import Final

from can_dbc.messages.crane import OperatorAction, OperatorCommand
from can_dbc.messages.datagrams import decode
from can_dbc.messages.envelope import DatagramRefused
from controller.guard.layout import GuardConfigError
from runtime.shared_file import make_own_folder

AGE_NS: Final = 1_000_000_000
MOST: Final = 16
"""Datagrams of one step; more than the queue of a Unix socket holds."""
BYTES: Final = 256


def action_of(data: bytes, key: bytes | None, after_ns: int, now_ns: int) -> tuple[int, int]:
    """Action and stamp [ns] of a command, (0, ``after_ns``) where it is worth nothing; each is newer than the last."""
    for tried in {key, None}:
        with contextlib.suppress(DatagramRefused):
            message = decode(data, tried)
            if isinstance(message, OperatorCommand):
                if message.action is OperatorAction.STOP:
                    return message.action, after_ns
                if tried == key and max(after_ns, now_ns - AGE_NS) < message.stamp_ns <= now_ns:
                    return message.action, message.stamp_ns
    return 0, after_ns


class Ear:
    """Bound at ``path``, for its owner and group; raises GuardConfigError if it cannot be bound."""

    __slots__ = ("_after_ns", "_key", "_path", "_socket")

    def __init__(self, path: Path, key: bytes | None = None) -> None:
        self._path, self._key, self._after_ns = path, key, 0
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        try:
            self._socket.setblocking(False)
            make_own_folder(path.parent)
            path.unlink(missing_ok=True)  # left by a process that was killed
            self._socket.bind(str(path))
            path.chmod(0o660)  # independent of the umask
        except OSError as error:
            self._socket.close()
            raise GuardConfigError(
                "guard.operator",
                f"{path}: no socket for the operator there: {error.strerror}; give another --operator.",
            ) from error

    def actions(self, now_ns: int) -> list[int]:
        """The actions that have come."""
        heard = []
        with contextlib.suppress(OSError):  # nothing waits
            for _ in range(MOST):
                action, self._after_ns = action_of(self._socket.recv(BYTES), self._key, self._after_ns, now_ns)
                heard.append(action)
        return heard

    def close(self) -> None:
        """Remove the socket."""
        self._socket.close()
        self._path.unlink(missing_ok=True)
