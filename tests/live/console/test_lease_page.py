"""Control in a browser: taken, taken over on purpose, kept from page to page, lost with the page; and signing in."""

from __future__ import annotations

import os
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from can_dbc.messages.crane import WATCH_ACTIONS, OperatorAction
from can_dbc.messages.datagrams import decode, encode
from console.accounts import Accounts, Role, account_line
from console.console import Console
from console.server import create_app
from machine.loading.profile_file import load_profile, profile_hash
from machine.status.modes import Mode
from tests.console.state_reports import at
from tests.live.console.browser import MISSING, Browser, installed
from tests.live.console.control import take_control
from tests.live.console.entries import entered
from tests.live.console.served_page import served
from tests.operator_end import OperatorEnd, udp_end

pytestmark = pytest.mark.skipif(installed() is None, reason=MISSING)
PROFILE = load_profile("aoro_fc8")
HASH = profile_hash(PROFILE)
PASSWORD = "hemlock and spruce"
Q = (0.4, 0.9, -1.6, 0.5, 0.0)


@dataclass
class Stage:
    """A served console, a controller that is always in STANDBY, and the presses that reach it."""

    folder: Path
    accounts: Accounts | None = None
    url: str = ""
    pressed: list[OperatorAction] = field(default_factory=list)
    over: bool = False

    def begin(self) -> None:
        self._open = ExitStack()
        self._operator = self._open.enter_context(OperatorEnd(self.folder / "operator"))
        self._operator.settimeout(0.05)
        reports = udp_end()
        self._to = reports.getsockname()
        self.console = Console(PROFILE, HASH, self.folder / "operator", reports=reports, accounts=self.accounts)
        self.url = self._open.enter_context(served(create_app(self.console)))
        self._thread = threading.Thread(target=self._work)
        self._thread.start()

    def end(self) -> None:
        self.over = True
        self._thread.join()
        self._open.close()

    def _work(self) -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
            while not self.over:
                out.sendto(
                    encode(at(Q, time.monotonic_ns(), Mode.STANDBY, profile_hash=HASH)),
                    self._to,
                )
                try:
                    command = decode(self._operator.recv(200))
                except TimeoutError:
                    continue
                if command.action not in WATCH_ACTIONS:
                    self.pressed.append(command.action)


