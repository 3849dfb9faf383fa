"""What the machine's page costs a tablet: before it shows anything, and with 200 logs in view.

Counts, which no other load of the computer changes: bytes and files that block the first paint, draw calls of the 3-D
view.  The times of this computer are printed (``pytest -s``); it draws by software.
"""

from __future__ import annotations

import json
import math
import random
import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from can_dbc.messages.datagrams import encode
from console.console import Console
from console.server import create_app
from machine.loading.profile_file import load_profile, profile_hash
from tests.console.state_reports import REPORT
from tests.live.console.browser import MISSING, Browser, installed
from tests.live.console.served_page import served
from tests.operator_end import udp_end

pytestmark = pytest.mark.skipif(installed() is None, reason=MISSING)
PROFILE = load_profile("palms_471")
SIDES = 24
"""Of a log, as scene.js draws it: two triangles of bark and two of ends for each."""
MOST_BLOCKING_BYTES = 40_000
"""A tablet's network brings as much in a tenth of the two seconds."""
DRAWN = "(d => [d.calls ?? 0, d.triangles ?? 0].map(Number))(document.getElementById('scene').dataset)"


def heap(count: int, moment: int) -> bytes:
    """Logs about the crane, each a few millimetres from where it was seen at the last moment."""
    place, noise = random.Random(1), random.Random(moment)
    logs = []
    for _ in range(count):
        angle, reach = place.uniform(-3.0, 3.0), place.uniform(2.5, 4.5)
        position = [reach * math.cos(angle) + noise.gauss(0.0, 0.004), reach * math.sin(angle), place.uniform(-0.9, 0)]
        axis = [math.cos(2 * angle), math.sin(2 * angle), 0.0]
        logs.append({"position_m": position, "axis": axis, "length_m": place.uniform(1.7, 5), "diameter_m": 0.2})
    return json.dumps(logs).encode()


class Detector(threading.Thread):
    """Sees ``count`` logs, and reports of a crane that stands go to ``reports``."""

    def __init__(self, reports: tuple[str, int]) -> None:
        super().__init__()
        self.count, self.over, self._reports = 1, threading.Event(), reports
        self.link = udp_end(0.05)

    def run(self) -> None:
        moment = 0
        while not self.over.is_set():
            moment += 1
            self.link.sendto(encode(replace(REPORT, profile_hash=profile_hash(PROFILE))), self._reports)
            try:
                _, asks = self.link.recvfrom(2048)
            except TimeoutError:
                continue
            if asks != self._reports:
                self.link.sendto(heap(self.count, moment), asks)
        self.link.close()


@pytest.fixture
def detector() -> Iterator[tuple[Detector, str]]:
    reports = udp_end()
    seen = Detector(reports.getsockname())
    seen.start()
    console = Console(PROFILE, profile_hash(PROFILE), reports=reports, scene=seen.link.getsockname())
    with served(create_app(console)) as url:
        yield seen, url
    seen.over.set()
    seen.join()
    reports.close()


def test_little_blocks_the_first_paint_and_200_logs_are_drawn_at_once(
    detector: tuple[Detector, str], tmp_path: Path
) -> None:
    seen, url = detector
    with Browser(tmp_path, (1280, 800), solid=True) as browser:
        browser.open(url)
        browser.until(f"{DRAWN}[0] > 0")
        browser.until("performance.getEntriesByName('first-contentful-paint').length > 0")
        loaded = browser.value(
            "performance.getEntriesByType('resource').map(r => [r.name, r.renderBlockingStatus, r.encodedBodySize])"
        )
        blocking = [(name, size) for name, status, size in loaded if status == "blocking"]
        assert blocking and all(".css" in name for name, _ in blocking), "no script waits before the first paint"
        assert sum(size for _, size in blocking) <= MOST_BLOCKING_BYTES, blocking
        paint_ms = browser.value("performance.getEntriesByName('first-contentful-paint')[0].startTime")
        browser.wait(lambda: browser.value(DRAWN)[1] > 0, "the crane")
        calls, triangles = browser.value(DRAWN)
        seen.count = 200
        browser.wait(lambda: browser.value(DRAWN)[1] - triangles > 199 * 4 * SIDES - 1, "200 logs")
        assert browser.value(DRAWN)[0] <= calls + 3, "bark and two ends, for all logs together"
        frame_ms = browser.value(
            "(async () => { const t = performance.now(); let n = 0; while (performance.now() - t < 3000) {"
            " await new Promise(requestAnimationFrame); n++; } return 3000 / n; })()"
        )
        print(f"\nfirst paint {paint_ms:.0f} ms, {calls} draw calls, {frame_ms:.0f} ms a frame with 200 logs")
        browser.picture(tmp_path / "logs.png")
