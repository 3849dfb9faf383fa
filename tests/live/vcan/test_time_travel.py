"""Deadlines of the real processes on real sockets, to the microsecond: three runs in simulated time (`virtual_run`).

Simulated time passes only while every process sleeps, so each figure is what the code does, whatever the host does.
What computing costs does not show here: that is measured (``timberhand bench timing``).
"""

from __future__ import annotations

import compileall
import json
import math
import os
import subprocess
import sys
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from can_dbc.bus.reconnector import FIRST_RETRY_NS, RETRY_PERIOD_NS
from can_dbc.dbc import codec
from can_dbc.frame import Frame
from can_dbc.trace.candump import read_trace
from controller.config import load as load_settings
from controller.guard.__main__ import PERIOD_NS as GUARD_PERIOD_NS
from host.service_lab.pilot import LEASE_NS
from host.vcan_lab import uml
from host.vcan_lab.spec import VIRTUAL_START_NS
from machine.status.modes import Mode
from machine.status.reasons import Reason
from sim.nodes.valve import CYCLE_NS, GUARD_NS, PILOT_NS, RAMP_NS, SYNC_NS, ValveState

pytestmark = [
    pytest.mark.timeout(300),
    pytest.mark.bears(math.inf),
]
ROOT = Path(__file__).parents[3]
RUNS = 3
US, MS = 1_000, 1_000_000
SETTINGS = load_settings("palms_471")
PERIOD_NS, LEAD_NS = SETTINGS.period_ns, SETTINGS.sync_lead_ns
CODE_NS = 100 * US
"""Reading the clock costs up to 1 us of simulated time, so that a loop that waits for it ends; a tick reads many.

How many depends on the host's files and environment too: moments agree to the microsecond between runs of one
host, not between hosts, and no bound here may be tighter than this on either side.
"""
NODES_STEP_NS = 2_500_000
DATABASE = codec.load("crane")
NAMES = {message.key: name for name, message in DATABASE.messages.items()}
HEARTBEAT_NS = 100 * MS


@pytest.fixture(autouse=True)
def _in_the_lab() -> None:
    """These start a lab of their own."""


class Seen(NamedTuple):
    """A frame: when, since the start of simulated time, and its values."""

    at_ns: int
    values: dict[str, Any]


class Recording:
    """What one run left behind."""

    def __init__(self, directory: Path) -> None:
        self.log = (directory / "vcan0.log").read_bytes()
        self.page_text = (directory / "page.json").read_text()
        self.page: dict[str, int] = json.loads(self.page_text)
        self.said = {path.name: path.read_text() for path in directory.glob("*.out")}
        self.frames: dict[int | str, list[Seen]] = {}
        for frame in read_trace(directory / "vcan0.log"):
            assert isinstance(frame, Frame), frame
            name = NAMES.get(frame.key)
            message = DATABASE.messages[name] if name else None
            values = message.named(message.decode(frame.data)) if message else {"data": frame.data}
            self.frames.setdefault(name or frame.key, []).append(Seen(frame.stamp_ns - VIRTUAL_START_NS, values))

    def stamps(self, name: int | str, begin_ns: int = 0, end_ns: int = 1 << 62) -> list[int]:
        """When frames of one kind were seen, in a window."""
        return [frame.at_ns for frame in self.frames[name] if begin_ns <= frame.at_ns < end_ns]

    def last(self, name: int | str, before_ns: int) -> int:
        return self.stamps(name, end_ns=before_ns)[-1]

    def first(self, name: int | str, after_ns: int, when: Callable[[dict[str, Any]], object] = lambda _: True) -> int:
        """When the first such frame came, from a moment on."""
        return next(frame.at_ns for frame in self.frames[name] if frame.at_ns >= after_ns and when(frame.values))

    def reason(self, mode: Mode, after_ns: int) -> Reason:
        """Why the controller was in a mode, from a moment on."""
        at_ns = self.first("CtrlStatus", after_ns, lambda status: status["Mode"] == mode)
        return Reason(next(f.values["Reason"] for f in self.frames["CtrlStatus"] if f.at_ns == at_ns))


def neutral(command: dict[str, Any]) -> bool:
    """Whether ValveCmdA opens nothing."""
    return command["Mode"] == 0 and not any(command[spool] for spool in ("Slew", "Lift", "Tilt", "Ext"))


