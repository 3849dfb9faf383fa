"""The planning process: its command port and its mission reports, with a job stand-in."""

from __future__ import annotations

import json
import socket
import time
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import pytest

from autonomy.process.command_line import arguments
from autonomy.process.planner_process import PlannerProcess
from can_dbc.messages.mission import (
    ChosenGrasp,
    MissionAction,
    MissionCommand,
    MissionReport,
    decode_grasp,
    decode_mission,
    encode_mission_command,
)
from machine.status.reasons import Reason
from tests.can_dbc.example_mission_report import MISSION_REPORT
from tests.console.state_reports import REPORT
from tests.operator_end import udp_end

HASH, KEY = 77, b"key"


class Jobless:
    """A job that refuses Pause and executes all other commands."""

    idle = done = drives = False
    failure = None

    def __init__(self) -> None:
        self.executed: list[MissionAction] = []
        self.grasp: ChosenGrasp | None = None

    def step(self, *_: object) -> list[bytes]:
        return []

    def standpoint(self, now_ns: int) -> None:
        """No camera ahead."""

    def events(self) -> Iterator[Any]:
        return iter(())

    def execute(self, command: MissionCommand) -> str:
        self.executed.append(command.action)
        return "not now" if command.action is MissionAction.PAUSE else ""

    def report(self, now_ns: int) -> MissionReport:
        return MISSION_REPORT

    def chosen_grasp(self) -> ChosenGrasp | None:
        return self.grasp


@pytest.fixture
def watcher() -> Iterator[socket.socket]:
    with udp_end(5) as s:
        yield s


@pytest.fixture
def process(watcher) -> Iterator[tuple[PlannerProcess, Jobless]]:
    there = "127.0.0.1:9"
    told = f"127.0.0.1:{watcher.getsockname()[1]}"
    words = f"--controller {there} --scene {there} --report-port 0 --order-port 0 --tell {told} --tell {there}"
    options = arguments(words.split())
    job = Jobless()
    made = PlannerProcess(job, HASH, options, KEY)  # type: ignore[arg-type]
    yield made, job
    made.close()


def give(process: PlannerProcess, action: MissionAction, key: bytes | None = KEY, late_ns: int = 0) -> None:
    now_ns = time.monotonic_ns()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
        out.sendto(
            encode_mission_command(MissionCommand(1, HASH, now_ns - late_ns, action), key),
            process._commands.getsockname(),
        )
    process.step(time.monotonic_ns())


def said(capsys) -> list[dict[str, Any]]:
    return [m for m in map(json.loads, capsys.readouterr().out.splitlines()) if m["event"] == "order"]


def test_a_command_is_executed_and_emitted(process, capsys) -> None:
    give(process[0], MissionAction.ABORT)
    give(process[0], MissionAction.PAUSE)
    assert process[1].executed == [MissionAction.ABORT, MissionAction.PAUSE]
    assert [(m.get("order"), m.get("refused")) for m in said(capsys)] == [("ABORT", None), ("PAUSE", "not now")]


def test_old_and_unsigned_commands_are_not_executed(process, capsys) -> None:
    give(process[0], MissionAction.ABORT, late_ns=2_000_000_000)
    give(process[0], MissionAction.ABORT, key=None)
    assert process[1].executed == []
    first, second = said(capsys)
    assert "order" not in first and "2.0 s" in first["refused"] and second["refused"]


def test_reports_are_sent_twice_a_second_and_after_a_command(process, watcher) -> None:
    begin_ns = time.monotonic_ns()
    for k in range(100):  # two seconds
        process[0].step(begin_ns + k * 20_000_000)
    watcher.setblocking(False)
    reports = []
    while True:
        try:
            reports.append(decode_mission(watcher.recv(65536), KEY))
        except BlockingIOError:
            break
    assert [report for *_, report in reports] == [MISSION_REPORT] * 4 and reports[0][:2] == (HASH, begin_ns)
    give(process[0], MissionAction.AUTO)
    assert watcher.recv(65536)


def test_refused_setpoints_are_told_each_time_and_a_flood_of_strangers_once(process, capsys) -> None:
    told = [(1, Reason.JOINT_SPEED), (2, Reason.JOINT_SPEED)]
    told += [(k, Reason.DATAGRAM_AUTHENTICATION) for k in range(60, 600, 60)] + [(601, Reason.JOINT_SPEED)]
    for refused, refusal in told:
        process[0]._emit_changes(replace(REPORT, refused=refused, refusal=refusal))
    events = map(json.loads, capsys.readouterr().out.splitlines())
    assert [m["count"] for m in events if m["event"] == "refused"] == [1, 2, 60, 601]


def test_the_command_port_is_bound_to_loopback(process) -> None:
    assert process[0]._commands.getsockname()[0] == "127.0.0.1"


def test_a_chosen_grasp_is_sent_while_there_is_one(process, watcher) -> None:
    made, job = process
    job.grasp = ChosenGrasp(1, (0.1, 4.0, 0.4), 1.2, (3,), "log 3 alone")
    made.step(time.monotonic_ns())
    assert decode_grasp(watcher.recv(65536), KEY)[::2] == (HASH, job.grasp)
    assert decode_mission(watcher.recv(65536), KEY)[2].name == MISSION_REPORT.name
    job.grasp = None
    made.step(time.monotonic_ns() + 600_000_000)
    assert decode_mission(watcher.recv(65536), KEY)[2].name == MISSION_REPORT.name
