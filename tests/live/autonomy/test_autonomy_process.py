"""The planning process: its command line, its sockets, its JSON lines and its exit codes."""

from __future__ import annotations

import json
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import replace

import pytest

from autonomy.__main__ import main
from autonomy.perception.log_list import decode_request
from autonomy.process.command_line import BUSY, CONFIGURATION, FAILED, INTERRUPTED, SAFETY
from can_dbc.messages.crane import CraneSetpoint
from can_dbc.messages.datagrams import decode, encode
from machine.loading.profile_file import load_profile
from machine.status.modes import Mode
from tests.autonomy.crane_stand_in import GROUND_LOG, StandIn
from tests.codes import numbers_in
from tests.operator_end import udp_end

PROFILE = load_profile("palms_471")
LOGS = [{"position_m": [-1.8, 4.4, -1.29], "axis": [0.6, 0.8, 0.0], "length_m": 2.6, "diameter_m": 0.2}]


class World:
    """A controller and a detector at the other ends of the process's sockets."""

    def __init__(self) -> None:
        self.crane = StandIn(PROFILE, [GROUND_LOG])
        self.setpoints: list[CraneSetpoint] = []
        self.joints: tuple[float, ...] = ()
        self._control, self._scene = (socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2))
        with udp_end(None) as probe:
            self._planner = probe.getsockname()
        for link in (self._control, self._scene):
            link.bind(("127.0.0.1", 0))
            link.setblocking(False)
        ports = [link.getsockname()[1] for link in (self._control, self._scene)]
        words = f"--controller 127.0.0.1:{ports[0]} --scene 127.0.0.1:{ports[1]} --report-port {self._planner[1]}"
        self.process = subprocess.Popen(
            [sys.executable, "-m", "autonomy", *words.split()],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )

    def live(self, mode: Mode, enough: int = 0, **changes: object) -> None:
        """Send reports and log lists until ``enough`` setpoints are received or the process has ended."""
        deadline = time.monotonic() + 20.0
        while time.monotonic() < deadline and self.process.poll() is None:
            report = replace(self.crane.report(), stamp_ns=time.monotonic_ns(), mode=mode, **changes)  # type: ignore[arg-type]
            self._control.sendto(encode(report), self._planner)
            time.sleep(0.02)
            while data := _took(self._control):
                message = decode(data[0])
                assert isinstance(message, CraneSetpoint)
                self.setpoints.append(message)
                self.crane.q = message.knots[0].position
            while question := _took(self._scene):
                self.joints = decode_request(question[0]).q
                self._scene.sendto(json.dumps(LOGS).encode(), question[1])
            if enough and len(self.setpoints) >= enough:
                return

    def end(self) -> tuple[int, list[dict[str, object]], str]:
        """Exit code, events and complaints."""
        out, err = self.process.communicate(timeout=10)
        return self.process.returncode, [json.loads(line) for line in out.splitlines()], err

    def close(self) -> None:
        self.process.kill()
        self.process.wait()
        self._control.close()
        self._scene.close()


def _took(link: socket.socket) -> tuple[bytes, tuple[str, int]] | None:
    try:
        return link.recvfrom(65535)
    except BlockingIOError:
        return None


@pytest.fixture
def world() -> Iterator[World]:
    world = World()
    yield world
    world.close()


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_ends_the_job_with_a_final_hold(world: World, number: signal.Signals) -> None:
    world.live(Mode.ARMED, enough=30)
    world.process.send_signal(number)
    world.live(Mode.ACTIVE)
    code, events, _ = world.end()
    assert code == INTERRUPTED
    last = world.setpoints[-1]
    assert last.final and not any(v for k in last.knots for v in k.velocity)
    seen = [e["phase"] for e in events if e["event"] == "phase"]
    assert seen[-3:] == ["LOOK", "ABOVE", "FAILED"]
    (grasp,) = (e for e in events if e["event"] == "grasp")
    assert grasp["logs"] == [0] and grasp["probability"] == 1.0
    assert numbers_in(str(grasp["reason"]))[:4] == [1, 0, 1, 100], "one log, the first, of one, with certainty"
    assert events[-1]["event"] == "failed" and number.name in str(events[-1]["reason"])


def test_an_interruption_in_a_controller_fault_has_its_own_exit_code(world: World) -> None:
    world.live(Mode.ARMED, enough=8)
    assert world.joints[:2] == pytest.approx(world.crane.q[:2], abs=0.1), "a detector on the crane needs the joints"
    world.process.send_signal(signal.SIGTERM)
    world.live(Mode.FAULT)
    assert world.end()[0] == SAFETY


def test_a_controller_with_another_profile_ends_it(world: World) -> None:
    world.live(Mode.ARMED, profile_hash=1)
    code, _, complaint = world.end()
    assert code == CONFIGURATION and complaint.count("\n") == 1 and not world.setpoints


def test_a_mission_that_fails_gives_its_reason(world: World) -> None:
    LOGS[0]["position_m"] = [-7.0, 7.0, -1.29]
    try:
        world.live(Mode.ARMED)
    finally:
        LOGS[0]["position_m"] = [-1.8, 4.4, -1.29]
    code, events, _ = world.end()
    assert code == FAILED and str(events[-1]["reason"]).count("(-7.00, 7.00, ") == 1


@pytest.mark.parametrize(
    ("extra", "value"),
    [
        (["--profile", "palms_472"], '"palms_471"'),
        (["--lease-ms", "900"], "1..200"),
        (["--mission", "here.geojson"], "palms_471"),
        (["--profile", "aoro_fc8", "--mission", "/none.geojson"], "/none.geojson"),
    ],
)
def test_a_configuration_error_is_one_sentence(
    extra: list[str], value: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert (
        main(["--controller", "127.0.0.1:1", "--scene", "127.0.0.1:2", "--report-port", "0", *extra]) == CONFIGURATION
    )
    assert value in capsys.readouterr().err


def test_a_port_in_use_has_its_own_exit_code(capsys: pytest.CaptureFixture[str]) -> None:
    with udp_end(None) as other:
        port = str(other.getsockname()[1])
        arguments = ["--controller", "127.0.0.1:1", "--scene", "127.0.0.1:2", "--report-port", port]
        assert main(arguments) == BUSY
    assert port in capsys.readouterr().err
