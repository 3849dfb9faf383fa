"""UDP and TCP addresses as command lines write them: HOST:PORT."""

from __future__ import annotations

import argparse
import socket

from runtime.errors import InputRefused


def udp_address(text: str) -> tuple[str, int]:
    """Parse HOST:PORT as a numeric address, so that sending never waits for a name server; raises InputRefused."""
    host, _, port = text.rpartition(":")
    if not host or not port.isdecimal() or not 0 < int(port) < 65536:
        raise InputRefused("address.malformed", f"{text}: write HOST:PORT, for example 127.0.0.1:5006")
    try:
        return socket.gethostbyname(host), int(port)
    except OSError:
        sentence = f"{text}: there is no host {host}; write an address, for example 127.0.0.1:5006"
        raise InputRefused("address.unknown-host", sentence) from None


def local_address_argument(text: str) -> tuple[str, int]:
    """Parse as `address_argument` an address on this computer, to which a socket on its loopback can send."""
    address = address_argument(text)
    if not address[0].startswith("127."):
        raise argparse.ArgumentTypeError(f"{text}: it must be on this computer, for example 127.0.0.1:{address[1]}")
    return address


def address_argument(text: str) -> tuple[str, int]:
    """Parse as `udp_address`, the ``type`` of a command-line option: raises ArgumentTypeError with the sentence."""
    try:
        return udp_address(text)
    except InputRefused as error:
        raise argparse.ArgumentTypeError(str(error)) from None
