"""Live tests: what a test starts ends with it, and a failure beside a stall of the host is inconclusive.

A witness on every processor tells when it stood still (`experiments.common.stall_witness`).  A test that fails while
the host stood still for longer than the test bears (10 ms, or its mark ``bears``) has found nothing; it is reported as
inconclusive, with the stall.  Any other failure is a failure.  A test in simulated time bears any standstill:
nothing in it depends on the host's clock.
"""

from __future__ import annotations

import contextlib
import os
import signal
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from experiments.common.stall_witness import Witness

TAG = "TIMBERHAND_TEST_RUN"
"""In the environment of everything that this run starts."""
IN_THE_LAB = "TIMBERHAND_LAB" in os.environ
BEARS_MS = 10.0
"""The shortest time-out of an input, less the age of its newest frame: an encoder may be silent for 15 ms, and sends
every 5 ms."""
PATIENCE_S = 5.0
"""For processes that are ending."""
SHARED_MEMORY = Path("/dev/shm")
_FAILED = pytest.StashKey[bool]()
_BEGIN = pytest.StashKey[int]()


class LiveRun:
    """The plugin of one run of live tests."""

    def __init__(self) -> None:
        os.environ.pop(TAG, None)  # the witnesses are no part of the run that they watch
        self.witnesses = [Witness(cpu, priority=98) for cpu in sorted(os.sched_getaffinity(0))]
        os.environ[TAG] = str(os.getpid())
        self._files = files()
        self.left: list[str] = []
        self.inconclusive: list[str] = []

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_makereport(self, item: pytest.Item, call: pytest.CallInfo[Any]) -> Iterator[None]:
        report = yield
        if call.when == "setup":
            item.stash[_BEGIN] = round(call.start * 1e9)
        if report.failed:
            item.stash[_FAILED] = True
            mark = item.get_closest_marker("bears")
            bears_ms = mark.args[0] if mark else BEARS_MS
            # call.start is of the wall clock
            now_ns, wall_ns = time.monotonic_ns(), time.time_ns()
            begin_ns = now_ns - (wall_ns - item.stash.get(_BEGIN, wall_ns))
            stall_ms = max(
                (
                    stall.stall_ns / 1e6
                    for witness in self.witnesses
                    for stall in witness.stalls()
                    if stall.end_ns > begin_ns and stall.end_ns - stall.stall_ns < now_ns
                ),
                default=0.0,
            )
            if stall_ms > bears_ms:
                words = f"inconclusive: the host stood still for {stall_ms:.0f} ms, and the test bears {bears_ms:g} ms"
                self.inconclusive.append(f"{item.nodeid}: {words}\n{report.longreprtext}")
                report.outcome = "skipped"
                report.longrepr = (str(item.path), 0, words)
        return report

    @pytest.hookimpl(trylast=True)
    def pytest_sessionfinish(self, session: pytest.Session) -> None:
        for witness in self.witnesses:
            witness.end()
        left = remaining(set(), PATIENCE_S)
        self.left += [f"process {pid}: {command}" for pid, command in left.items()]
        kill(left)
        self.left += [f"file: {name}" for name in sorted(files() - self._files)]
        if self.left and session.exitstatus == pytest.ExitCode.OK:
            session.exitstatus = pytest.ExitCode.TESTS_FAILED

    def pytest_terminal_summary(self, terminalreporter: Any) -> None:
        for words in self.inconclusive:
            terminalreporter.section("inconclusive")
            terminalreporter.write_line(words)
        for words in self.left:
            terminalreporter.write_line(f"left by this run: {words}", red=True)


def files() -> set[str]:
    """This project's files in shared memory, where its folders stay, and its temporary files and folders."""
    memory = (path for top in SHARED_MEMORY.glob("timberhand-*") for path in (top, *top.glob("*")))
    temporary = Path(tempfile.gettempdir()).glob("timberhand-*")
    return {str(path) for path in memory if not path.is_dir()} | set(map(str, temporary))


def running() -> dict[int, str]:
    """Every process of this run but this one, and the trackers of its shared memory, which end with it: its number and
    its command.
    """
    tag = f"{TAG}={os.environ.get(TAG)}".encode()
    found: dict[int, str] = {}
    for folder in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            if tag in (folder / "environ").read_bytes().split(b"\0") and int(folder.name) != os.getpid():
                command = (folder / "cmdline").read_bytes().replace(b"\0", b" ").decode()[:200]
                if not (
                    "resource_tracker import main" in command and next(parents(int(folder.name)), 0) == os.getpid()
                ):
                    found[int(folder.name)] = command
    return found


def parents(pid: int) -> Iterator[int]:
    """The parent of a process, its parent, and so on."""
    with contextlib.suppress(OSError):
        while pid > 1:
            pid = int(Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[1])
            yield pid


def remaining(before: set[int], patience_s: float) -> dict[int, str]:
    """Processes of this run that are neither among ``before`` nor below one of them, after a while for their ends."""
    limit_s = time.monotonic() + patience_s
    while True:
        left = {p: words for p, words in running().items() if p not in before and before.isdisjoint(parents(p))}
        if not left or time.monotonic() > limit_s:
            return left
        time.sleep(0.05)


def kill(processes: dict[int, str]) -> None:
    for pid in processes:
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)


def pytest_configure(config: pytest.Config) -> None:
    if not IN_THE_LAB and not config.option.collectonly:
        config.pluginmanager.register(LiveRun())


@pytest.fixture(autouse=True)
def confined(request: pytest.FixtureRequest) -> Iterator[None]:
    """Instead of the confinement of other tests: whatever this test starts has ended when it has."""
    if IN_THE_LAB:
        yield
        return
    before = set(running())
    yield
    left = remaining(before, PATIENCE_S)
    kill(left)
    if left and not request.node.stash.get(_FAILED, False):
        pytest.fail(f"left running: {left}")
