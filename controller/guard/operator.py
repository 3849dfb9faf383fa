"""What a person asks for, heard by the guard itself: its own Unix datagram socket, apart from the controller's.

The file system decides who may send there, and only who can read the credential of the guard's present start is heard,
as for `controller.requests.operator_socket`.  STOP counts whatever key, age or order it carries.
"""

from __future__ import annotations

import contextlib
import socket
from pathlib import Path
from typing import Final

from can_dbc.messages.crane import OperatorAction, OperatorCommand
from can_dbc.messages.datagrams import decode
from can_dbc.messages.envelope import DatagramRefused
from can_dbc.messages.operator_link import admitted, credential_path, draw_credential
from controller.guard.layout import GuardConfigError
from runtime.shared_file import make_own_folder

AGE_NS: Final = 1_000_000_000
MOST: Final = 16
"""Datagrams of one step; more than the queue of a Unix socket holds."""
BYTES: Final = 256


def action_of(data: bytes, key: bytes | None, after_ns: int, now_ns: int) -> tuple[int, int]:
    """Action and stamp [ns] of a command, (0, ``after_ns``) where it is worth nothing; each is newer than the last."""
    with contextlib.suppress(DatagramRefused):
        message = decode(admitted(data, key))
        if isinstance(message, OperatorCommand):
            if message.action is OperatorAction.STOP:
                return message.action, after_ns
            if max(after_ns, now_ns - AGE_NS) < message.stamp_ns <= now_ns:
                return message.action, message.stamp_ns
    return 0, after_ns


class Ear:
    """Bound at ``path``, for its owner and group; raises GuardConfigError if it cannot be bound."""

    __slots__ = ("_after_ns", "_credential", "_path", "_socket")

    def __init__(self, path: Path) -> None:
        self._path, self._after_ns = path, 0
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        try:
            self._socket.setblocking(False)
            make_own_folder(path.parent)
            self._credential = draw_credential(path)
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
                action, self._after_ns = action_of(self._socket.recv(BYTES), self._credential, self._after_ns, now_ns)
                heard.append(action)
        return heard

    def close(self) -> None:
        """Remove the socket and its credential."""
        self._socket.close()
        self._path.unlink(missing_ok=True)
        credential_path(self._path).unlink(missing_ok=True)
