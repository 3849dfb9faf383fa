"""The one-log job in paced virtual time: the bytes of lockstep, the pace of the clock, the buttons of the page."""

from __future__ import annotations

import hashlib
import io
import socket
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from rich.console import Console as Screen

from autonomy.perception.log_list import decode_logs, encode_request
from can_dbc.messages.crane import OperatorAction, OperatorCommand, StateReport
from can_dbc.messages.datagrams import decode, encode
from can_dbc.messages.vehicle import VehicleReport
from console.console import Console
from console.state import CraneState
from controller.tick import Outputs
from hil.demo.lockstep import Companion, run_lockstep
from hil.demo.paced import SLACK_NS, Pace, Paced, PageLink, in_real_time, in_virtual_time
from hil.demo.summary import Summary
from hil.harness.lockstep import START_NS, Lockstep
from machine.loading.profile_file import load_profile, profile_hash
from machine.status.modes import Mode
from machine.status.reasons import Reason
from tests.console.vehicle_reports import VEHICLE
from tests.operator_end import udp_end

PROFILE = load_profile("palms_471")
HASH = profile_hash(PROFILE)
BEGIN_NS = 5_000_000_000_000_000
S = 1_000_000_000


class Wall:
    """A wall clock that only sleep moves, unless the computer stands still."""

    def __init__(self) -> None:
        self.now_ns = BEGIN_NS
        self.slept = 0

    def clock(self) -> int:
        return self.now_ns

    def sleep(self, until_ns: int) -> None:
        assert until_ns > self.now_ns
        self.now_ns = until_ns
        self.slept += 1


@pytest.fixture
def wall() -> Wall:
    return Wall()


@pytest.fixture
def hears() -> Iterator[socket.socket]:
    """What a page hears."""
    with udp_end() as heard:
        yield heard


@pytest.fixture
def link(tmp_path: Path, hears: socket.socket) -> Iterator[PageLink]:
    made = PageLink(tmp_path / "operator", hears.getsockname()[1], HASH)
    yield made
    made.close()


def test_virtual_time_is_never_ahead_of_the_clock_and_makes_up_for_no_loss(wall: Wall) -> None:
    pace = Pace(wall.clock, wall.sleep)
    pace.begin(7)
    pace.hold(7 + S)
    assert (wall.now_ns, pace.behind_ns) == (BEGIN_NS + S, 0)
    wall.now_ns += SLACK_NS
    pace.hold(7 + S)
    assert pace.behind_ns == 0, "a small delay is made up for"
    wall.now_ns += 3 * S
    pace.hold(7 + S)
    assert pace.behind_ns == 3 * S + SLACK_NS and wall.slept == 1
    pace.hold(7 + 2 * S)
    assert wall.now_ns == BEGIN_NS + 5 * S + SLACK_NS, "one second took one second"


def command(action: OperatorAction, stamp_ns: int) -> bytes:
    return encode(OperatorCommand(9, HASH, stamp_ns, action))


@pytest.mark.parametrize(
    ("stamp_ns", "virtual_ns"),
    [(BEGIN_NS + 3 * S, 3 * S), (BEGIN_NS + 5 * S, 4 * S), (BEGIN_NS - 60 * S, 0)],
)
def test_a_command_is_judged_by_its_age_on_the_clock_of_the_run(stamp_ns: int, virtual_ns: int) -> None:
    translated = in_virtual_time(command(OperatorAction.ARM, stamp_ns), BEGIN_NS, 4 * S)
    assert translated == command(OperatorAction.ARM, virtual_ns)


def test_heartbeats_stay_outside_and_what_is_no_command_is_left_to_the_gate() -> None:
    for beat in (OperatorAction.WATCH, OperatorAction.WATCH_END):
        assert in_virtual_time(command(beat, BEGIN_NS), BEGIN_NS, S) is None
    report = encode(VEHICLE)
    for other in (b"noise", report):
        assert in_virtual_time(other, BEGIN_NS, S) == other


