"""The planning process: controller reports and log lists in, setpoints out, phase changes as JSON lines.

``python -m autonomy --profile palms_471 --controller 127.0.0.1:47001 --report-port 47002 --scene 127.0.0.1:47003``

Events on stdout: ``phase``, ``paused`` (with its reason), ``refused`` (a setpoint, with the controller's number),
``done``, ``failed`` (with its reason).  SIGTERM and SIGINT stop the crane smoothly and end with a hold.
Exit codes: 0 the log lies in the bunk, 2 usage, 3 profile or key, 4 port, 5 interrupted while the controller was
stopped, 6 the mission failed, 130 interrupted.
"""

from __future__ import annotations

import argparse
import select
import signal
import socket
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Final

import msgspec

from autonomy.activity import Activity
from autonomy.logs import QUESTION, LogObservation, LogsRefused, parse_logs
from autonomy.mission import Mission
from can_dbc.setpoint import DatagramRefused, StateReport, decode, udp_address
from machine.load import ProfileError, load_profile, profile_hash
from machine.modes import Mode

FINE, CONFIGURATION, BUSY, SAFETY, FAILED, INTERRUPTED = 0, 3, 4, 5, 6, 130
TURN_S: Final = 0.01
LOOK_NS: Final = 250_000_000
Address = tuple[str, int]


def address(text: str) -> Address:
    """HOST:PORT of a command line; raises ArgumentTypeError."""
    try:
        return udp_address(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def arguments(argv: list[str]) -> argparse.Namespace:
    """The command line; ends the process with code 2 when it is wrong."""
    parser = argparse.ArgumentParser(prog="python -m autonomy", description="Picks one log into the bunk.")
    parser.add_argument("--profile", default="palms_471", help="shipped name or TOML file of the machine")
    parser.add_argument("--controller", type=address, required=True, help="HOST:PORT that takes setpoints")
    parser.add_argument("--report-port", type=int, required=True, help="local UDP port for state reports")
    parser.add_argument("--scene", type=address, required=True, help="HOST:PORT of the log detector")
    parser.add_argument("--log", type=int, help="number of the log to pick (default: the best one)")
    parser.add_argument("--lease-ms", type=int, default=200, help="how long a setpoint is obeyed")
    parser.add_argument("--key-file", type=Path, help="file with the key that authenticates datagrams")
    return parser.parse_args(argv)


class Process:
    """The sockets around an activity."""

    def __init__(
        self, activity: Activity, profile_hash: int, options: argparse.Namespace, key: bytes | None = None
    ) -> None:
        self._key = key
        self.signals: list[int] = []
        self.foreign = False
        self._activity = activity
        self._hash = profile_hash
        self._controller: Address = options.controller
        self._link = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._link.bind(("127.0.0.1", options.report_port))
        self._scene = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._scene.connect(options.scene)
        for each in (self._link, self._scene):
            each.setblocking(False)
        self._look_ns = 0
        self._mode = -1
        self._told: dict[str, object] = {}

    def close(self) -> None:
        """Gives the ports back."""
        self._link.close()
        self._scene.close()

    @property
    def stopped(self) -> bool:
        """Whether the controller's last word was STOP or FAULT."""
        return self._mode in (Mode.STOP, Mode.FAULT)

    def run(self) -> None:
        """Turns until the activity has nothing more to send."""
        while not self._activity.idle and not self.foreign:
            select.select([self._link, self._scene], [], [], TURN_S)
            if self.signals:
                self._activity.abort(f"ended by {signal.Signals(self.signals[0]).name}")
            self.turn(time.monotonic_ns())

    def turn(self, now_ns: int) -> None:
        """One turn: ask, take what came, step, send, tell."""
        if now_ns >= self._look_ns:
            self._look_ns = now_ns + LOOK_NS
            self._send(self._scene.send, QUESTION)
        report, logs = self._newest_report(), self._newest_logs()
        data = self._activity.step(now_ns, report, logs)
        if data is not None:
            self._send(lambda d: self._link.sendto(d, self._controller), data)
        self._tell(report)

    def _newest_report(self) -> StateReport | None:
        newest = None
        for data in _received(self._link):
            try:
                message = decode(data, self._key)
            except DatagramRefused:
                continue
            if not isinstance(message, StateReport):
                continue
            if message.profile_hash != self._hash:
                self.foreign = True
                return None
            newest, self._mode = message, message.mode
        return newest

    def _newest_logs(self) -> tuple[LogObservation, ...]:
        logs: tuple[LogObservation, ...] = ()
        for data in _received(self._scene):
            try:
                logs = parse_logs(data)
            except LogsRefused as error:
                if self._changed("detector", str(error)):
                    say("detector", reason=str(error))
        return logs

    @staticmethod
    def _send(send: Callable[[bytes], int], data: bytes) -> None:
        # Nobody listens yet, or the buffer is full: the next one follows in 50 ms.
        with suppress(ConnectionRefusedError, BlockingIOError):
            send(data)

    def _tell(self, report: StateReport | None) -> None:
        """Says what is not as it was in the last turn."""
        activity = self._activity
        if self._changed("phase", activity.phase):
            say("phase", phase=activity.phase.name)
        if self._changed("paused", activity.paused):
            say("paused" if activity.paused else "running", reason=activity.paused)
        if report is not None and self._changed("refused", report.refused) and report.refused:
            say("refused", number=report.refusal, count=report.refused)

    def _changed(self, name: str, value: object) -> bool:
        before = self._told.get(name)
        self._told[name] = value
        return value != before


def say(event: str, **what: object) -> None:
    """One JSON line on stdout."""
    line = {"event": event, "t_s": round(time.monotonic(), 3), **{k: v for k, v in what.items() if v is not None}}
    sys.stdout.write(msgspec.json.encode(line).decode() + "\n")
    sys.stdout.flush()


def _received(link: socket.socket) -> list[bytes]:
    found = []
    while True:
        try:
            found.append(link.recv(65535))
        except BlockingIOError:
            return found
        except ConnectionRefusedError:
            continue


def main(argv: list[str] | None = None) -> int:
    """Runs one mission; the exit code."""
    options = arguments(sys.argv[1:] if argv is None else argv)
    try:
        profile = load_profile(options.profile)
    except ProfileError as error:
        return _complain(str(error))
    if not 0 < options.lease_ms <= profile.timeouts.lease_max_ms:
        return _complain(f"--lease-ms {options.lease_ms}: {profile.name} allows 1..{profile.timeouts.lease_max_ms}")
    try:
        key = options.key_file.read_bytes().strip() if options.key_file else None
    except OSError as error:
        return _complain(f"{options.key_file}: the key cannot be read: {error.strerror}")
    lease_ns = options.lease_ms * 1_000_000
    activity = Activity(profile, profile_hash(profile), Mission(log_id=options.log), lease_ns, key)
    try:
        process = Process(activity, profile_hash(profile), options, key)
    except (OSError, OverflowError) as error:
        return _complain(f"UDP port {options.report_port} cannot be opened ({error}); choose another one", BUSY)
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda number, _: process.signals.append(number))
    try:
        process.run()
    finally:
        process.close()
    if process.foreign:
        return _complain("the controller runs another profile than this planner: start both with the same one")
    if activity.done:
        say("done")
        return FINE
    say("failed", reason=activity.failure)
    if not process.signals:
        return FAILED
    return SAFETY if process.stopped else INTERRUPTED


def _complain(sentence: str, code: int = CONFIGURATION) -> int:
    sys.stderr.write(f"{sentence}\n")
    return code


if __name__ == "__main__":
    sys.exit(main())