@pytest.fixture(scope="module")
def travel() -> Callable[..., subprocess.CompletedProcess[str]]:
    """Runs a program of this Python in simulated time.

    Compiles the packages first: a run that writes bytecode reads the clock more often than the next one, which finds
    it, and is some microseconds behind it ever after.
    """
    if uml.find(uml.user_cache()) is None:
        pytest.skip(uml.MISSING)
    for package in ROOT.glob("*/__init__.py"):
        assert compileall.compile_dir(package.parent, quiet=1), package

    def run(*words: object) -> subprocess.CompletedProcess[str]:
        lab = [
            sys.executable,
            "-m",
            "host.vcan_lab",
            "--time-travel",
            "--root",
            "--timeout",
            "120",
            "--",
            sys.executable,
        ]
        environment = {**os.environ, "PYTHONPATH": str(ROOT)}
        return subprocess.run(
            [*lab, *map(str, words)], cwd=ROOT, env=environment, capture_output=True, text=True, check=False
        )

    return run


@pytest.fixture(scope="module")
def recordings(
    tmp_path_factory: pytest.TempPathFactory, travel: Callable[..., subprocess.CompletedProcess[str]]
) -> list[Recording]:
    """Three runs, the first of them with files that were written a moment ago."""
    if not any(Path(folder, "candump").exists() for folder in os.get_exec_path()):
        pytest.skip("candump is missing (apt-get install can-utils)")
    for bytecode in ROOT.glob("host/**/*.pyc"):
        bytecode.touch()
    made = []
    for k in range(RUNS):
        directory = tmp_path_factory.mktemp(f"run{k}")
        done = travel(Path(__file__).with_name("virtual_run.py"), directory)
        assert done.returncode == 0, done.stderr + "".join(path.read_text() for path in directory.glob("*.err"))
        made.append(Recording(directory))
    return made


@pytest.fixture
def run(recordings: list[Recording]) -> Recording:
    return recordings[0]


def test_three_runs_are_the_same_to_the_byte_stamps_included(recordings: list[Recording]) -> None:
    first = recordings[0]
    assert len(first.log.splitlines()) > 30_000
    for other in recordings[1:]:
        assert other.log == first.log
        assert other.page_text == first.page_text
        assert other.said == first.said


def test_commands_leave_every_period_and_sync_its_lead_before(run: Recording) -> None:
    begin_ns, end_ns = run.frames["ValveCmdA"][1].at_ns, run.page["frozen"]
    commands, syncs = run.stamps("ValveCmdA", begin_ns, end_ns), run.stamps("Sync", begin_ns - PERIOD_NS, end_ns)
    assert len(commands) > 1500
    origin_ns = commands[0]
    for k, (command_ns, sync_ns) in enumerate(zip(commands, syncs, strict=False)):
        assert abs(command_ns - origin_ns - k * PERIOD_NS) <= CODE_NS
        assert abs(command_ns - sync_ns - LEAD_NS) <= CODE_NS


def test_encoders_answer_a_sync_before_the_tick_that_uses_it(run: Recording) -> None:
    """The controller reports it itself: from SYNC to the command that follows from the sample, a lead and a tick."""
    timing = json.loads(run.said["controller.out"])["timing"]
    assert abs(timing["sample_to_command"]["p50_us"] * US - LEAD_NS) <= CODE_NS
    assert timing["wake"]["p99_us"] * US <= CODE_NS


@pytest.mark.parametrize("name", ["HeartbeatCtrl", "HeartbeatGuard"])
def test_heartbeats_keep_their_period(run: Recording, name: str) -> None:
    stamps = run.stamps(name, end_ns=run.page["frozen"])
    assert len(stamps) > 70
    assert all(abs(b - a - HEARTBEAT_NS) <= CODE_NS for a, b in pairwise(stamps[1:]))


def test_an_expired_lease_ramps_down_to_neutral(run: Recording) -> None:
    """The first tick at its end or after it begins the profile's ramp; the pilot's last knot is no later."""
    end_ns, ramp_ns = run.page["setpoint"] + LEASE_NS, SETTINGS.profile.timeouts.stop_ramp_ms * MS
    neutral_ns = run.first("ValveCmdA", run.page["setpoint"], neutral)
    assert run.reason(Mode.STOP, run.page["setpoint"]) is Reason.LEASE_LOST
    assert -CODE_NS <= neutral_ns - ramp_ns - end_ns < PERIOD_NS + CODE_NS
    assert run.first("ValveCmdB", run.page["setpoint"], lambda b: b["ArmKey"] == 0) - neutral_ns <= CODE_NS


def test_an_emergency_stop_is_neutral_at_the_next_tick(run: Recording) -> None:
    pressed_ns = run.first("EstopStat", run.page["estop"], lambda e: e["ChannelA"] == 0)
    neutral_ns = run.first("ValveCmdA", run.page["estop"], neutral)
    ticks = run.stamps("ValveCmdA", pressed_ns)
    assert neutral_ns == ticks[0]
    assert 0 < neutral_ns - pressed_ns < PERIOD_NS
    off_ns = run.first("ValveFbA", pressed_ns, lambda a: a["State"] == ValveState.PILOT_OFF)
    assert off_ns - pressed_ns <= CYCLE_NS + CODE_NS
    refused_ns = run.first("GuardStat", pressed_ns, lambda g: g["Enable"] == 0)
    assert refused_ns - pressed_ns <= GUARD_PERIOD_NS + CODE_NS  # its turns have no fixed phase to the others'
    assert run.reason(Mode.FAULT, pressed_ns) is Reason.ESTOP_PRESSED


