"""Eight hours of a shift leave no more in a tab than the first two: its memory does not grow with the time.

The page gets the states of the shift as fast as it takes them, five for each second of the shift, and shows one panel
after another.  The heap is read over the DevTools protocol after a forced collection.  By the end of the first quarter
everything that is kept for a while is full: 400 entries of the timeline, two kilometres of track.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from can_dbc.bus.factory import open_bus
from console import server
from console.server import create_app
from tests.live.console.browser import MISSING, Browser, Memory, installed
from tests.live.console.served_page import served
from tests.live.console.shift_feed import CYCLE_S, HASH, PERIOD_S, PROFILE, STEP_NS, FedConsole, ShiftFeed

pytestmark = [
    pytest.mark.skipif(installed() is None, reason=MISSING),
    pytest.mark.timeout(3600),
]
HOURS = 8.0
DRAW_MS = 250
"""Of the computer's time; meanwhile a minute of the shift goes by."""
STALLED_S = 120.0
GROWTH_BYTES = 600_000
"""Of the heap from the first quarter to any later one; eight hours of anything kept per state are megabytes."""
GROWTH_NODES = 150
"""A row of the CAN table, a message of the alarm; a node kept per state would be 100 000."""
GROWTH_LISTENERS = 20
PANEL_HOURS = 0.1
PANELS = ("timeline", "can", "ticks", "error")


@pytest.fixture
def shift(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[FedConsole, Browser]]:
    monkeypatch.setattr(server, "PERIOD_S", PERIOD_S)  # which the feed changes; put back at the end
    with open_bus("virtual:shift") as bus:
        feed = ShiftFeed(time.monotonic_ns(), bus)
        console = FedConsole(
            PROFILE,
            HASH,
            tmp_path / "nobody",
            timing_page=tmp_path / "none.timing",
            buses={PROFILE.crane_bus: "virtual:shift"},
            clock=lambda: feed.now_ns,
            feed=feed,
        )
        with served(create_app(console)) as url, Browser(tmp_path, (1280, 800), solid=True) as browser:
            browser.draw_every(DRAW_MS)
            browser.open(url)
            browser.wait(lambda: browser.text("tab-timeline"), "the page is ready")
            browser.until("document.querySelector('#scene canvas') !== null")
            browser.wait(lambda: console.answered_ms, "the page answers")
            yield console, browser


def work_until(hours: float, console: FedConsole, browser: Browser) -> None:
    """Let the shift go on until its hour, and change the panel on the way."""
    feed = console.feed
    assert feed is not None
    last, moved_s, change = feed.hours, time.monotonic(), feed.hours
    console.paused = False
    while feed.hours < hours:
        if feed.hours >= change:
            change += PANEL_HOURS
            browser.click(f"tab-{PANELS[round(feed.hours / PANEL_HOURS) % len(PANELS)]}")
        time.sleep(0.2)
        if feed.hours > last:
            last, moved_s = feed.hours, time.monotonic()
        assert time.monotonic() < moved_s + STALLED_S, f"the page has stalled after {last:.2f} h"
    console.paused = True
    browser.click("tab-error")
    browser.wait(lambda: console.answered_ms == feed.now_ns // 1_000_000, "the page has all")
    browser.until("document.querySelectorAll('.events li').length === 400")


def test_eight_hours_leave_no_more_in_the_tab_than_two(
    shift: tuple[FedConsole, Browser],
) -> None:
    console, browser = shift
    first: Memory | None = None
    for quarter in range(1, 5):
        work_until(HOURS * quarter / 4, console, browser)
        now = browser.memory()
        first = first or now
        print(f"{HOURS * quarter / 4:g} h: {now}")
        assert now.heap_bytes - first.heap_bytes < GROWTH_BYTES, (quarter, first, now)
        assert now.nodes - first.nodes < GROWTH_NODES, (quarter, first, now)
        assert now.listeners - first.listeners < GROWTH_LISTENERS, (quarter, first, now)
    assert console.feed is not None and console.feed.steps * STEP_NS >= HOURS * 3600 * 10**9
    loaded = int(browser.value("document.getElementById('shift-logs').textContent"))
    assert abs(loaded - console.feed.hours * 3600 / CYCLE_S) <= 1, "the page counts to the end"
