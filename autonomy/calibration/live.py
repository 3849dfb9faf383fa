"""The calibration on a running machine: sockets and bus around the pure procedure.

It listens on the crane's bus and never sends there.  The machine moves by setpoint datagrams to the controller, which
checks them like any planner's.  One thread; it blocks only between ticks.
"""

from __future__ import annotations

import socket
import time
from collections.abc import Callable
from contextlib import suppress
from math import nan
from typing import Final, Protocol

import msgspec

from autonomy.calibration.procedure import Calibration
from autonomy.process.command_line import Address
from autonomy.process.controller_link import ControllerLink
from can_dbc.bus.base import Bus
from can_dbc.frame import Frame
from can_dbc.messages.crane import StateReport
from machine.geometry.kinematics import Point

POLL_S: Final = 0.005
ANSWER_TIMEOUT_NS: Final = 2_000_000_000
"""An instrument that has not answered after this time is requested again."""
SURVEY_REQUEST: Final = b'{"op":"survey"}'


class SurveyAnswer(msgspec.Struct):
    """A surveying instrument's answer in the crane's base frame: the hanger pin [m], and the direction along which the
    grapple opens [rad] where the instrument can measure it.
    """

    pin_m: tuple[float, float, float]
    yaw_rad: float | None = None


class SurveyInstrument:
    """A surveying instrument over UDP, with one request under way at a time."""

    def __init__(self, address: Address) -> None:
        self._link = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._link.setblocking(False)
        self._address = address
        self._asked_ns: int | None = None
        """When the request under way was sent."""

    def read(self, now_ns: int) -> Point | None:
        """Return the pin of the newest answer, or None; send a request if none is under way."""
        newest_answer = self._newest(now_ns)
        return None if newest_answer is None else newest_answer.pin_m

    def read_yaw(self, now_ns: int) -> float | None:
        """Return the direction of the newest answer, NaN where it has none, or None; send a request likewise."""
        newest_answer = self._newest(now_ns)
        return None if newest_answer is None else nan if newest_answer.yaw_rad is None else newest_answer.yaw_rad

    def _newest(self, now_ns: int) -> SurveyAnswer | None:
        newest_answer = None
        while True:
            try:
                data = self._link.recv(4096)
            except (BlockingIOError, ConnectionRefusedError):
                break
            with suppress(msgspec.DecodeError):
                newest_answer = msgspec.json.decode(data, type=SurveyAnswer)
        if self._asked_ns is not None and now_ns - self._asked_ns < ANSWER_TIMEOUT_NS:
            if newest_answer is not None:
                self._asked_ns = None
            return newest_answer
        self._asked_ns = now_ns  # what waited until now may be of an earlier pose
        with suppress(OSError):
            self._link.sendto(SURVEY_REQUEST, self._address)
        return None

    def close(self) -> None:
        """Close the socket."""
        self._link.close()


class Surveyor(Protocol):
    """A source of the hanger pin and the grapple's direction, like `SurveyInstrument`; None: nothing yet."""

    def read(self, now_ns: int) -> Point | None:
        """Return the pin, base frame, m."""

    def read_yaw(self, now_ns: int) -> float | None:
        """Return the direction along which the grapple opens, base frame, rad modulo pi; NaN where it is unreadable."""


def first_report(link: ControllerLink, within_s: float, ready: tuple[int, ...]) -> StateReport | None:
    """Wait for the first report of a controller in a ``ready`` mode; None when none arrives in time."""
    end_ns = time.monotonic_ns() + int(within_s * 1e9)
    while time.monotonic_ns() < end_ns and not link.foreign:
        link.wait(POLL_S)
        report = link.newest()
        if report is not None and report.mode in ready:
            return report
    return None


def run(
    calibration: Calibration,
    link: ControllerLink,
    bus: Bus,
    surveyor: Surveyor | None,
    turn: Callable[[Calibration], None],
) -> None:
    """Run ticks until the procedure is over; ``turn`` is called after each and may abort it."""
    frames: list[Frame] = []
    while not (calibration.idle or calibration.done):
        link.wait(POLL_S)
        # A person may take minutes to read an instrument: take the tick's time afterwards.
        reading = yaw_rad = None
        if surveyor is not None and calibration.wants_reading:
            reading = surveyor.read(time.monotonic_ns())
        elif surveyor is not None and calibration.wants_yaw:
            yaw_rad = surveyor.read_yaw(time.monotonic_ns())
        now_ns = time.monotonic_ns()
        frames.clear()
        bus.drain(frames)
        data = calibration.step(now_ns, link.newest(), frames, reading, yaw_rad)
        if data is not None:
            link.send(data)
        turn(calibration)
        if link.foreign:
            calibration.abort("the controller runs another profile", "calibration.other-profile")
            return
