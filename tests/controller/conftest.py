"""What several tests of the controller process need."""

import contextlib
import socket

import pytest

from can_dbc.messages import tick_record
from can_dbc.messages.record_ring import RecordRing, RingReader


class Records:
    """A ring of tick records and its reader."""

    def __init__(self, path):
        self.reader, self.ring = RingReader(path), RecordRing(path)

    def read(self):
        """The records since the last call, decoded."""
        return [tick_record.decode(data) for data in self.reader.read()]

    def close(self):
        self.reader.close()
        with contextlib.suppress(ValueError):  # the loop has closed it
            self.ring.close()


@pytest.fixture
def udp(tmp_path):
    """Two sockets on loopback, for setpoints and reports, and the records."""
    made = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2)]
    for s in made:
        s.bind(("127.0.0.1", 0))
        s.settimeout(2)
    made[0].setblocking(False)
    records = Records(tmp_path / "ticks")
    yield *made, records
    for s in (*made, records):
        s.close()
