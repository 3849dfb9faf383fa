"""A machine for the bridge's process: the lockstep machine on real time, and its datagrams on real sockets.

Controller, guard and nodes are the real ones; the joints follow their valves without physics: a busy host keeps up.

``python -m tests.live.ros2.paced_machine REPORT_PORT`` prints the port that accepts setpoints, and one JSON line at
each change of mode.  Time stamps are converted between the machine's virtual time and the computer's clock: a setpoint
counts as sent when it arrives, so a slow host makes the machine slow and its setpoints not old.
"""

from __future__ import annotations

import json
import signal
import socket
import sys
import time
from collections.abc import Sequence
from dataclasses import replace

from can_dbc.messages.crane import CraneSetpoint, StateReport
from can_dbc.messages.datagrams import decode, encode
from controller.config import load as load_settings
from controller.guard.__main__ import build as build_guard
from controller.guard.__main__ import profile_path
from hil.harness.lockstep import Lockstep, Observer
from hil.harness.operator import Operator
from sim.kinematic import KinematicMachine

HOST = "127.0.0.1"
SETTINGS = load_settings("palms_471")


class Relay:
    """The planner of the lockstep machine: what arrives on a socket."""

    def __init__(self, report_port: int) -> None:
        self._bridge = (HOST, report_port)
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind((HOST, 0))
        self._socket.setblocking(False)
        self.port = self._socket.getsockname()[1]
        self._mode = -1

    def send(self, report: StateReport) -> None:
        self._socket.sendto(encode(replace(report, stamp_ns=time.monotonic_ns())), self._bridge)
        if report.mode != self._mode:
            self._mode = report.mode
            print(json.dumps({"mode": report.mode, "reason": report.reason & 0xFF}), flush=True)

    def step(self, now_ns: int, report: StateReport | None, logs: tuple) -> list[bytes]:
        received: list[bytes] = []
        while True:
            try:
                message = decode(self._socket.recv(65535))
            except (BlockingIOError, ConnectionRefusedError):
                return received
            assert isinstance(message, CraneSetpoint)
            # Two that arrive in one tick keep their order.
            received.append(encode(replace(message, stamp_ns=now_ns + 1000 * len(received) - 1000)))


class NoLogs:
    """A detector that sees nothing."""

    def detect(self, q: Sequence[float], now_ns: int) -> None:
        return None


def main() -> None:
    relay, running = Relay(int(sys.argv[1])), [True]
    signal.signal(signal.SIGTERM, lambda number, _: running.clear())
    plant = KinematicMachine(SETTINGS.profile, 1, step_ns=2_500_000)
    operator = Operator(SETTINGS.profile_hash, lambda action, _: None)
    observer, guard = Observer(None, [relay.send]), build_guard(profile_path("palms_471"))
    system = Lockstep(SETTINGS, guard, plant, relay, operator, observer, NoLogs())
    print(json.dumps({"port": relay.port}), flush=True)
    offset_ns = time.monotonic_ns() - system.now_ns
    while running:
        system.advance()
        ahead_s = (system.now_ns + offset_ns - time.monotonic_ns()) * 1e-9
        if ahead_s > 0.0:
            time.sleep(ahead_s)
        elif ahead_s < -0.1:
            offset_ns = time.monotonic_ns() - system.now_ns  # never catch up in a burst


if __name__ == "__main__":
    main()
