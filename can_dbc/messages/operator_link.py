"""The operator's way to controller and guard: Unix datagram sockets of their own, apart from the planner's port.

ARM, DISARM and RESET are heard only there; STOP is heard there before anything else, whatever waits on the setpoint
port.  The controller's side is `controller.requests.operator_socket`, the guard's `controller.guard.operator`: it hears
the person itself, and nothing moves without the ARM that it heard.
"""

from __future__ import annotations

import contextlib
import socket
from pathlib import Path

from runtime.shared_file import shared_path


def default_path() -> Path:
    """Path of the controller's socket for operators."""
    return shared_path("controller.operator")


def guard_path(path: Path) -> Path:
    """The guard's socket beside the controller's: of another user, so in a folder of its own."""
    return path.parent.with_name(f"{path.parent.name}-guard") / path.name


def send(data: bytes, path: Path) -> None:
    """Send one operator command to both; raises OSError if the controller does not listen or its queue is full.

    A guard that does not listen moves nothing, and says so on the bus.
    """
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as link:
        link.setblocking(False)
        with contextlib.suppress(OSError):
            link.sendto(data, str(guard_path(path)))
        link.sendto(data, str(path))