def test_the_valve_node_goes_to_neutral_when_the_controller_hangs(run: Recording) -> None:
    """SYNC is missed first; then the node's own ramp, its fault, and the pilot is off."""
    frozen_ns = run.page["frozen"]
    silent_ns = run.last("Sync", frozen_ns)
    ramp_ns, fault_ns, off_ns = (
        run.first("ValveFbA", frozen_ns, lambda a, state=state: a["State"] == state)
        for state in (ValveState.RAMP, ValveState.FAULT, ValveState.PILOT_OFF)
    )
    assert SYNC_NS < ramp_ns - silent_ns <= SYNC_NS + NODES_STEP_NS + CYCLE_NS + CODE_NS
    assert abs(fault_ns - ramp_ns - RAMP_NS) <= CODE_NS
    assert fault_ns - silent_ns < 100 * MS
    assert 0 < off_ns - run.last("ValveCmdA", frozen_ns) - PILOT_NS <= NODES_STEP_NS + CYCLE_NS + CODE_NS


def test_a_controller_that_wakes_late_skips_ticks_and_restarts_disarmed(run: Recording) -> None:
    frozen_ns, thawed_ns = run.page["frozen"], run.page["thawed"]
    commands = [frame for frame in run.frames["ValveCmdA"] if frozen_ns <= frame.at_ns < thawed_ns + 20 * MS]
    assert len(commands) <= 4 + 1  # those of 20 ms, and none of the hundred that were missed
    assert all(neutral(frame.values) for frame in commands)
    assert commands[0].at_ns - thawed_ns <= PERIOD_NS + CODE_NS
    assert run.reason(Mode.FAULT, thawed_ns) is Reason.COMPUTER_STALLED  # not the guard, which refused
    before_ns = run.last("ValveCmdA", frozen_ns)
    told = json.loads(run.said["controller.out"])
    assert told["missed"] == (commands[0].at_ns - before_ns) // PERIOD_NS - 1
    off_grid_ns = (commands[1].at_ns - before_ns + PERIOD_NS // 2) % PERIOD_NS - PERIOD_NS // 2
    assert abs(off_grid_ns) <= CODE_NS  # the old grid of deadlines goes on


def test_without_the_guard_valves_and_controller_are_neutral_within_60_ms(run: Recording) -> None:
    killed_ns = run.page["guard_killed"]
    silent_ns = run.last("GuardStat", killed_ns)
    closes = (ValveState.RAMP, ValveState.PILOT_OFF)  # enable and pilot supply are lost together
    assert run.first("ValveFbA", killed_ns, lambda a: a["State"] in closes) - silent_ns > GUARD_NS
    assert run.first("ValveCmdA", killed_ns, neutral) - silent_ns <= GUARD_NS + PERIOD_NS + CODE_NS
    assert run.reason(Mode.FAULT, killed_ns) is Reason.GUARD_LOST


@pytest.mark.parametrize(("down", "up"), [("down", "up"), ("down_long", "up_long")])
def test_a_returned_interface_is_used_again_disarmed(run: Recording, down: str, up: str) -> None:
    down_ns, up_ns = run.page[down], run.page[up]
    tries = [down_ns + FIRST_RETRY_NS + k * RETRY_PERIOD_NS for k in range(10)]
    due_ns = next(at_ns for at_ns in tries if at_ns >= up_ns)
    back_ns = run.first("ValveCmdA", down_ns)
    assert not run.stamps("ValveCmdA", down_ns, due_ns)
    assert due_ns < back_ns <= due_ns + 2 * PERIOD_NS
    after = [frame for frame in run.frames["ValveCmdA"] if back_ns <= frame.at_ns < back_ns + 300 * MS]
    assert all(neutral(frame.values) for frame in after)
    assert run.reason(Mode.FAULT, back_ns) is Reason.BUS_DOWN


def test_the_demo_in_simulated_time_misses_no_tick_and_no_setpoint(
    travel: Callable[..., subprocess.CompletedProcess[str]], tmp_path: Path
) -> None:
    """Every process of it: on a host of any speed the machine is never stopped, for none of them is ever late."""
    done = travel(
        "-m", "timberhand", "demo", "--detector", "perfect", "--bus", "vcan", "--no-console", "--out", tmp_path / "run"
    )
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr
    told = json.loads((tmp_path / "run/summary.json").read_text())
    assert told["in_bunk"]
    assert (told["missed_ticks"], told["stops"], told["refused_setpoints"]) == (0, 0, 0)
