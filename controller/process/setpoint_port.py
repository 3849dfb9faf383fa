"""The setpoint port: UDP on loopback, where any process of the computer may send and only the key's holder is heard.

At most `MAX_DATAGRAMS` from the planner and as many from anyone are received in one tick; in a flood the rest waits.
The planner's do not wait behind it: whoever sent the last setpoint that was made with the key has a queue of his own.
For this a second socket on the port is connected to his address, and the kernel gives it what comes from there alone
(udp(7)); nobody else can send from a port that he has bound.  A planner that starts while the port is flooded may not
get through before the flood ends; the machine has not moved for it until then.
"""

from __future__ import annotations

import socket
from typing import Final

from can_dbc.bus.batch import Batch
from can_dbc.messages.envelope import is_operator_command
from can_dbc.messages.operator_link import admitted
from runtime.errors import LinkError

Address = tuple[str, int]
MAX_DATAGRAMS: Final = 16
DATAGRAM_BYTES: Final = 2048


def listen(port: int) -> socket.socket:
    """Open a socket on a UDP port of loopback that no other has; raises LinkError."""
    made = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        made.bind(("127.0.0.1", port))
    except (OSError, OverflowError) as error:
        made.close()
        sentence = f"UDP port {port} cannot be used ({error}); end the process that uses it or choose another port."
        raise LinkError("udp.port-in-use", sentence) from error
    made.setblocking(False)
    return made


class SetpointPort:
    """The port of a socket of `listen`; without a ``key`` all are heard, and nobody has a queue of his own."""

    __slots__ = ("_batch", "_key", "_open", "_planner", "_stranger", "_strangers", "address")

    def __init__(self, listening: socket.socket, key: bytes | None) -> None:
        self._open, self._key = listening, key
        self.address: Address = listening.getsockname()
        self._planner = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._planner.setblocking(False)
        for each in (listening, self._planner):
            each.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEPORT, 1)
        self._planner.bind(self.address)
        self._planner.connect(self.address)  # nobody sends from here: no planner yet
        for each in (listening, self._planner):
            each.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEPORT, 0)  # and so nobody else may listen here
        self._batch = Batch(DATAGRAM_BYTES, count=MAX_DATAGRAMS, named=True)
        self._strangers, self._stranger = 0, 0

    def receive(self, datagrams: list[bytes]) -> None:
        """Append what waits, the planner's first: without authenticators, empty what was made without the key."""
        self._receive(self._planner, datagrams)
        self._receive(self._open, datagrams)

    def strangers_text(self) -> str:
        """Tell how many datagrams were made without the key, and the port that sent the last one; empty: none."""
        if not self._strangers:
            return ""
        return f"Datagrams without the right key: {self._strangers}, the last from UDP port {self._stranger}. "

    def close(self) -> None:
        """Close the port."""
        self._planner.close()
        self._open.close()

    def _receive(self, link: socket.socket, datagrams: list[bytes]) -> None:
        batch = self._batch
        try:
            count = batch.receive(link.fileno())
        except OSError:
            return
        followed: Address | None = None
        for i in range(count):
            at = i * DATAGRAM_BYTES
            datagram = admitted(batch.data[at : at + batch.length(i)].tobytes(), self._key)
            datagrams.append(datagram)
            if not datagram:
                self._strangers, self._stranger = self._strangers + 1, batch.sender(i)[1]
            elif not is_operator_command(datagram):
                followed = batch.sender(i)
        if followed is not None and self._key is not None and link is self._open:
            self._planner.connect(followed)
