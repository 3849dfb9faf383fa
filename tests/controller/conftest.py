"""What several tests of the controller process need."""

import socket

import pytest


@pytest.fixture
def udp():
    """Three sockets on loopback: setpoints, reports, records."""
    made = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(3)]
    for s in made:
        s.bind(("127.0.0.1", 0))
        s.settimeout(2)
    made[0].setblocking(False)
    yield made
    for s in made:
        s.close()
