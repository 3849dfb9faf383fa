"""A recording in the page: it plays, pauses and seeks, and nothing can be commanded."""

from __future__ import annotations

from pathlib import Path

import pytest

from console.replay_server import create_replay_app
from tests.console.recorded_run import PROFILE, STOP_S, RecordedRun
from tests.live.console.browser import MISSING, Browser, installed
from tests.live.console.served_page import served


@pytest.mark.skipif(installed() is None, reason=MISSING)
def test_a_stop_opens_ten_seconds_before_it(tmp_path: Path) -> None:
    app = create_replay_app(RecordedRun(), PROFILE, name="runs/demo-1")
    with served(app) as url, Browser(tmp_path, (1280, 800)) as browser:
        browser.open(url)
        browser.wait(lambda: "runs/demo-1" in browser.text("replay"), "the recording's name")
        assert browser.text("stop") == "" and browser.text("arm") == ""
        browser.click("tab-timeline")
        browser.wait(lambda: "JOINT_STUCK" in browser.text("panel-timeline"), "the stop")
        browser.value("document.querySelector('.of-stop button').click()")
        browser.wait(lambda: "Pause" in browser.text("replay"), "it plays")
        clock = "parseFloat(document.querySelector('.clock').value)"
        browser.wait(lambda: STOP_S - 10 < browser.value(clock) < STOP_S, "ten seconds before the stop")
        assert browser.text("mode") == "ACTIVE"
        # Space means pause here, and nothing is sent that a machine would hear.
        key = "new KeyboardEvent('keydown', {key: ' ', bubbles: true, cancelable: true})"
        assert browser.value(f"document.body.dispatchEvent({key})") is False
        browser.wait(lambda: "Play" in browser.text("replay"), "it pauses")
        assert browser.text("alarm") == ""
        browser.value(
            "(b => { b.value = 50; b.dispatchEvent(new Event('change')); })(document.querySelector('.scrub'))"
        )
        browser.wait(lambda: browser.text("mode") == "STOPPED", "the state after the stop")
