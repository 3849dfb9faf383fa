"""Commissioning in a browser at a crane that runs: a joint is stepped, STOP ends a calibration, a protocol is kept."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from autonomy.commissioning.acceptance import IDS
from machine.loading.profile_file import load_profile
from tests.live.console.bench import audited, bench
from tests.live.console.browser import MISSING, Browser, installed
from tests.live.console.control import take_control

pytestmark = pytest.mark.skipif(installed() is None, reason=MISSING)
SIZES = [(1280, 800), (800, 1280), (390, 844)]


@pytest.fixture
def browser(tmp_path: Path) -> Iterator[Browser]:
    with bench(tmp_path) as url, Browser(tmp_path, SIZES[0]) as made:
        made.open(f"{url}commission")
        made.until("document.body?.dataset.ready === 'yes'")
        yield made


def arm(browser: Browser) -> None:
    browser.until("!document.getElementById('arm').disabled")
    browser.click("arm")
    browser.until("document.getElementById('confirm').open")
    browser.click("confirm-yes")


@pytest.mark.timeout(300)
def test_a_joint_is_stepped_a_calibration_stopped_and_a_protocol_kept(browser: Browser, tmp_path: Path) -> None:
    browser.shows("mode", "STANDBY")
    assert browser.value("document.getElementById('step').disabled"), "nobody has control"
    take_control(browser)
    browser.until("!document.getElementById('step').disabled")
    browser.click("step")
    browser.shows("doing", "waits: the controller is in STANDBY")
    assert browser.value("document.getElementById('calibrate').disabled"), "one at a time"
    arm(browser)
    browser.shows("doing", "runs")
    browser.shows("doing", "The step of the slew is done.")
    error, command = browser.text("largest-error"), browser.text("command")
    assert 0.0 < float(error.rstrip("°")) < 5.0 and 10 < float(command.rstrip(" %")) <= 100
    assert "°" in browser.text("margins") and "dB" in browser.text("margins")
    assert browser.value("document.getElementById('way').ariaLabel ?? ''")
    assert "slew" in browser.text("measured")
    if pictures := os.environ.get("TIMBERHAND_PICTURES"):
        browser.value(  # a picture for everybody has no folder of this computer
            "(e => { e.textContent = e.textContent.replace(/ in .*/, ' in commissioning'); })"
            "(document.getElementById('protocol-facts'))"
        )
        for wide, high in SIZES:
            browser._ask(
                "Emulation.setDeviceMetricsOverride", width=wide, height=high, deviceScaleFactor=1, mobile=False
            )
            browser.until("document.documentElement.scrollWidth <= innerWidth")
            browser.wait(lambda: True, "drawn")
            browser.value("new Promise(done => setTimeout(done, 300))")
            browser.picture(Path(pictures, f"commission-{wide}x{high}.png"))
        browser._ask("Emulation.setDeviceMetricsOverride", width=1280, height=800, deviceScaleFactor=1, mobile=False)

    browser.until("!document.getElementById('calibrate').disabled")
    browser.click("calibrate")
    browser.until("document.getElementById('confirm').open")
    browser.click("confirm-yes")
    browser.shows("doing", "The calibration runs")
    browser.until("document.getElementById('share').value > 0")
    browser.keys("Escape")
    browser.shows("doing", "has ended early")
    assert not list((tmp_path / "kept").glob("*.toml"))

    browser.value("document.getElementById('name').value = 'crane-1'")
    browser.click("save")
    browser.shows("verdict", "INCOMPLETE")
    browser.value(
        "for (const s of document.querySelectorAll('#checks select')) s.value = 'pass';"
        "for (const id of ['machine', 'inspector']) document.getElementById(id).value = 'x ' + id;"
        "document.getElementById('name').value = 'crane-2'"
    )
    browser.click("save")
    browser.shows("verdict", "ACCEPTED")
    kept = json.loads((tmp_path / "kept" / "crane-2.protocol.json").read_text())
    assert kept["verdict"] == "accepted" and [e["id"] for e in kept["entries"]] == list(IDS)
    assert kept["steps"]["slew"]["largest_error"] > 0.0 and kept["saved_by"] == "this machine"
    browser.click("save")
    browser.shows("alarm", "a protocol is never changed")
    browser.value("document.getElementById('saved').value = 'crane-1'")
    browser.click("open")
    browser.shows("verdict", "INCOMPLETE")
    paper = browser._ask("Page.printToPDF")["data"]
    assert len(paper) > 5000
    assert "POST /api/commission/step" in audited(tmp_path) and "POST /api/operator/stop" in audited(tmp_path)


@pytest.mark.timeout(400)
def test_a_joint_is_calibrated_to_the_end_and_the_page_shows_what_was_found(browser: Browser, tmp_path: Path) -> None:
    """A stop by a lost message does not end it; a person resets and arms, and it repeats the test."""
    take_control(browser)
    browser.until("!document.getElementById('calibrate').disabled")
    browser.value("document.getElementById('calibrated').value = 'lift'")
    browser.click("calibrate")
    browser.until("document.getElementById('confirm').open")
    browser.click("confirm-yes")
    shares: list[float] = []
    deadline = time.monotonic() + 300.0
    while (told := browser.text("doing")) != "The calibration is done." and time.monotonic() < deadline:
        assert "ended early" not in told, told
        if "waits" in told:  # for the first arming, or after a stop on a busy computer
            browser.value("document.getElementById('reset').click()")
            arm(browser)
            patience = time.monotonic() + 5.0
            while "waits" in browser.text("doing") and time.monotonic() < patience:
                time.sleep(0.2)
        shares.append(browser.value("document.getElementById('share').value"))
        time.sleep(1.0)
    browser.shows("doing", "The calibration is done.")
    assert len(set(shares)) > 4, f"its progress was shown: {shares}"
    browser.shows("said", ".toml is written")
    (written,) = (tmp_path / "kept").glob("*.toml")
    calibrated, shipped = load_profile(written), load_profile("palms_471")
    assert calibrated.joints["lift"] != shipped.joints["lift"] and calibrated.joints["tilt"] == shipped.joints["tilt"]
    result = json.loads((tmp_path / "kept" / written.stem / "result.json").read_text())
    assert result["plausible"] and list(result["joints"]) == ["lift"]
    keys = browser.value("[...document.querySelectorAll('#changes tbody tr')].map(r => r.cells[0].firstChild.data)")
    assert keys == list(result["changes"])
    before = browser.value("document.querySelector('#changes tbody tr').cells[1].textContent")
    assert float(before) == shipped.joints["lift"].valve.deadband_plus_pct and keys[0].endswith("deadband_plus_pct")
    browser.value("document.querySelector('#plots img').scrollIntoView()")
    browser.until("document.querySelector('#plots img').naturalWidth > 100")
    if pictures := os.environ.get("TIMBERHAND_PICTURES"):
        browser.picture(Path(pictures, "commission-calibrated.png"))


@pytest.mark.timeout(200)
def test_a_step_ends_when_its_page_has_gone(browser: Browser, tmp_path: Path) -> None:
    take_control(browser)
    browser.value("document.getElementById('amount').value = 15")
    browser.click("step")
    browser.shows("doing", "waits")
    browser.open(browser.value("location.origin") + "/")  # to the machine's page in the same tab: control stays
    browser.until("document.body?.dataset.control === 'mine'")
    browser.click("lease-button")
    browser.until("document.body?.dataset.control === 'nobody'")
    browser.open(browser.value("location.origin") + "/commission")
    browser.shows("doing", "has ended early: the page that began it has no control any more")
