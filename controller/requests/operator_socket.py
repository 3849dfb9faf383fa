"""The controller's socket for operators: a Unix datagram socket whose senders the kernel names (unix(7), SO_PASSCRED).

Every datagram comes with the user that sent it.  Those of a user who may arm are the operator's; those of anyone else
have no more authority than a setpoint: STOP is heard, everything else refused and counted.
"""

from __future__ import annotations

import contextlib
import os
import socket
import struct
from pathlib import Path
from typing import Final

from can_dbc.bus.batch import Batch

MAX_COMMANDS: Final = 8
"""Commands received in one tick."""
COMMAND_BYTES: Final = 256
_CREDENTIALS: Final = struct.Struct("@Nii3i")
"""struct cmsghdr (length, level, type) and struct ucred (process, user, group)."""
_ANCILLARY_BYTES: Final = socket.CMSG_SPACE(12)


class OperatorSocket:
    """Bound at ``path``; ``users`` are the numbers of the users that may arm, root and the own one always among them.

    Raises OSError if it cannot be bound.
    """

    __slots__ = ("_batch", "_inode", "_path", "_sock", "_users")

    def __init__(self, path: Path, users: frozenset[int] = frozenset()) -> None:
        path.parent.mkdir(mode=0o755, parents=True, exist_ok=True)
        with contextlib.suppress(FileNotFoundError):
            path.unlink()  # left by a process that was killed
        self._sock = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        try:
            self._sock.setblocking(False)
            self._sock.setsockopt(socket.SOL_SOCKET, socket.SO_PASSCRED, 1)
            self._sock.bind(str(path))
            path.chmod(0o666)  # anyone may stop the machine; who may arm it is decided by the sender's user
            self._inode = path.stat().st_ino
        except OSError:
            self._sock.close()
            raise
        self._path, self._users = path, users | {0, os.getuid()}
        self._batch = Batch(COMMAND_BYTES, _ANCILLARY_BYTES, MAX_COMMANDS)

    def receive(self, commands: list[bytes], others: list[bytes]) -> None:
        """Append the waiting datagrams: those of operators to ``commands``, the rest to ``others``."""
        batch = self._batch
        try:
            count = batch.receive(self._sock.fileno())
        except OSError:
            return
        for i in range(count):
            at = i * COMMAND_BYTES
            data = batch.data[at : at + batch.length(i)].tobytes()
            length, level, kind, _, user, _ = _CREDENTIALS.unpack_from(batch.control, i * _ANCILLARY_BYTES)
            known = length and level == socket.SOL_SOCKET and kind == socket.SCM_CREDENTIALS
            (commands if known and user in self._users else others).append(data)

    def close(self) -> None:
        """Remove the socket, unless another process owns its path by now."""
        with contextlib.suppress(OSError):
            if self._path.stat().st_ino == self._inode:
                self._path.unlink()
        self._sock.close()
