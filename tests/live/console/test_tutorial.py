"""The tutorial, done: from an empty folder a mission is planned by mouse, driven, replayed, watched live, and broken.

Everything is the real program: `timberhand console`, `timberhand mission run` with plant and controller, and Chromium.
With ``TIMBERHAND_PICTURES`` set its pictures go to docs/tutorial, which docs/tutorial.md shows.
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.live.console.browser import MISSING, Browser, installed
from tests.live.console.control import take_control
from tests.live.console.plan_drawing import draw
from tests.live.console.started import SIZE, SOLID_S, TUTORIAL, Started, keep, opened, pictured

pytestmark = pytest.mark.skipif(installed() is None, reason=MISSING)
LOADED_S = 900.0
"""So long a busy computer may take for two logs in virtual time."""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """The empty folder of the tutorial."""
    made = tmp_path / "forest"
    made.mkdir()
    return made


def plan(folder: Path, tmp_path: Path) -> None:
    with (
        Started(folder, "timberhand", "console", "--profile", "aoro_fc8") as started,
        Browser(tmp_path / "planner", SIZE) as browser,
    ):
        opened(started, browser, "plan")
        browser.until("document.body?.dataset.ready === 'yes'")
        draw(browser, "waypoint", (-8, 0), (8, 0))
        draw(browser, "fence", (-22, -14), (22, -14), (22, 14), (-22, 14), last=2)
        draw(browser, "log", (-1, 3.5), (3, 3.5))
        browser.value("document.querySelector('[data-tool=move]').click()")
        browser.value("document.getElementById('fit').click()")
        browser.shows("check-state", "can be driven")
        browser.click("save")
        browser.shows("file-note", "Saved as mission.geojson.")
        assert browser.text("command") == "timberhand mission run missions/mission.geojson"
        browser.value("document.querySelector('aside').scrollTop = 0")
        keep(browser, TUTORIAL / "plan.png")
    assert (folder / "missions" / "mission.geojson").is_file() and started.process.returncode in (0, 130)


def drive(folder: Path) -> None:
    """Drive it in virtual time; two logs end in the bunk by the plant's physics."""
    command = ["mission", "run", "missions/mission.geojson", "--lockstep", "--out", "runs/first"]
    done = subprocess.run(
        [sys.executable, "-m", "timberhand", *command],
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=LOADED_S,
        stdin=subprocess.DEVNULL,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    summary = json.loads((folder / "runs" / "first" / "summary.json").read_text())
    assert (summary["loaded"], summary["in_bunk"], summary["finished"]) == (2, 2, True)


def replay(folder: Path, tmp_path: Path) -> None:
    with (
        Started(folder, "timberhand", "console", "--replay", "runs/first") as started,
        Browser(tmp_path / "replayer", SIZE, solid=pictured()) as browser,
    ):
        opened(started, browser)
        browser.until("document.body?.dataset.recording === 'yes'")
        browser.click("tab-timeline")
        browser.wait(
            lambda: "Loaded" in browser.text("panel-timeline") or "ACTIVE" in browser.text("panel-timeline"),
            "the modes in the timeline",
        )
        browser.value(
            "(bar => { bar.value = bar.max * 0.75; bar.dispatchEvent(new Event('change')); })"
            "(document.querySelector('.scrub'))"
        )
        browser.until("document.body.dataset.mode === 'ACTIVE' || document.body.dataset.mode === 'ARMED'")
        if pictured():
            time.sleep(SOLID_S)
        keep(browser, TUTORIAL / "replay.png")
        assert browser.value("document.getElementById('speed').checkVisibility()"), "the vehicle is shown"
        assert browser.value("fetch('api/operator/arm', {method: 'POST'}).then(a => a.status)") == 409


def find_out_why(folder: Path, tmp_path: Path) -> None:
    """Replay the live run at the ten seconds before it stopped."""
    with (
        Started(folder, "timberhand", "console", "--replay", "runs/second") as started,
        Browser(tmp_path / "asker", SIZE, solid=pictured()) as browser,
    ):
        opened(started, browser)
        browser.until("document.body?.dataset.recording === 'yes'")
        browser.click("tab-timeline")
        browser.click_on("#panel-timeline .of-stop button", "Show 10 s before")
        browser.until("document.body.dataset.mode === 'STOP' || document.body.dataset.mode === 'FAULT'")
        if pictured():
            time.sleep(SOLID_S)
        keep(browser, TUTORIAL / "stopped.png")


@pytest.mark.timeout(1500)
def test_a_newcomer_plans_drives_and_replays_a_mission(folder: Path, tmp_path: Path) -> None:
    assert list(folder.iterdir()) == []
    plan(folder, tmp_path)
    drive(folder)
    replay(folder, tmp_path)


@pytest.mark.timeout(900)
def test_a_newcomer_watches_it_live_and_breaks_it(folder: Path, tmp_path: Path) -> None:
    """In real time on the wire: what is asserted is what the page says, also where a busy host stops the machine."""
    plan(folder, tmp_path)
    arguments = ("mission", "run", "missions/mission.geojson", "--bus", "wire", "--out", "runs/second")
    with (
        Started(folder, "timberhand", *arguments, option="--console-port") as started,
        Browser(tmp_path / "watcher", SIZE) as browser,
    ):
        opened(started, browser)
        browser.until("document.body.dataset.mode === 'ACTIVE'")  # the stand-in has pressed ARM
        take_control(browser)
        browser.click("tab-faults")
        browser.click_on(".fault-buttons button:not(:disabled)", "The emergency stop is pressed for 1 s")
        browser.wait(lambda: "reaction after" in browser.text("panel-faults"), "the card")
        card = browser.value("document.querySelector('.fault-card').innerText")
        assert card.startswith("The emergency stop is pressed for 1 s")
        browser.click("stop")
        audit = folder / "runs" / "second" / "audit.jsonl"
        browser.wait(lambda: "POST /api/operator/stop" in audit.read_text(), "STOP in the audit log")
        started.interrupt()
        browser.shows("alarm", "timberhand console --replay runs/second")
    assert started.process.returncode == 130, started.said.read_text()
    find_out_why(folder, tmp_path)
