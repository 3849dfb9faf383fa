"""What tests of several folders need."""

from __future__ import annotations

import gc
import multiprocessing.process  # noqa: TID251
import signal
import sys
import time
from collections.abc import Callable, Iterator
from typing import Any, NoReturn

import pytest
from hypothesis import settings

from can_dbc.timing.durations import Durations
from can_dbc.timing.page import STAGES, BusCounters, Facts, InputAge, ProcessCounters, Timing
from tests import branch_coverage

settings.register_profile("no clock", deadline=None)  # how long an example takes is the host's affair, and no failure
settings.load_profile("no clock")

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    # A shell starts so what it runs in the background, and the children of the tests would inherit it.
    signal.signal(signal.SIGINT, signal.default_int_handler)


FONT_LIST = "fc-list"
"""What matplotlib starts on a computer where it has never drawn: the one process that says nothing of the test."""
PROCESS_EVENTS = frozenset({"subprocess.Popen", "os.fork", "os.forkpty", "os.posix_spawn", "os.system"})
"""Audit events of a new process."""


class Confinement:
    """While it is on, a test that starts a process or sleeps fails: its outcome would depend on the host."""

    on = False

    @classmethod
    def audit(cls, event: str, arguments: tuple[object, ...]) -> None:
        if cls.on and event in PROCESS_EVENTS and arguments[0] != FONT_LIST:
            cls.on = False  # what pytest does about the failure is its own affair
            pytest.fail(f"{event} {arguments[:2]}: only tests in tests/live, and long ones, start processes")


sys.addaudithook(Confinement.audit)


def _no_sleep(seconds: float) -> None:
    if seconds > 0.0:
        pytest.fail(f"time.sleep({seconds}): only tests in tests/live, and long ones, wait; give the code a clock")


def _no_process(process: object) -> NoReturn:
    pytest.fail(f"{process} starts: only tests in tests/live, and long ones, start processes")


@pytest.fixture(autouse=True)
def confined(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """No process and no sleep, except in a long test."""
    if request.node.get_closest_marker("long") is not None:
        yield
        return
    monkeypatch.setattr(time, "sleep", _no_sleep)
    monkeypatch.setattr(multiprocessing.process.BaseProcess, "start", _no_process)
    Confinement.on = True
    yield
    Confinement.on = False


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        branch_coverage.OPTION, action="store_true", help="fail for an untested branch of the safety layer"
    )


def pytest_configure(config: pytest.Config) -> None:
    branch_coverage.configure(config)


@pytest.hookimpl(wrapper=True)
def pytest_collection(session: pytest.Session) -> Iterator[None]:
    """What is imported and collected stays for the whole run: the collector of garbage need not visit it again."""
    gc.disable()
    yield
    gc.freeze()
    gc.enable()


def a_timing(count: int = 100, **facts: Any) -> Timing:
    """A controller's timing page after ``count`` ticks, told just now; the i-th stage took from 10 (i + 1) us on."""
    made = {name: Durations() for name in STAGES}
    for i, found in enumerate(made.values()):
        for k in range(count):
            found.add((i + 1) * 10_000 + k)
    now_ns = time.monotonic_ns()  # noqa: TID251  what shows a page compares its time with the clock
    inputs = {f"Input{i}": InputAge(1_000_000, (10 + i) * 1_000_000, 1000) for i in range(7)}
    usual = {
        "pid": 4711,
        "started_ns": now_ns - 8000 * 10**9,
        "written_ns": now_ns,
        "period_ns": 5_000_000,
        "ticks": count,
        "missed": 0,
        "late": 0,
        "mode": "STANDBY",
        "words": "STANDBY. All is well.",
        "buses": (
            BusCounters("crane0", "ACTIVE", 12_345_678, 2_345_678, 0, 0, 2, 1),
            BusCounters("mach0", "DOWN", 5, 6, 7, 0, 0, 0),
        ),
        "process": ProcessCounters(800 * 10**9, 100, 2, 3, 4, 5, 6, 61_440),
        "inputs": inputs | {"Never": InputAge()},
        "longest_ns": tuple(made[n].longest_ns for n in STAGES),
        "total_ns": tuple(made[n].total_ns for n in STAGES),
    }
    return Timing(Facts(**(usual | facts)), made)


@pytest.fixture
def timing() -> Callable[..., Timing]:
    """`a_timing`."""
    return a_timing
