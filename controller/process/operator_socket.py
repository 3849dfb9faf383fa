"""The operator's socket, one of the controller and one of the guard: the file system decides who may arm.

Only its owner, its group and root can send there (unix(7): a sender needs write permission), and only who can read the
credential of this start is heard (`can_dbc.messages.operator_link`), but for STOP, which needs none; as a service both
lie in a folder that only the group ``timberhand-operator`` can enter.  No planner can arm, and none can fill its queue.
"""

from __future__ import annotations

import contextlib
import socket
from pathlib import Path
from typing import Final

from can_dbc.bus.batch import Batch
from can_dbc.messages.operator_link import admitted, credential_path, draw_credential
from runtime.shared_file import make_own_folder

MAX_COMMANDS: Final = 16
"""Commands received in one tick: more than the queue of a Unix socket holds."""
COMMAND_BYTES: Final = 256


class OperatorSocket:
    """Bound at ``path``, for its owner and group; raises OSError if it cannot be bound."""

    __slots__ = ("_batch", "_credential", "_inode", "_path", "_sock")

    def __init__(self, path: Path) -> None:
        make_own_folder(path.parent)
        self._credential = draw_credential(path)
        with contextlib.suppress(FileNotFoundError):
            path.unlink()  # left by a process that was killed
        self._sock = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        try:
            self._sock.setblocking(False)
            self._sock.bind(str(path))
            path.chmod(0o660)  # independent of the umask
            self._inode = path.stat().st_ino
        except OSError:
            self._sock.close()
            raise
        self._path = path
        self._batch = Batch(COMMAND_BYTES, count=MAX_COMMANDS)

    def receive(self, commands: list[bytes], others: list[bytes]) -> None:
        """Append the waiting commands, and to ``others`` an empty one for each that was made without the credential."""
        batch = self._batch
        try:
            count = batch.receive(self._sock.fileno())
        except OSError:
            return
        for i in range(count):
            at = i * COMMAND_BYTES
            command = admitted(batch.data[at : at + batch.length(i)].tobytes(), self._credential)
            (commands if command else others).append(command)

    def close(self) -> None:
        """Remove the socket and its credential, unless another process owns its path by now."""
        with contextlib.suppress(OSError):
            if self._path.stat().st_ino == self._inode:
                self._path.unlink()
                credential_path(self._path).unlink()
        self._sock.close()
