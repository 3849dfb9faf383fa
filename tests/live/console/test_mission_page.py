"""The page in a browser: mission and map show the report, and a click sends its command."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from math import nan
from pathlib import Path
from urllib.parse import urlsplit

import msgspec
import pytest

from can_dbc.messages.datagrams import encode
from can_dbc.messages.mission import MissionAction, MissionReport, decode_mission_command, encode_mission
from console.console import Console
from console.server import create_app
from machine.loading.profile_file import load_profile, profile_hash
from tests.can_dbc.example_mission_report import MISSION_REPORT
from tests.console.state_reports import at
from tests.console.vehicle_reports import VEHICLE
from tests.live.console.browser import MISSING, Browser, installed
from tests.live.console.control import take_control
from tests.live.console.served_page import fed, served
from tests.operator_end import udp_end

pytestmark = pytest.mark.skipif(installed() is None, reason=MISSING)
INK = """(name => {
  const canvas = document.getElementById('map'), g = canvas.getContext('2d');
  const probe = document.createElement('canvas').getContext('2d');
  probe.fillStyle = getComputedStyle(document.documentElement).getPropertyValue('--' + name);
  probe.fillRect(0, 0, 1, 1);
  const [r, k, b] = probe.getImageData(0, 0, 1, 1).data, all = g.getImageData(0, 0, canvas.width, canvas.height).data;
  let n = 0;
  for (let i = 0; i < all.length; i += 4) n += all[i] === r && all[i + 1] === k && all[i + 2] === b && all[i + 3] > 250;
  return n;
})"""
"""How many pixels of the map have a colour of the style sheet."""


@dataclass
class Stage:
    """A console in a thread, fed by us in place of controller and planner, and the orders that it sends."""

    profile: str
    orders: socket.socket
    port: int = 0
    mission: MissionReport | None = MISSION_REPORT
    speaks: bool = True

    def begin(self) -> None:
        profile = load_profile(self.profile)
        self.hash = profile_hash(profile)
        reports = udp_end()
        console = Console(profile, self.hash, ("127.0.0.1", 9), reports=reports, planner=self.orders.getsockname())
        self._serving = ExitStack()
        self.port = urlsplit(self._serving.enter_context(served(create_app(console)))).port or 0
        self._serving.enter_context(fed(reports.getsockname(), 0.1, self._told))

    def end(self) -> None:
        self._serving.close()

    def ordered(self) -> MissionAction:
        return decode_mission_command(self.orders.recv(100)).action

    def _told(self, now_ns: int) -> Iterator[bytes]:
        q = (0.4, 0.9, -1.6, 0.5, 0.0)
        yield encode(at(q, now_ns, profile_hash=self.hash, opening_pct=nan, clamp_bar=nan, load_kg=nan))
        yield encode(VEHICLE)
        if self.mission is not None and self.speaks:
            yield encode_mission(self.mission, 1, self.hash, now_ns)


@pytest.fixture
def stage(request) -> Iterator[Stage]:
    orders = udp_end(10)
    profile, told = getattr(request, "param", ("aoro_fc8", MISSION_REPORT))
    made = Stage(profile, orders, mission=told)
    made.begin()
    yield made
    made.end()
    orders.close()


@pytest.fixture
def browser(stage: Stage, tmp_path: Path) -> Iterator[Browser]:
    with Browser(tmp_path) as made:
        made.open(f"http://127.0.0.1:{stage.port}/")
        yield made


def test_mission_and_vehicle_are_shown_as_text(stage: Stage, browser: Browser) -> None:
    browser.shows("mission-words", "The machine drives up to the log.")
    told = {
        "mission-age": "Test field",
        "on-board": "3 · 0.29 m³",
        "loaded": "4",
        "target": "log 7",
        "unloaded": "1",
        "missed-grasps": "2",
        "known": "1",
        "driven": "42 m",
        "given-up": "Log 9 given up: log 9 was missed 3 times.",
    }
    for element, words in told.items():
        assert browser.text(element) == words, element
    browser.shows("speed", "2.3 km/h")
    assert browser.text("heading") == "90°" and browser.text("bend") == "11.5° left"
    assert browser.text("roll") == "1.1° right" and browser.text("pitch") == "1.7° down"
    assert browser.text("fix") == "RTK fixed, ±1 cm" and browser.text("arm-3") == "32 cm"


def test_the_map_shows_route_log_target_and_machine(stage: Stage, browser: Browser) -> None:
    browser.shows("mission-words", "drives up")
    for name in ("route", "log", "target", "good"):
        browser.wait(lambda name=name: browser.value(f"{INK}('{name}')") > 15, name)
    stage.mission = msgspec.structs.replace(MISSION_REPORT, targets=(), logs=(), landings=())
    browser.until(f"{INK}('target') === 0 && {INK}('log') === 0 && {INK}('route') > 15")


@pytest.mark.parametrize(
    ("button", "before", "order"),
    [
        ("pause", {}, MissionAction.PAUSE),
        ("auto", {"auto": False}, MissionAction.AUTO),
        ("single", {}, MissionAction.SINGLE_STEP),
        ("single", {"single_step": True}, MissionAction.RUN_THROUGH),
        ("next-step", {"single_step": True, "waits_for": "a log is near"}, MissionAction.NEXT_STEP),
    ],
)
def test_a_click_sends_the_command(
    stage: Stage, browser: Browser, button: str, before: dict, order: MissionAction
) -> None:
    stage.mission = msgspec.structs.replace(MISSION_REPORT, state="SEARCH", words="is another", **before)
    browser.shows("mission-words", "is another")
    if button != "pause":  # which only stops
        take_control(browser)
    browser.until(f"!document.getElementById('{button}').disabled")
    browser.click(button)
    assert stage.ordered() is order


def test_an_abort_must_be_confirmed(stage: Stage, browser: Browser) -> None:
    browser.until("document.getElementById('abort').checkVisibility()")
    assert browser.value("document.getElementById('abort').disabled"), "nobody has control yet"
    take_control(browser)
    browser.until("!document.getElementById('abort').disabled")
    browser.click("abort")
    browser.shows("end", "Abort the mission?")
    browser.click("end-no")
    browser.until("!document.getElementById('end').open")
    browser.click("abort")
    browser.until("document.getElementById('end').open")
    browser.click("end-yes")
    browser.click("pause")
    assert [stage.ordered(), stage.ordered()] == [MissionAction.ABORT, MissionAction.PAUSE], (
        "and the first click ordered nothing"
    )


def test_the_note_gives_the_reason_of_a_pause(stage: Stage, browser: Browser) -> None:
    for fields, words in (
        ({"auto": False, "paused": "the switch is at Idle"}, "Auto"),
        ({"paused": "the controller is silent"}, "the controller is silent"),
        ({"waits_for": "a log is near"}, "a log is near"),
        ({"refusal": "nothing waits for the next step"}, "nothing waits"),
        ({"ended": True, "failure": "aborted by the operator"}, "aborted by the operator"),
    ):
        stage.mission = msgspec.structs.replace(MISSION_REPORT, **fields)
        browser.shows("mission-note", words)
    browser.until("['auto', 'pause', 'single', 'next-step', 'abort'].every(b => document.getElementById(b).disabled)")


def test_an_outdated_mission_is_grey_and_accepts_no_commands(stage: Stage, browser: Browser) -> None:
    browser.until("document.getElementById('mission').checkVisibility()")
    browser.until("!document.getElementById('pause').disabled")
    assert not browser.value("document.getElementById('mission').classList.contains('old')")
    stage.speaks = False
    browser.until("document.getElementById('mission').classList.contains('old')")
    assert browser.text("mission-age") != MISSION_REPORT.name and browser.text("mission-note")
    assert browser.value("document.getElementById('pause').disabled")
    assert browser.value("getComputedStyle(document.getElementById('mission')).filter") == "grayscale(1)"
    assert not browser.value("document.getElementById('stop').disabled"), "STOP stays enabled"


@pytest.mark.parametrize("stage", [("palms_471", MISSION_REPORT), ("aoro_fc8", None)], indirect=True)
def test_without_a_mission_or_a_carrier_their_cards_are_hidden(stage: Stage, browser: Browser) -> None:
    browser.shows("mode", "ACTIVE")
    for element in ("mission", "vehicle", "site"):
        assert not browser.text(element) and not browser.value(
            f"document.getElementById('{element}').checkVisibility()"
        )
