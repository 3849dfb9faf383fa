"""A person at the page of a machine: plans, uploads and drives a mission, breaks it, stops it, and finds out why.

Everything is real but the machine, which is the plant on the wire: controller, guard, planner, recorder and console as
processes in real time, and Chromium with a mouse.  A host without time to spare stops the machine, rightly; the person
then arms it again.  What is asserted is what is shown and what is in the bunk, never a duration.
"""

from __future__ import annotations

import json
import socket
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from autonomy.missions.mission_file import save_mission
from autonomy.missions.model import ForwardingMission, KnownLog
from tests.autonomy.mission_texts import at
from tests.live.console.browser import MISSING, Browser, installed
from tests.live.console.control import take_control
from tests.live.console.plan_drawing import draw
from tests.live.console.started import SIZE, TUTORIAL, Started, keep, opened, pictured

pytestmark = [
    pytest.mark.timeout(1200),
    pytest.mark.skipif(installed() is None, reason=MISSING),
]
PICTURE = Path(__file__).parents[3] / "docs" / "how-to" / "mission-page.png"
RUN = "run"
ROUTE = ((-6.0, 0.0), (6.0, 0.0))
LOGS = ((0.0, 3.5), (3.0, 3.5))
DRIVEN_S = 800.0
"""So long a busy computer may take for two logs."""
DRAW_MS = 1500
"""WebGL in software would keep the page from its heartbeats, without which the machine stops."""
FAULT = "The planner freezes for 1 s"
OUTCOMES = "reaction after|stood already|did not stop"
TRIES = 5
"""A busy host may stop the machine for a reason of its own just before the person does."""


@pytest.fixture
def folder(tmp_path: Path) -> Iterator[Path]:
    made = tmp_path / "forest"
    made.mkdir()
    logs = tuple(KnownLog(at(*place), bearing_deg=80.0, length_m=2.0, diameter_m=0.25) for place in LOGS)
    save_mission(made / "forest.geojson", ForwardingMission("forest", tuple(at(*p) for p in ROUTE), logs=logs))
    yield made


@pytest.fixture
def person(tmp_path: Path) -> Iterator[Browser]:
    with Browser(tmp_path, SIZE, solid=pictured()) as browser:
        if pictured():
            browser.draw_every(DRAW_MS)
        yield browser


def arm(browser: Browser) -> None:
    """Press ARM and say that nobody is there."""
    browser.click("arm")
    browser.until("document.getElementById('confirm').open")
    browser.click("confirm-yes")


def press_reset(run: Path) -> None:
    """Walk to the machine and press the reset button of its safety module: the guard asks a person for no less."""
    port = json.loads((run / "live.json").read_text())["ports"]["sim"]
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as plant:
        plant.sendto(b'{"op": "reset"}', ("127.0.0.1", port))


def go_on_until(live: Started, browser: Browser, so: Callable[[], bool], what: str) -> None:
    """Wait for something, and arm again whenever the machine has stopped on the way."""
    limit, pressed = time.monotonic() + DRIVEN_S, 0.0
    while not so():
        assert time.monotonic() < limit and live.process.poll() is None, (what, live.said.read_text()[-3000:])
        mode = browser.value("document.body.dataset.mode")
        if mode in ("STOP", "FAULT", "STANDBY") and time.monotonic() - pressed > 2.0:
            pressed = time.monotonic()
            if "[GUARD_NOT_READY]" in browser.text("refusal"):
                press_reset(live.said.parent / RUN)
            if mode == "FAULT":
                browser.click("reset")
            else:
                arm(browser)
        time.sleep(0.1)


def plan(browser: Browser) -> None:
    """Draw what is known of the forest."""
    browser.until("document.body?.dataset.ready === 'yes'")
    draw(browser, "waypoint", *ROUTE)
    draw(browser, "fence", (-22, -14), (22, -14), (22, 14), (-22, 14), last=2)
    draw(browser, "log", *LOGS)
    browser.shows("check-state", "can be driven")


