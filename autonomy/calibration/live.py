"""The calibration on a machine that runs: sockets and bus around the pure procedure.

It listens on the crane's bus and never sends there; what moves the machine are setpoint datagrams to the controller,
which judges them like any planner's.  One thread, no waiting but for the next turn.
"""

from __future__ import annotations

import select
import socket
import time
from collections.abc import Callable
from contextlib import suppress
from math import nan
from typing import Final, Protocol

import msgspec

from autonomy.calibration.procedure import Calibration
from can_dbc.bus.base import Bus
from can_dbc.frame import Frame
from can_dbc.messages.crane import StateReport
from can_dbc.messages.datagrams import decode
from can_dbc.messages.envelope import DatagramRefused
from machine.geometry.kinematics import Point

POLL_S: Final = 0.005
SURVEY_REQUEST: Final = b'{"op":"survey"}'
Address = tuple[str, int]


class SurveyAnswer(msgspec.Struct):
    """A surveying instrument's answer, in the crane's base frame: the hanger pin [m], and the direction along which the
    grapple opens [rad], where the instrument can tell it.
    """

    pin_m: tuple[float, float, float]
    yaw_rad: float | None = None


class SurveyInstrument:
    """Asks a surveying instrument over UDP: one question under way at a time."""

    def __init__(self, address: Address) -> None:
        self._link = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._link.setblocking(False)
        self._address = address
        self._asked_ns = 0

    def read(self, now_ns: int) -> Point | None:
        """Where the newest answer has the pin, or None; asks ten times a second."""
        found = self._newest(now_ns)
        return None if found is None else found.pin_m

    def read_yaw(self, now_ns: int) -> float | None:
        """The direction of the newest answer, NaN when the instrument tells none, or None; asks as often."""
        found = self._newest(now_ns)
        return None if found is None else nan if found.yaw_rad is None else found.yaw_rad

    def _newest(self, now_ns: int) -> SurveyAnswer | None:
        found = None
        while True:
            try:
                data = self._link.recv(4096)
            except (BlockingIOError, ConnectionRefusedError):
                break
            with suppress(msgspec.DecodeError):
                found = msgspec.json.decode(data, type=SurveyAnswer)
        if now_ns - self._asked_ns >= 100_000_000:
            self._asked_ns = now_ns
            with suppress(OSError):
                self._link.sendto(SURVEY_REQUEST, self._address)
        return found

    def close(self) -> None:
        """Gives the port back."""
        self._link.close()


class Surveyor(Protocol):
    """Whoever reads the hanger pin and the grapple's direction, as `SurveyInstrument` does; None: nothing yet."""

    def read(self, now_ns: int) -> Point | None:
        """The pin, base frame, m."""

    def read_yaw(self, now_ns: int) -> float | None:
        """The direction along which the grapple opens, base frame, rad modulo pi; NaN where it cannot be read."""


class ControllerLink:
    """Reports in, datagrams out; ``foreign`` when the controller means another profile."""

    def __init__(self, controller: Address, report_port: int, profile_hash: int, key: bytes | None) -> None:
        self.foreign = False
        self._controller, self._hash, self._key = controller, profile_hash, key
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", report_port))
        self._socket.setblocking(False)

    def wait(self, seconds: float) -> None:
        """Until something came, or for a moment."""
        select.select([self._socket], [], [], seconds)

    def newest(self) -> StateReport | None:
        """The newest report that has come since the last call."""
        newest = None
        while True:
            try:
                data = self._socket.recv(65535)
            except BlockingIOError:
                return newest
            except ConnectionRefusedError:
                continue
            with suppress(DatagramRefused):
                message = decode(data, self._key)
                if isinstance(message, StateReport):
                    self.foreign = self.foreign or message.profile_hash != self._hash
                    newest = message

    def send(self, data: bytes) -> None:
        """To the controller; one that nobody hears is followed by the next."""
        with suppress(ConnectionRefusedError, BlockingIOError):
            self._socket.sendto(data, self._controller)

    def close(self) -> None:
        """Gives the port back."""
        self._socket.close()


def first_report(link: ControllerLink, within_s: float, ready: tuple[int, ...]) -> StateReport | None:
    """The first report of a controller that could be armed; None when none comes in time."""
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
    """Turns until the procedure is over; ``turn`` is called each time and may abort it."""
    frames: list[Frame] = []
    while not (calibration.idle or calibration.done):
        link.wait(POLL_S)
        # A person may take minutes to read an instrument: the time of the turn is the time after it.
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
            calibration.abort("the controller runs another profile")
            return