def test_the_page_gets_all_stamps_on_its_own_clock_and_never_stays_never() -> None:
    before = replace(VEHICLE, position_ns=0)
    after = decode(in_real_time(encode(before), BEGIN_NS))
    assert isinstance(after, VehicleReport)
    moved = ("stamp_ns", "heading_ns", "motion_ns")
    assert after == replace(before, **{name: getattr(before, name) + BEGIN_NS for name in moved})


def job(directory: Path, companion: Companion | None, limit_s: float = 4.0) -> Summary:
    screen = Screen(file=io.StringIO())
    return run_lockstep("palms_471", 5, "nominal", directory, limit_s, screen, companion=companion)


def digest(directory: Path) -> dict[str, str]:
    return {p.name: hashlib.sha256(p.read_bytes()).hexdigest() for p in sorted(directory.iterdir())}


class Watched(Paced):
    """A paced run with a computer that stands still, and somebody at the page."""

    def __init__(self, wall: Wall, link: PageLink, visit: Callable[[int], None]) -> None:
        super().__init__(Pace(wall.clock, wall.sleep), link)
        self.visit = visit
        self.modes: list[tuple[int, int, int]] = []

    def go_along(self, system: Lockstep) -> None:
        self.visit(system.now_ns - START_NS)
        super().go_along(system)

    def on_outputs(self, outputs: Outputs, now_ns: int) -> None:
        super().on_outputs(outputs, now_ns)
        if outputs.report is not None:
            report = decode(outputs.report)
            assert isinstance(report, StateReport)
            if not self.modes or self.modes[-1][1] != report.mode:
                self.modes.append((now_ns - START_NS, report.mode, report.reason & 0xFF))


@pytest.mark.long
def test_a_paced_run_leaves_the_bytes_of_lockstep_however_often_the_computer_stands_still(
    tmp_path: Path, wall: Wall, link: PageLink, hears: socket.socket
) -> None:
    state, asked = CraneState(PROFILE, None, HASH), socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    asked.connect(("127.0.0.1", link.scene_port))
    asked.setblocking(False)
    asked.send(encode_request(()))
    heard = []

    def visit(at_ns: int) -> None:
        if at_ns % 100_000_000 == 0:
            wall.now_ns += 70_000_000
            asked.send(encode_request(()))
        try:
            while True:
                heard.append(state.on_report(hears.recv(2048), wall.now_ns))
        except BlockingIOError:
            pass

    paced = job(tmp_path / "paced", Watched(wall, link, visit))
    alone = job(tmp_path / "alone", None)
    assert digest(tmp_path / "paced") == digest(tmp_path / "alone")
    assert (paced.ticks, paced.stops) == (alone.ticks, 0)
    assert wall.slept > 1000 and wall.now_ns - BEGIN_NS > 6 * S
    assert len(heard) > 150 and all(heard) and state.alive(wall.now_ns)
    assert state.report is not None and wall.now_ns - S < state.report.stamp_ns <= wall.now_ns
    with asked:
        assert len(decode_logs(asked.recv(65536))) == 1


@pytest.mark.long
def test_stop_and_arm_of_the_page_reach_the_controller(tmp_path: Path, wall: Wall, link: PageLink) -> None:
    page = Console(PROFILE, HASH, operator=tmp_path / "operator", clock=wall.clock)

    def visit(at_ns: int) -> None:
        if at_ns == 3 * S:
            wall.now_ns += 2 * S  # the computer stands still, and meanwhile the button is pressed
            page.command(OperatorAction.STOP)
        elif at_ns == 3 * S + S // 2:
            page.command(OperatorAction.ARM)

    run = Watched(wall, link, visit)
    summary = job(tmp_path / "run", run)
    (stopped_ns, _, reason), (armed_ns, mode, _) = next(
        (a, b) for a, b in zip(run.modes, run.modes[1:], strict=False) if a[1] == Mode.STOP
    )
    assert 0 <= stopped_ns - 3 * S <= S // 10 and reason == Reason.OPERATOR_STOP
    assert mode in (Mode.ARMED, Mode.ACTIVE) and armed_ns < 3 * S + 6 * S // 10, "before the emulated operator"
    assert summary.stops == 1