def test_a_mission_is_planned_driven_broken_stopped_and_replayed(folder: Path, person: Browser) -> None:
    run = folder / RUN
    arguments = ("tests.live.console.awaited_mission", "forest.geojson", "--out", RUN)
    with Started(folder, *arguments, option="--console-port") as live:
        opened(live, person)
        person.shows("mode", "STANDBY")
        person.shows("mission-words", "The machine waits for a mission.")
        person.click("plan-link")
        plan(person)
        upload_and_start(person, live.url)
        go_on_until(live, person, lambda: "carries the log" in person.text("mission-words"), "a log in the grapple")
        keep(person, PICTURE)
        go_on_until(live, person, lambda: person.text("loaded") == "1", "the first log")
        breaks(live, person)
        stops(live, person)
        go_on_until(live, person, lambda: live.process.poll() is not None, "the end of the run")
        person.shows("alarm", f"timberhand console --replay {RUN}")
    assert live.process.returncode == 0, live.said.read_text()
    told = json.loads((run / "summary.json").read_text())
    assert (told["finished"], told["loaded"], told["in_bunk"]) == (True, 2, 2)
    ordered = [json.loads(line) for line in (run / "audit.jsonl").read_text().splitlines()]
    done = {entry["what"].split("/api/")[1] for entry in ordered if entry["result"] in (200, 204)}
    assert done >= {"plan/upload/mission.geojson", "operator/stop", "operator/arm", "mission/auto", "lease/take"}
    replays(folder, person)


def upload_and_start(browser: Browser, url: str) -> None:
    """Take control, hand the mission over, arm on the machine's page, and start."""
    take_control(browser)
    browser.until("!document.getElementById('upload').disabled")
    browser.click("upload")
    browser.shows("run-note", "The planner has the mission")
    browser.open(url)
    browser.until("document.body.dataset.control === 'mine'")  # the next page of a tab keeps its control
    arm(browser)
    browser.shows("mode", "ARMED")
    browser.until("!document.getElementById('auto').disabled")
    browser.click("auto")


def breaks(live: Started, browser: Browser) -> None:
    """Freeze the planner, and read on the card what the machine did about it."""
    browser.click("tab-faults")
    for _ in range(TRIES):
        works(live, browser)
        browser.click_on(".fault-buttons button:not(:disabled)", FAULT)
        browser.until(f"document.querySelector('.fault-card').innerText.match(/{OUTCOMES}/)")
        card = browser.value("document.querySelector('.fault-card').innerText")
        if "STOP: LEASE_LOST" in card:
            break
    assert card.startswith(FAULT)
    after, *ways = browser.value("[...document.querySelectorAll('.fault-card dd')].map(e => e.textContent)")
    assert after.endswith(" ms") and all(way.endswith(" mm") for way in ways), (after, ways)
    browser.shows("reason", "[LEASE_LOST]")
    browser.value("document.querySelector('.fault-card').scrollIntoView()")
    keep(browser, TUTORIAL / "broken.png")


def stops(live: Started, browser: Browser) -> None:
    """Press STOP while it works."""
    for _ in range(TRIES):
        works(live, browser)
        browser.click("stop")
        browser.shows("mode", "STOPPED")
        if "[OPERATOR_STOP]" in browser.text("reason"):
            return
    raise AssertionError(f"STOP never came first: {browser.text('reason')}")


def works(live: Started, browser: Browser) -> None:
    """Wait until it moves."""
    go_on_until(live, browser, lambda: browser.value("document.body.dataset.mode") == "ACTIVE", "it works")


def replays(folder: Path, browser: Browser) -> None:
    """Open the recording at the ten seconds before STOP was pressed, and see it stop once more."""
    with Started(folder, "timberhand", "console", "--replay", RUN) as again:
        opened(again, browser)
        browser.until("document.body?.dataset.recording === 'yes'")
        browser.click("tab-timeline")
        browser.shows("panel-timeline", "OPERATOR_STOP")
        stop_s = browser.value(
            "fetch('api/timeline').then(a => a.json()).then(all => all.find(e => e.title === 'OPERATOR_STOP').at_s)"
        )
        begin_s = browser.value("fetch('api/machine').then(a => a.json()).then(m => m.recording.begin_s)")
        browser.click_on("#panel-timeline .of-stop:has(b) button[aria-label*=OPERATOR_STOP]", "Show 10 s before")
        shown_s = float(browser.wait(lambda: browser.text("replay"), "the replay") and clock(browser))
        assert -10.5 < shown_s + begin_s - stop_s < -5.0, "it plays from ten seconds before"
        browser.until("document.body.dataset.mode === 'ACTIVE'")
        browser.shows("reason", "[OPERATOR_STOP]")
        assert clock(browser) + begin_s - stop_s < 3.0


def clock(browser: Browser) -> float:
    """The time of the replay since the begin of the recording [s]."""
    return float(browser.value("document.querySelector('#replay .clock').value").split()[0])
