"""The sockets around the calibration: reports in, datagrams out, an instrument that is asked."""

from __future__ import annotations

import socket
import time

import pytest

from autonomy.calibration.live import QUESTION, Instrument, Link, first_report
from can_dbc.setpoint import StateReport, encode
from machine.modes import Mode

NAN5 = (0.0,) * 5


def report(mode: Mode, profile_hash: int = 7) -> bytes:
    return encode(StateReport(1, profile_hash, 5, mode, 0, 0, 0, 0, 0, 0, NAN5, NAN5, NAN5, 0.0, 0.0, 0.0, 0, 0, 0, 0))


@pytest.fixture
def far() -> socket.socket:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as peer:
        peer.bind(("127.0.0.1", 0))
        peer.settimeout(5.0)
        yield peer


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def test_an_instrument_is_asked_and_its_answer_is_read(far: socket.socket) -> None:
    instrument = Instrument(far.getsockname())
    assert instrument.read(10**9) is None
    question, asker = far.recvfrom(100)
    assert question == QUESTION
    for answer in (b'{"error":"no prism"}', b"nonsense", b'{"pin_m":[1.0,2.0,3.0]}'):
        far.sendto(answer, asker)
    end = time.monotonic() + 5.0
    while (reading := instrument.read(10**9 + 1)) is None and time.monotonic() < end:
        time.sleep(0.005)
    assert reading == (1.0, 2.0, 3.0)
    instrument.close()


def test_the_newest_report_counts_and_a_foreign_controller_is_noticed(far: socket.socket) -> None:
    port = free_port()
    link = Link(far.getsockname(), port, 7, None)
    for data in (report(Mode.BOOT), b"noise", report(Mode.STANDBY)):
        far.sendto(data, ("127.0.0.1", port))
    first = first_report(link, 5.0, (Mode.STANDBY,))
    assert first is not None and first.mode == Mode.STANDBY and not link.foreign
    link.send(b"a setpoint")
    assert far.recv(100) == b"a setpoint"
    far.sendto(report(Mode.ARMED, profile_hash=8), ("127.0.0.1", port))
    assert first_report(link, 5.0, (Mode.STANDBY,)) is None and link.foreign
    link.close()
