"""A plant with its camera, the perception process and a console, as in a live run, but with a crane that rests.

Controller and planner are played: their datagrams are sent from here, so that neither needs a deadline.
"""

from __future__ import annotations

import json
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from math import isfinite, nan
from pathlib import Path
from typing import Any

from autonomy.perception.log_list import LogObservation, decode_logs, encode_request
from can_dbc.messages.datagrams import encode
from can_dbc.messages.mission import ChosenGrasp, encode_grasp
from console.console import Console
from console.server import create_app
from hil.harness.processes import free_udp_ports
from machine.geometry.grapple import tip_below_pin_m
from machine.loading.profile_file import load_profile, profile_hash
from runtime.errors import InputRefused
from tests.console.state_reports import at
from tests.live.console.served_page import served

PROFILE = load_profile("palms_471")
HASH = profile_hash(PROFILE)
CAMERA = "stick"
START_S = 90.0
HOST = "127.0.0.1"


@dataclass
class PerceivedRun:
    """The running parts: ``url`` of the page, the ports of plant and detector, and the logs that are perceived."""

    url: str
    plant: tuple[str, int]
    detector: tuple[str, int]
    console: Console
    q: tuple[float, ...]
    logs: tuple[LogObservation, ...] = ()
    grasp: ChosenGrasp | None = None
    over: threading.Event = field(default_factory=threading.Event)

    def choose_grasp(self) -> ChosenGrasp:
        """Let the planner choose a grasp of the first perceived log, across its axis."""
        log = self.logs[0]
        x, y, z = log.center_m
        pin = (x, y, z + tip_below_pin_m(PROFILE.grapple.jaws, 0.0))
        yaw = _yaw(log.axis[0], log.axis[1])
        self.grasp = ChosenGrasp(1, pin, yaw, (log.id,), f"log {log.id} alone, 97 % of 32 draws hold it")
        return self.grasp


@contextmanager
def perceived_run(folder: Path, logs: int = 4, **more: Any) -> Iterator[PerceivedRun]:
    """Start everything; ``more`` are further settings of the console."""
    sim, pictures, detector = free_udp_ports(3)
    reports = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    reports.bind((HOST, 0))
    reports.setblocking(False)
    with ExitStack() as stack:
        stack.callback(reports.close)
        words = f"--seed 3 --logs {logs} --bus crane0=virtual:perceived --port {sim} --camera {pictures}"
        plant = _start(stack, folder, "sim", *words.split())
        _await(plant, "ready")
        q = (*_ask(sim, "state")["joints"][:4], nan)
        words = f"--camera {CAMERA} --frames {HOST}:{pictures} --port {detector}"
        seeing = _start(stack, folder, "autonomy.perception", *words.split())
        _await(seeing, '"ready"')
        console = Console(PROFILE, HASH, scene=(HOST, detector), reports=reports, truth=(HOST, sim), **more)
        url = stack.enter_context(served(create_app(console)))
        run = PerceivedRun(url, (HOST, sim), (HOST, detector), console, q)
        playing = threading.Thread(target=_play, args=(run, reports.getsockname()))
        playing.start()
        stack.callback(playing.join)
        stack.callback(run.over.set)
        yield run


def _play(run: PerceivedRun, page: tuple[str, int]) -> None:
    """The planner asks for logs four times a second; the controller reports, twenty times a second, a crane at rest."""
    shown = tuple(v if isfinite(v) else 0.0 for v in run.q)
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as planner,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out,
    ):
        planner.connect(run.detector)
        planner.setblocking(False)
        n = 0
        while not run.over.wait(0.05):
            n += 1
            now = time.monotonic_ns()
            out.sendto(
                encode(
                    at(shown, now, profile_hash=HASH, sequence=n, grapple_state=1, opening_pct=100.0, clamp_bar=0.0)
                ),
                page,
            )
            if run.grasp is not None:
                out.sendto(encode_grasp(run.grasp, n, HASH, now), page)
            try:
                if n % 5 == 0:
                    planner.send(encode_request(run.q))
                run.logs = decode_logs(planner.recv(65536)) or run.logs
            except (BlockingIOError, ConnectionRefusedError, InputRefused):
                continue


def _yaw(x: float, y: float) -> float:
    from math import atan2, pi

    return atan2(y, x) + pi / 2


def _start(stack: ExitStack, folder: Path, module: str, *arguments: object) -> subprocess.Popen[str]:
    errors = stack.enter_context((folder / f"{module}.err").open("w"))
    child = subprocess.Popen(
        [sys.executable, "-m", module, *map(str, arguments)], stdout=subprocess.PIPE, stderr=errors, text=True
    )
    stack.callback(child.wait)
    stack.callback(child.terminate)
    return child


def _await(child: subprocess.Popen[str], word: str) -> None:
    limit = threading.Timer(START_S, child.kill)
    limit.start()
    assert child.stdout is not None
    line = child.stdout.readline()
    limit.cancel()
    assert word in line, f"{child.args} did not start: {line!r}"


def _ask(port: int, op: str) -> dict[str, Any]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as client:
        client.settimeout(5.0)
        client.sendto(json.dumps({"op": op}).encode(), (HOST, port))
        return dict(json.loads(client.recv(65536)))
