"""The operator's way to the controller: a Unix datagram socket of its own, apart from the planner's port.

ARM, DISARM and RESET are heard only there; STOP is heard there before anything else, whatever waits on the setpoint
port.  The controller's side is `controller.requests.operator_socket`.
"""

from __future__ import annotations

import socket
from pathlib import Path

from runtime.shared_file import shared_path


def default_path() -> Path:
    """Path of the controller's socket for operators."""
    return shared_path("controller.operator")


def send(data: bytes, path: Path) -> None:
    """Send one operator command; raises OSError if the controller does not listen or its queue is full."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as link:
        link.setblocking(False)
        link.sendto(data, str(path))
