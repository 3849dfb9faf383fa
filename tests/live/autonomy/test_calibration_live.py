"""The sockets around the calibration: reports in, datagrams out, an instrument that is asked."""

from __future__ import annotations

import socket
import time
from collections.abc import Callable
from math import isnan
from typing import Any

import pytest

from autonomy.calibration.live import SURVEY_REQUEST, SurveyInstrument, first_report
from autonomy.process.controller_link import ControllerLink
from can_dbc.messages.crane import StateReport
from can_dbc.messages.datagrams import encode
from machine.status.modes import Mode
from tests.operator_end import udp_end

NAN5 = (0.0,) * 5


def report(mode: Mode, profile_hash: int = 7) -> bytes:
    return encode(StateReport(1, profile_hash, 5, mode, 0, 0, 0, 0, 0, 0, NAN5, NAN5, NAN5, 0.0, 0.0, 0.0, 0, 0, 0, 0))


@pytest.fixture
def far() -> socket.socket:
    with udp_end(5.0) as peer:
        yield peer


def free_port() -> int:
    with udp_end(None) as probe:
        return probe.getsockname()[1]


def waited_for(read: Callable[[int], Any]) -> Any:
    """The answer that is under way."""
    end = time.monotonic() + 5.0
    while (reading := read(10**9 + 1)) is None and time.monotonic() < end:
        time.sleep(0.005)
    return reading


def test_an_instrument_is_requested_and_its_answer_is_read(far: socket.socket) -> None:
    instrument = SurveyInstrument(far.getsockname())
    assert instrument.read(10**9) is None
    question, asker = far.recvfrom(100)
    assert question == SURVEY_REQUEST
    for answer in (b'{"error":"no prism"}', b"nonsense", b'{"pin_m":[1.0,2.0,3.0]}'):
        far.sendto(answer, asker)
    assert waited_for(instrument.read) == (1.0, 2.0, 3.0)
    instrument.close()


def test_an_instrument_gives_the_grapples_direction_or_says_that_it_cannot(far: socket.socket) -> None:
    instrument = SurveyInstrument(far.getsockname())
    assert instrument.read_yaw(10**9) is None
    _, asker = far.recvfrom(100)
    far.sendto(b'{"pin_m":[1.0,2.0,3.0],"yaw_rad":0.7}', asker)
    assert waited_for(instrument.read_yaw) == 0.7
    assert instrument.read_yaw(10**9 + 1) is None
    far.sendto(b'{"pin_m":[1.0,2.0,3.0]}', asker)
    told = waited_for(instrument.read_yaw)
    assert told is not None and isnan(told)
    instrument.close()


def test_the_newest_report_counts_and_a_foreign_controller_is_noticed(far: socket.socket) -> None:
    port = free_port()
    link = ControllerLink(far.getsockname(), port, 7, None)
    for data in (report(Mode.BOOT), b"noise", report(Mode.STANDBY)):
        far.sendto(data, ("127.0.0.1", port))
    first = first_report(link, 5.0, (Mode.STANDBY,))
    assert first is not None and first.mode == Mode.STANDBY and not link.foreign
    link.send(b"a setpoint")
    assert far.recv(100) == b"a setpoint"
    far.sendto(report(Mode.ARMED, profile_hash=8), ("127.0.0.1", port))
    assert first_report(link, 5.0, (Mode.STANDBY,)) is None and link.foreign
    link.close()