@pytest.fixture
def stage(tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[Stage]:
    made = Stage(tmp_path, getattr(request, "param", None))
    made.begin()
    yield made
    made.end()


@pytest.fixture
def browsers(stage: Stage, tmp_path: Path) -> Iterator[list[Browser]]:
    """Two browsers at the machine's page."""
    made = []
    for name in ("a", "b"):
        made.append(Browser(tmp_path / name, (1280, 800)))
        made[-1].open(stage.url)
        made[-1].until("document.body.dataset.control === 'nobody'")
    yield made
    for each in made:
        each.close()


def words(browser: Browser) -> str:
    return str(browser.value("document.querySelector('.lease-words')?.textContent ?? ''"))


def test_control_is_taken_taken_over_and_lost(stage: Stage, browsers: list[Browser]) -> None:
    first, second = browsers
    assert first.value("document.body.dataset.control") == "nobody" and first.value(
        "document.getElementById('arm').disabled"
    )
    take_control(first)
    first.until("!document.getElementById('arm').disabled")
    second.until("document.body.dataset.control === 'other'")
    assert "(page 1)" in words(second) and second.value("document.getElementById('arm').disabled")

    second.click("lease-button")
    second.wait(lambda: "Take control over?" in second.text("take-over"), "a question first")
    second.click("stop")
    second.wait(lambda: stage.pressed == [OperatorAction.STOP], "STOP works while it asks, and without control")
    second.click("take-over-yes")
    second.until("document.body.dataset.control === 'mine'")
    first.wait(lambda: "(page 2) has taken control over" in first.text("alarm"), "the first page is told")
    first.until("document.getElementById('arm').disabled")
    first.keys("Escape")
    first.wait(lambda: stage.pressed == [OperatorAction.STOP] * 2, "STOP by key, without control")

    second.click("plan-link")
    second.until("document.body?.dataset.ready === 'yes'")
    second.until("document.body.dataset.control === 'mine'")
    second._process.kill()
    second._process.wait(10)
    first.until("document.body.dataset.control === 'nobody'")


def accounts() -> Accounts:
    name, role, known = account_line("anna", Role.OPERATOR, PASSWORD).split()
    return Accounts({name: (Role[role.upper()], known)})


@pytest.mark.parametrize("stage", [accounts()], indirect=True)
def test_a_person_signs_in_and_out_and_stop_works_before(stage: Stage, tmp_path: Path) -> None:
    with Browser(tmp_path, (390, 844)) as browser:
        browser.open(stage.url)
        browser.until("document.body?.className === 'sign-in' && Boolean(document.getElementById('enter'))")
        pictures = os.environ.get("TIMBERHAND_PICTURES")
        if pictures:
            browser.picture(Path(pictures, "sign-in-390x844.png"))
        browser.until("document.activeElement.id === 'name'")
        browser._ask("Input.insertText", text="anna")
        browser.keys("Escape")
        browser.wait(lambda: stage.pressed == [OperatorAction.STOP], "STOP before signing in")
        browser.value("document.getElementById('password').focus()")
        browser._ask("Input.insertText", text="wrong wrong")
        browser.click("enter")
        browser.wait(lambda: "Name or password is wrong" in browser.text("note"), "a wrong password")
        browser._ask("Input.insertText", text=PASSWORD)
        browser.click("enter")
        browser.until("document.body?.dataset.control === 'nobody'")
        take_control(browser)
        assert "anna" in browser.text("lease")
        assert browser.value("document.documentElement.scrollWidth <= innerWidth")
        browser.click("sign-out")
        browser.until("document.body?.className === 'sign-in'")


def test_who_opens_the_bare_address_looks_and_stops_and_enters_by_the_token(stage: Stage, tmp_path: Path) -> None:
    with Browser(tmp_path, (1280, 800)) as browser:
        browser.open(stage.url, enters=False)
        browser.until(
            "document.getElementById('sign-in')?.checkVisibility() && !document.getElementById('stop').disabled"
        )
        for button in ("arm", "reset", "disarm"):
            browser.until(f"document.getElementById('{button}').disabled")
        assert not browser.value("document.getElementById('lease-button').checkVisibility()")
        browser.click("stop")
        browser.wait(lambda: stage.pressed == [OperatorAction.STOP], "STOP of who only looks")
        browser.click("sign-in")
        browser.until("document.activeElement?.id === 'token'")
        browser.keys("Escape")
        browser.wait(lambda: stage.pressed == [OperatorAction.STOP] * 2, "STOP before signing in")
        browser.keys("wrong token")
        browser.click("enter-token")
        browser.until("document.getElementById('token-note').textContent !== ''")
        browser.keys(entered(stage.url))
        browser.click("enter-token")
        browser.until("document.body?.dataset.control === 'nobody'")
        take_control(browser)
        browser.click("reset")
        browser.wait(lambda: stage.pressed[2:] == [OperatorAction.RESET], "a command of who has entered")


def test_a_page_whose_session_has_ended_says_how_to_get_another(stage: Stage, tmp_path: Path) -> None:
    with Browser(tmp_path, (1280, 800)) as browser:
        browser.open(stage.url)
        browser.until("document.body?.dataset.control === 'nobody'")
        assert not browser.value("document.getElementById('sign-in').checkVisibility()")
        (session,) = stage.console.access._sessions
        stage.console.access.sign_out(session)
        browser.until("document.getElementById('sign-in').checkVisibility()")
        browser.shows("lease", "Looking only")


@pytest.mark.parametrize("size", [(1280, 800), (800, 1280), (390, 844)])
def test_the_header_has_room_for_control_and_stop(stage: Stage, tmp_path: Path, size: tuple[int, int]) -> None:
    with Browser(tmp_path, size) as browser:
        for path in ("", "plan"):
            browser.open(stage.url + path)
            browser.until("document.body?.dataset.control === 'nobody' || document.body?.dataset.control === 'mine'")
            if not path:
                take_control(browser)
            browser.until("document.body?.dataset.control === 'mine'")
            assert browser.value("document.documentElement.scrollWidth <= innerWidth")
            assert browser.value(
                "(b => b.width > 150 && b.height > 55 && b.top >= 0 && b.bottom <= innerHeight"
                " && b.right <= innerWidth)(document.getElementById('stop').getBoundingClientRect())"
            )
            if pictures := os.environ.get("TIMBERHAND_PICTURES"):
                browser.picture(Path(pictures, f"control-{path or 'machine'}-{size[0]}x{size[1]}.png"))
