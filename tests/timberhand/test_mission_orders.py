"""``timberhand mission start|pause|resume|abort`` and a waiting planner in one process."""

from __future__ import annotations

import json
import socket
from collections.abc import Iterator
from pathlib import Path

import pytest
from typer.testing import CliRunner

from autonomy.process.planner_process import PlannerProcess
from can_dbc.messages.crane import ModeSwitch
from host.exit_codes import CommandFailed, ExitCode
from machine.status.modes import Mode
from runtime.errors import TimberhandError
from tests.autonomy.mission_checks import EXAMPLES
from tests.codes import coded, exit_code_of
from tests.live.autonomy.waiting_planner import PROFILE, planner_process, report_machine
from timberhand import mission_orders
from timberhand.cli import app

KEY = b"0123456789abcdef"
FILE = EXAMPLES / "paper_b.geojson"
RUNNER = CliRunner()


class Machine:
    """A planner whose steps follow the orders, and the folder and key of both."""

    def __init__(self, place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.folder, self.key = place / "missions", place / "key"
        self.folder.mkdir()
        self.key.write_bytes(KEY)
        self.process: PlannerProcess = planner_process(9, KEY, "--missions", str(self.folder))
        self.deaf, self._now_ns = False, 1_000_000_000
        monkeypatch.setattr(mission_orders, "monotonic_ns", self.clock_ns)
        monkeypatch.setattr(mission_orders, "exchange", self.exchange)

    def clock_ns(self) -> int:
        """A millisecond later each time."""
        self._now_ns += 1_000_000
        return self._now_ns

    def auto(self) -> bool:
        """The mode switch of the mission."""
        report = self.process.job.report(self.clock_ns())
        assert report is not None
        return report.auto

    def stands(self, mode: Mode = Mode.STANDBY, switch: ModeSwitch = ModeSwitch.NOT_FITTED) -> None:
        report_machine(self.process._link.getsockname(), KEY, mode, switch=switch)
        self.process.step(self.clock_ns())

    def exchange(self, port: int, order: bytes) -> Iterator[bytes]:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as link:
            link.connect(self.process._commands.getsockname())
            link.setblocking(False)
            link.send(order)
            if self.deaf:
                return
            self.process.step(self.clock_ns())
            try:
                while True:
                    yield link.recv(65535)
            except BlockingIOError:
                return

    def run(self, *words: str, key: Path | None = None) -> int:
        done = RUNNER.invoke(app, ["mission", *words, "--key-file", str(key or self.key)])
        return exit_code_of(done.exception) if isinstance(done.exception, TimberhandError) else done.exit_code

    def start(self, file: Path = FILE) -> int:
        return self.run("start", str(file), "--missions", str(self.folder))


@pytest.fixture
def machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Machine]:
    made = Machine(tmp_path, monkeypatch)
    yield made
    made.process.close()


def test_a_mission_is_started_paused_resumed_and_aborted(machine: Machine) -> None:
    machine.stands()
    assert machine.start() == ExitCode.OK
    assert machine.auto() and machine.process.job.begun
    assert machine.run("pause") == ExitCode.OK and not machine.auto()
    assert machine.run("resume") == ExitCode.OK and machine.auto()
    assert machine.start() == ExitCode.SAFETY_STOP, "it has begun"
    assert machine.run("abort") == ExitCode.OK and machine.process.job.failure


@pytest.mark.parametrize(("switch", "code"), [(ModeSwitch.IDLE, "switch.idle"), (ModeSwitch.FAULTY, "switch.faulty")])
def test_the_operators_switch_forbids_a_start(machine: Machine, switch: ModeSwitch, code: str) -> None:
    machine.stands(switch=switch)
    orders = mission_orders.PlannerOrders(1, machine.process._hash, KEY)
    mission = mission_orders.checked(FILE, PROFILE)
    with pytest.raises(CommandFailed, check=coded(code)):
        orders.start(mission, "m.geojson", machine.folder)
    assert not machine.auto() and not machine.process.job.begun
    assert machine.run("resume") == ExitCode.SAFETY_STOP


def test_turning_the_switch_to_auto_starts_the_mission_that_waits(machine: Machine) -> None:
    machine.stands(switch=ModeSwitch.IDLE)
    assert machine.start() == ExitCode.SAFETY_STOP, "it is uploaded, and waits"
    machine.stands(switch=ModeSwitch.AUTO)
    assert machine.auto() and machine.process.job.begun


def test_a_switch_that_was_turned_before_the_upload_starts_nothing(machine: Machine) -> None:
    machine.stands(switch=ModeSwitch.IDLE)
    machine.stands(switch=ModeSwitch.AUTO)
    orders = mission_orders.PlannerOrders(1, machine.process._hash, KEY)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(orders.__class__, "order", lambda *_: None)
        orders.start(mission_orders.checked(FILE, PROFILE), "m.geojson", machine.folder)
    machine.stands(switch=ModeSwitch.AUTO)
    assert not machine.auto() and not machine.process.job.begun
    assert machine.run("resume") == ExitCode.OK and machine.auto()


@pytest.mark.parametrize(("mode", "code"), [(None, "upload.no-report"), (Mode.ARMED, "upload.armed")])
def test_no_mission_is_started_unless_the_machine_rests(machine: Machine, mode: Mode | None, code: str) -> None:
    if mode is not None:
        machine.stands(mode)
    assert machine.start() == ExitCode.SAFETY_STOP
    orders = mission_orders.PlannerOrders(1, machine.process._hash, KEY)
    with pytest.raises(CommandFailed, check=coded(code)):
        orders.start(mission_orders.checked(FILE, PROFILE), "m.geojson", machine.folder)
    assert machine.run("resume") == ExitCode.SAFETY_STOP, "there is no mission"


def test_a_mission_that_cannot_be_driven_is_refused_before_it_is_sent(machine: Machine, tmp_path: Path) -> None:
    """By the checks of plan check, with its exit code."""
    machine.stands()
    document = json.loads(FILE.read_text())
    for feature in document["features"]:
        if feature["properties"].get("role") == "route":
            feature["geometry"]["coordinates"] = feature["geometry"]["coordinates"][:1]
    bad = tmp_path / "bad.geojson"
    bad.write_text(json.dumps(document))
    checked = RUNNER.invoke(app, ["plan", "check", str(bad)]).exception
    assert isinstance(checked, TimberhandError)
    assert machine.start(bad) == exit_code_of(checked) == ExitCode.CONFIGURATION
    assert list(machine.folder.iterdir()) == []
    assert machine.start(tmp_path / "none.geojson") == ExitCode.CONFIGURATION


def test_without_the_key_nothing_is_ordered(machine: Machine, tmp_path: Path) -> None:
    machine.stands()
    other = tmp_path / "other"
    other.write_bytes(b"another key of 16")
    assert machine.run("start", str(FILE), "--missions", str(machine.folder), key=other) == ExitCode.BUS
    assert machine.run("pause", key=tmp_path / "none") == ExitCode.CONFIGURATION
    assert not machine.process.job.begun


def test_a_planner_that_does_not_answer_is_named(machine: Machine) -> None:
    machine.deaf = True
    assert machine.run("abort") == ExitCode.BUS


def test_a_mission_that_cannot_be_saved_is_refused(machine: Machine, tmp_path: Path) -> None:
    machine.stands()
    (tmp_path / "file").touch()
    assert machine.run("start", str(FILE), "--missions", str(tmp_path / "file")) == ExitCode.CONFIGURATION
    odd = tmp_path / "-odd;name.geojson"
    odd.write_bytes(FILE.read_bytes())
    assert machine.start(odd) == ExitCode.CONFIGURATION
