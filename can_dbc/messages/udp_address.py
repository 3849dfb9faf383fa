"""UDP addresses as the command lines write them."""

from __future__ import annotations

import socket


def udp_address(text: str) -> tuple[str, int]:
    """HOST:PORT of a command line as a numeric address, so that sending never waits for a name server.

    Raises:
        ValueError: not HOST:PORT, or an unknown host; one sentence that says what to write.
    """
    host, _, port = text.rpartition(":")
    if not host or not port.isdecimal() or not 0 < int(port) < 65536:
        raise ValueError(f"{text}: write HOST:PORT, as in 127.0.0.1:5006")
    try:
        return socket.gethostbyname(host), int(port)
    except OSError:
        raise ValueError(f"{text}: there is no host {host}; write an address, as in 127.0.0.1:5006") from None
