"""The operator's way to controller and guard: Unix datagram sockets of their own, apart from the planner's port.

ARM, DISARM, RESET and the heartbeats are heard only there, and only with an authenticator made with the credential of
the listener's present start: random bytes in a file beside the socket, which its owner and its group may read (as
X11's cookie).  So what was sent before a restart is worth nothing after it.  STOP needs none, and is heard there before
anything else, whatever waits on the setpoint port.  The controller's side is `controller.process.operator_socket`, the
guard's `controller.guard.operator`: it hears the person itself, and nothing moves without the ARM that it heard.
"""

from __future__ import annotations

import contextlib
import os
import secrets
import socket
from pathlib import Path
from typing import Final

from can_dbc.messages.datagrams import stop_in
from can_dbc.messages.envelope import DatagramRefused, opened, signed
from runtime.shared_file import shared_path

CREDENTIAL_BYTES: Final = 32


def default_path() -> Path:
    """Return the path of the controller's socket for operators."""
    return shared_path("controller.operator")


def guard_path(path: Path) -> Path:
    """Return the guard's socket beside the controller's: of another user, so in a folder of its own."""
    return Path(f"{path.parent}-guard") / path.name


def credential_path(path: Path) -> Path:
    """Return the path of the credential that belongs to a socket."""
    return path.with_name(f"{path.name}.key")


def draw_credential(path: Path) -> bytes:
    """Draw the credential of the socket at ``path`` and leave it beside it; raises OSError if that cannot be done."""
    credential, credential_file = secrets.token_bytes(CREDENTIAL_BYTES), credential_path(path)
    new_file = credential_file.with_name(f"{credential_file.name}.new")
    new_file.unlink(missing_ok=True)
    descriptor = os.open(new_file, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
    with open(descriptor, "wb") as out:
        out.write(credential)
        os.fchmod(descriptor, 0o640)  # independent of the umask
    new_file.replace(credential_file)
    return credential


def admitted(data: bytes, key: bytes | None) -> bytes:
    """Return a datagram as its listener sees it, without its authenticator.

    STOP passes whatever that is; anything else is empty if it is wrong.

    An empty datagram stands for whatever was not made with the key.
    """
    try:
        return opened(data, key)
    except DatagramRefused:
        return stop_in(data)


def send(data: bytes, path: Path) -> None:
    """Send one operator command, sealed without a key, to controller and guard, as one of those who may read their
    credentials.

    A guard that does not listen moves nothing, and says so on the bus.

    Raises:
        OSError: the controller's credential cannot be read, it does not listen, or its queue is full.
    """
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as link:
        link.setblocking(False)
        with contextlib.suppress(OSError):
            link.sendto(_signed(data, guard_path(path)), str(guard_path(path)))
        link.sendto(_signed(data, path), str(path))


def _signed(data: bytes, path: Path) -> bytes:
    return data if stop_in(data) else signed(data, credential_path(path).read_bytes())
