"""The page shows what the real perception process sees with the plant's camera: picture, logs, grasp and truth."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.live.console.browser import MISSING, Browser, installed
from tests.live.console.perceived_run import CAMERA, PerceivedRun, perceived_run

pytestmark = [pytest.mark.skipif(installed() is None, reason=MISSING), pytest.mark.timeout(300)]
GRASP = "Boolean(document.querySelector('.camera-picture circle.grasp'))"
RATIO = "(p => p.naturalWidth / p.naturalHeight)(document.querySelector('.camera-picture img'))"
PICTURE = "document.querySelector('.camera-picture img')"


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Iterator[PerceivedRun]:
    with perceived_run(tmp_path_factory.mktemp("perceived")) as started:
        yield started


@pytest.fixture
def browser(run: PerceivedRun, tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[Browser]:
    size, light = getattr(request, "param", ((1280, 800), False))
    with Browser(tmp_path, size, light) as opened:
        opened.open(run.url)
        opened.wait(lambda: opened.text("tab-camera"), "the page is ready")
        yield opened


def test_the_picture_has_the_logs_and_the_grasp_that_the_planner_chose(run: PerceivedRun, browser: Browser) -> None:
    browser.wait(lambda: run.logs, "the perception process lists logs")
    asked = len(browser.value("performance.getEntriesByType('resource').filter(e => e.name.includes('api/camera'))"))
    assert asked == 0, "the camera is asked only for while its panel is shown"
    browser.click("tab-camera")
    browser.until(f"{PICTURE}?.naturalWidth > 300")
    assert CAMERA in browser.value(f"{PICTURE}.alt")
    lines = "document.querySelectorAll('.camera-picture line.axis').length"
    browser.wait(lambda: browser.value(lines), "the logs in the picture")
    grasp = run.choose_grasp()
    try:
        browser.until(GRASP)
        assert grasp.reason in browser.text("panel-camera") and "97 %" in browser.text("panel-camera")
        # The tips lie on both sides of the log that the camera found by itself, and the line between them crosses it.
        (a, b), tips = browser.value(
            "((l, t) => [[[+l.x1.baseVal.value, +l.y1.baseVal.value], [+l.x2.baseVal.value, +l.y2.baseVal.value]],"
            " [...t].map(c => [c.cx.baseVal.value, c.cy.baseVal.value])])(document.querySelector('line.axis.chosen'),"
            " document.querySelectorAll('circle.grasp'))"
        )
        side = [(b[0] - a[0]) * (t[1] - a[1]) - (b[1] - a[1]) * (t[0] - a[0]) for t in tips]
        assert side[0] * side[1] < 0
    finally:
        run.grasp = None
    browser.until(f"!{GRASP}")


def test_the_true_logs_are_near_the_perceived_ones_and_are_asked_for_only_when_wanted(
    run: PerceivedRun, browser: Browser
) -> None:
    browser.wait(lambda: run.logs, "the perception process lists logs")
    true = browser.value("fetch('api/true-logs').then(a => a.json())")
    seen = [log for log in run.logs if log.seen]
    for log in seen:
        nearest = min(sum((p - q) ** 2 for p, q in zip(log.center_m, t["center_m"], strict=True)) for t in true) ** 0.5
        assert nearest < 0.15, "perceived by the camera, within its error of the truth"
    assert browser.text("true-logs") and not browser.text("true-legend")


SIZES = ((1280, 800), (800, 1280), (390, 844))


@pytest.mark.parametrize("browser", [(size, light) for size in SIZES for light in (False, True)], indirect=True)
def test_nothing_is_cut_off_at_the_usual_sizes(run: PerceivedRun, browser: Browser) -> None:
    run.logs or browser.wait(lambda: run.logs, "the perception process lists logs")
    run.choose_grasp()
    try:
        browser.click("tab-camera")
        browser.until(GRASP)
        assert browser.value("document.documentElement.scrollWidth <= innerWidth")
        box = browser.value(
            "(b => [b.width, b.height])(document.querySelector('.camera-picture').getBoundingClientRect())"
        )
        assert box[0] > 200 and box[0] / box[1] == pytest.approx(browser.value(RATIO), rel=0.03)
        if folder := os.environ.get("TIMBERHAND_PICTURES"):
            size = browser.value("`${innerWidth}x${innerHeight}`")
            light = "-light" if browser.value("matchMedia('(prefers-color-scheme: light)').matches") else ""
            browser.value("document.querySelector('.plot').scrollIntoView()")
            browser.picture(Path(folder) / f"camera-{size}{light}.png")
    finally:
        run.grasp = None


def test_the_three_dimensional_view_draws_true_logs_and_grasp(run: PerceivedRun, tmp_path: Path) -> None:
    browser = Browser(tmp_path, (1280, 800), solid=True)
    try:
        browser.open(run.url)
        browser.until("Boolean(document.querySelector('#scene canvas'))")
        browser.wait(lambda: run.logs, "the perception process lists logs")
        run.choose_grasp()
        browser.click("true-logs")
        browser.until("!document.getElementById('true-legend').hidden")
        browser.until(
            "performance.getEntriesByType('resource').filter(e => e.name.includes('api/true-logs')).length > 1"
        )
        assert browser.text("true-legend")
        if folder := os.environ.get("TIMBERHAND_PICTURES"):
            browser.picture(Path(folder) / "true-logs.png")
        browser.click("true-logs")
        browser.until("document.getElementById('true-legend').hidden")
    finally:
        run.grasp = None
        browser.close()
