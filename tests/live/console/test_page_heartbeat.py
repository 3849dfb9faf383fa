"""The page in a browser: its heartbeats reach the operator's socket; closing it ends the watch, killing it does not."""

from __future__ import annotations

import itertools
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from urllib.parse import urlsplit

import pytest

from can_dbc.messages.crane import WATCH_PERIOD_NS, OperatorAction, OperatorCommand
from can_dbc.messages.datagrams import decode
from console.console import Console
from console.server import create_app
from machine.loading.profile_file import load_profile, profile_hash
from tests.live.console.browser import MISSING, Browser, installed
from tests.live.console.served_page import served
from tests.operator_end import OperatorEnd

pytestmark = pytest.mark.skipif(installed() is None, reason=MISSING)


@dataclass
class Stage:
    """A console in a thread, and what reaches the operator's socket."""

    operator: socket.socket
    port: int = 0
    commands: list[OperatorCommand] = field(default_factory=list)
    over: bool = False

    def begin(self) -> None:
        profile = load_profile("palms_471")
        console = Console(profile, profile_hash(profile), Path(self.operator.getsockname()))
        self._serving = ExitStack()
        self.port = urlsplit(self._serving.enter_context(served(create_app(console)))).port or 0
        self._thread = threading.Thread(target=self._hear)
        self._thread.start()

    def end(self) -> None:
        self.over = True
        self._thread.join()
        self._serving.close()

    def count(self, action: OperatorAction) -> int:
        return sum(command.action is action for command in self.commands)

    def _hear(self) -> None:
        while not self.over:
            try:
                command = decode(self.operator.recv(100))
            except TimeoutError:
                continue
            assert isinstance(command, OperatorCommand)
            self.commands.append(command)


@pytest.fixture
def stage(tmp_path: Path) -> Iterator[Stage]:
    with OperatorEnd(tmp_path / "operator") as operator:
        operator.settimeout(0.1)
        made = Stage(operator)
        made.begin()
        yield made
        made.end()


@pytest.fixture
def browser(stage: Stage, tmp_path: Path) -> Iterator[Browser]:
    with Browser(tmp_path) as made:
        made.open(f"http://127.0.0.1:{stage.port}/")
        made.wait(lambda: stage.count(OperatorAction.WATCH) >= 10, "heartbeats")
        yield made


def test_an_open_page_watches_about_five_times_a_second(stage: Stage, browser: Browser) -> None:
    stamps = [command.stamp_ns for command in stage.commands if command.action is OperatorAction.WATCH]
    gaps = sorted(b - a for a, b in itertools.pairwise(stamps))
    assert 0.7 * WATCH_PERIOD_NS < gaps[len(gaps) // 2] < 2.5 * WATCH_PERIOD_NS  # the median, on a busy computer too


def test_closing_the_page_ends_the_watch(stage: Stage, browser: Browser) -> None:
    browser._ask("Page.navigate", url="about:blank")
    browser.wait(lambda: stage.count(OperatorAction.WATCH_END) == 1, "the end of the watch")
    time.sleep(0.5)
    assert stage.commands[-1].action is OperatorAction.WATCH_END


def test_a_killed_browser_ends_no_watch(stage: Stage, browser: Browser) -> None:
    browser._process.kill()
    browser._process.wait(10)
    time.sleep(1.0)
    beats = stage.count(OperatorAction.WATCH)
    time.sleep(0.5)
    assert stage.count(OperatorAction.WATCH) == beats and stage.count(OperatorAction.WATCH_END) == 0
