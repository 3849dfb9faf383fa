"""The whole machine as processes in real time, on the wire and on vcan, including the death of processes.

A host whose time is stolen for longer than a frame's time-out stops the machine, as it must; the run then shows it and
the operator arms again.  What is asserted is the outcome, never a duration.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import can
import pytest

from can_dbc.dbc import codec
from can_dbc.timing.page import default_path, read_timing
from hil.harness.live import ADDRESSES
from hil.replay.recording import files_of
from hil.replay.replay import recorded_ticks
from host.exit_codes import ExitCode
from host.vcan_lab.choose import clock_here
from machine.status.reasons import Reason
from timberhand.why.timeline import reports_of

pytestmark = pytest.mark.timeout(700)


PATIENT = "--max-stops 120 --limit-s 600"
"""A host that is short of processor time stops the machine, rightly; the stand-in operator arms it again each time."""
Demo = Callable[..., subprocess.Popen[str]]


@pytest.fixture
def demo(tmp_path: Path) -> Iterator[Demo]:
    """Starts ``timberhand demo`` into ``tmp_path/run``, with a wire of its own; what still runs at the end is ended."""
    started: list[subprocess.Popen[str]] = []
    wire = tmp_path / "wire"
    wire.mkdir()

    def start(*arguments: str) -> subprocess.Popen[str]:
        words = f"-m timberhand demo --detector perfect --no-console --out {tmp_path / 'run'}"
        command = [sys.executable, *words.split(), *arguments]
        started.append(
            subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                text=True,
                env=os.environ | {"TIMBERHAND_WIRE_DIR": str(wire)},
            )
        )
        return started[-1]

    yield start
    for process in started:
        if process.poll() is None:
            process.send_signal(signal.SIGINT)
            try:
                process.communicate(timeout=60)
            except subprocess.TimeoutExpired:
                process.kill()


def await_line(process: subprocess.Popen[str], text: str) -> None:
    assert process.stdout is not None
    for line in process.stdout:
        if text in line:
            return
    pytest.fail(f"the run ended before it said {text!r}: {process.communicate()[1]}")


def last_commands(directory: Path) -> dict[str, dict[str, object]]:
    """The last ValveCmdA and ValveCmdB in the bus log, decoded."""
    database = codec.load("crane")
    last = {}
    for message in can.LogReader(str(directory / "crane0.log")):
        known = database.by_key.get(message.arbitration_id)
        if known is not None and known.name in ("ValveCmdA", "ValveCmdB"):
            last[known.name] = known.named(known.decode(bytes(message.data)))
    return last


def assert_neutral_and_readable(directory: Path) -> None:
    last = last_commands(directory)
    assert [last["ValveCmdA"][s] for s in ("Mode", "Slew", "Lift", "Tilt", "Ext")] == [0, 0, 0, 0, 0]
    assert last["ValveCmdB"]["ArmKey"] == 0
    assert last["ValveCmdB"]["Rot"] == 0
    assert json.loads((directory / "manifest.json").read_text())["complete"]


def test_the_job_on_the_wire(tmp_path: Path, demo: Demo) -> None:
    process = demo("--bus", "wire", "--live", "--seed", "103", *PATIENT.split())
    out, err = process.communicate(timeout=660)
    assert process.returncode == ExitCode.OK, out + err
    assert_neutral_and_readable(tmp_path / "run")


def test_the_job_on_vcan_where_candump_sees_it(tmp_path: Path) -> None:
    lab = [sys.executable, "-m", "host.vcan_lab"]
    way = json.loads(subprocess.run([*lab, "--check", "--json"], capture_output=True, text=True).stdout)
    if way["way"] is None:
        pytest.skip(f"no vcan here: {way['why']}")
    if shutil.which("candump") is None:
        pytest.skip("candump is missing: apt-get install can-utils")
    seen, run = tmp_path / "candump.txt", tmp_path / "run"
    job = f"{sys.executable} -m timberhand demo --bus vcan --no-console --seed 103 --out {run} {PATIENT}"
    script = f"candump -n 100 vcan0,210:7FF,182:7FF > {seen} & {job}"
    clock = clock_here(detects=True)  # as the command does: a camera leaves one processor too little for real time
    travel = ["--time-travel"] if clock is not None and clock.kind == "simulated" else []
    result = subprocess.run([*lab, *travel, "--", "sh", "-c", script], capture_output=True, text=True, timeout=660)
    assert result.returncode == ExitCode.OK, f"{way}, {clock}: {result.stdout}{result.stderr}"
    assert_neutral_and_readable(run)
    identifiers = {line.split()[1] for line in seen.read_text().splitlines()}
    assert identifiers == {"210", "182"}, "candump shows the commands and the encoder of the slew"


def test_ctrl_c_leaves_the_valves_neutral_and_the_logs_readable(tmp_path: Path, demo: Demo) -> None:
    process = demo("--bus", "wire", "--live")
    await_line(process, "→ ABOVE")
    time.sleep(1.5)  # into the motion
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=60)
    assert process.returncode == ExitCode.INTERRUPTED, err
    assert_neutral_and_readable(tmp_path / "run")


@pytest.mark.parametrize("victim", ["autonomy", "controller", "controller.guard", "sim"])
def test_a_killed_process_ends_the_run_with_one_sentence(tmp_path: Path, demo: Demo, victim: str) -> None:
    process = demo("--bus", "wire", "--live")
    await_line(process, "→ ABOVE")
    time.sleep(1.0)
    os.kill(pid_of(process.pid, victim), signal.SIGKILL)
    _, err = process.communicate(timeout=60)
    assert process.returncode == ExitCode.SAFETY_STOP, err
    assert "Traceback" not in err
    assert "[live.process-ended]" in err
    assert json.loads((tmp_path / "run" / "manifest.json").read_text())["complete"]


FLOOD = """
import os, socket, sys
if os.getuid() == 0:  # as another user
    os.setgroups([]), os.setgid(65534), os.setuid(65534)
link = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
print(link.bind(("127.0.0.1", 0)) or link.getsockname()[1], flush=True)
while True:  # small ones leave no gap in the queue for others
    link.sendto(b"x", ("127.0.0.1", int(sys.argv[1])))
"""


def test_a_flood_of_the_setpoint_port_stops_nothing_and_is_named(tmp_path: Path, demo: Demo) -> None:
    """A process of another user sends as fast as it can; the planner goes on, and the controller says who it is."""
    process = demo("--bus", "wire", "--live", "--seed", "103", *PATIENT.split())
    await_line(process, "→ ABOVE")
    found = json.loads((tmp_path / "run" / ADDRESSES).read_text())
    command = [sys.executable, "-c", FLOOD, str(found["ports"]["control"])]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as flood:
        try:
            assert flood.stdout is not None
            port = flood.stdout.readline().strip()
            page = default_path().with_name(f"live-{process.pid}.timing")
            await_line(process, "→ CARRY")
            words = read_timing(page).facts.words
            out, err = process.communicate(timeout=600)
            assert flood.poll() is None, "it floods until the end"
        finally:
            flood.kill()
    assert process.returncode == ExitCode.OK, out + err
    assert f"the last from UDP port {port}." in words
    files = files_of(tmp_path / "run")
    ticks = list(recorded_ticks(files))
    assert sum(tick.datagrams.count(b"") for tick in ticks) > 1000, "the flood came through to the controller"
    assert not {Reason(r.reason & 0xFF) for r in reports_of(ticks)} & {Reason.LEASE_LOST, Reason.SETPOINTS_REFUSED}


def pid_of(parent: int, module: str) -> int:
    """The child of ``parent`` that runs ``python -m module``."""
    for task in Path(f"/proc/{parent}/task").iterdir():
        for pid in (task / "children").read_text().split():
            arguments = Path(f"/proc/{pid}/cmdline").read_bytes().split(b"\0")
            if arguments[1:3] == [b"-m", module.encode()]:
                return int(pid)
    raise AssertionError(f"{module} does not run")
