"""Ends of datagrams: the controller's of an operator's socket, with its credential, and any on a free port."""

from __future__ import annotations

import socket
from pathlib import Path

from can_dbc.messages.envelope import MAC_BYTES
from can_dbc.messages.operator_link import admitted, draw_credential


class OperatorEnd(socket.socket):
    """Bound at ``path``; receives as the controller's socket does: no authenticators, empty what has a wrong one."""

    def __init__(self, path: Path) -> None:
        super().__init__(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._credential = draw_credential(path)
        self.bind(str(path))

    def recv(self, size: int, flags: int = 0, /) -> bytes:
        """One command."""
        return admitted(super().recv(size + MAC_BYTES, flags), self._credential)


def udp_end(timeout_s: float | None = 0.0) -> socket.socket:
    """A socket on a free port of this machine; without a time it waits for nothing, with None for ever."""
    made = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    made.bind(("127.0.0.1", 0))
    made.settimeout(timeout_s)
    return made
