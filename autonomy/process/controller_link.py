"""The link of a planner to the controller: state reports in, setpoints out."""

from __future__ import annotations

import select
import socket
from contextlib import suppress

from autonomy.process.command_line import Address
from can_dbc.messages.crane import StateReport
from can_dbc.messages.datagrams import decode
from can_dbc.messages.envelope import DatagramRefused
from can_dbc.messages.vehicle import VehicleReport


class ControllerLink:
    """Receives reports and sends datagrams.

    ``foreign``: the controller runs another profile.  ``vehicle`` is the newest vehicle report, None on a
    machine that does not drive.  Without the address of a ``controller`` the link only listens.
    """

    def __init__(self, controller: Address | None, report_port: int, profile_hash: int, key: bytes | None) -> None:
        """Open the link.

        Raises:
            OSError: the port of the reports cannot be opened.
        """
        self.foreign = False
        self.vehicle: VehicleReport | None = None
        self._controller, self._hash, self._key = controller, profile_hash, key
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", report_port))
        self._socket.setblocking(False)

    def wait(self, seconds: float) -> None:
        """Wait until a report arrives, at most ``seconds``."""
        select.select([self._socket], [], [], seconds)

    def newest(self) -> StateReport | None:
        """Return the newest report that arrived since the last call."""
        newest = None
        while True:
            try:
                data = self._socket.recv(65535)
            except BlockingIOError:
                return newest
            except ConnectionRefusedError:
                continue
            with suppress(DatagramRefused):
                message = decode(data, self._key)
                if isinstance(message, StateReport):
                    self.foreign = self.foreign or message.profile_hash != self._hash
                    newest = message
                elif isinstance(message, VehicleReport):
                    self.vehicle = message

    def send(self, data: bytes) -> None:
        """Send to the controller; a lost datagram is followed by the next."""
        if self._controller is not None:
            with suppress(ConnectionRefusedError, BlockingIOError):
                self._socket.sendto(data, self._controller)

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()
