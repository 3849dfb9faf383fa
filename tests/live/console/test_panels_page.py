"""The panels in a browser: the CAN table hears the bus while it is shown, a stop has its remedy, ticks have bars."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from can_dbc.bus.factory import open_bus
from can_dbc.dbc.codec import load
from can_dbc.messages.crane import StateReport
from can_dbc.messages.datagrams import encode
from can_dbc.protocols.e2e import Sender
from can_dbc.timing.page import TimingWriter
from console.console import Console
from console.server import create_app
from machine.loading.profile_file import load_profile, profile_hash
from machine.status.explanation import explain
from machine.status.modes import Mode
from machine.status.reasons import Reason, pack
from tests.live.console.browser import MISSING, Browser, installed
from tests.live.console.served_page import served

pytestmark = pytest.mark.skipif(installed() is None, reason=MISSING)
PROFILE, BUS = load_profile("palms_471"), "virtual:panels"
STOPPED = pack(Reason.JOINT_STUCK, 1)
Q = (0.4, 0.9, -1.6, 0.5, 0.0)


@pytest.fixture
def page(tmp_path: Path, timing) -> Iterator[tuple[Console, str]]:
    """A console with a bus on which a valve node and an encoder send, and a controller that stops."""
    reports, over = socket.socket(socket.AF_INET, socket.SOCK_DGRAM), threading.Event()
    reports.bind(("127.0.0.1", 0))
    reports.setblocking(False)
    times, to = tmp_path / "controller.timing", reports.getsockname()
    console = Console(
        PROFILE, profile_hash(PROFILE), reports=reports, timing_page=times, buses={PROFILE.crane_bus: BUS}
    )

    def feed() -> None:
        crane, writer, began = load("crane"), TimingWriter(times), time.monotonic_ns()
        valve, lift = crane.message("ValveFbA"), crane.message("EncLift")
        sender = Sender(valve.data_ids)
        with open_bus(BUS) as bus, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
            while not over.wait(0.05):
                now = time.monotonic_ns()
                mode, reason = (Mode.STOP, STOPPED) if now - began > 10**9 else (Mode.ACTIVE, 0)
                out.sendto(
                    encode(
                        StateReport(
                            1,
                            profile_hash(PROFILE),
                            now,
                            mode,
                            0,
                            reason,
                            1,
                            0,
                            0,
                            0,
                            Q,
                            (0.0,) * 5,
                            Q,
                            50.0,
                            12.0,
                            0.0,
                            0,
                            0,
                            0,
                            0,
                        )
                    ),
                    to,
                )
                bus.send(valve.key, sender.protect(bytes(valve.length)))
                bus.send(lift.key, bytes(lift.length))
                written = timing(400, written_ns=now)
                writer.publish(written.facts, written.durations)
        writer.close()

    thread = threading.Thread(target=feed)
    thread.start()
    with served(create_app(console)) as url:
        yield console, url
    over.set()
    thread.join()
    reports.close()


def test_the_panels_show_bus_stop_and_ticks(page: tuple[Console, str], tmp_path: Path) -> None:
    console, url = page
    browser = Browser(tmp_path, (1280, 800))
    try:
        browser.open(url)
        browser.wait(lambda: browser.text("tab-timeline"), "the page is ready")
        browser.click("tab-timeline")
        browser.wait(lambda: "JOINT_STUCK" in browser.text("panel-timeline"), "the stop in the timeline")
        told = explain(STOPPED)
        assert told.sentence in browser.text("panel-timeline") and told.advice in browser.text("panel-timeline")
        assert not console.can_tap.tables()[0].get("rows"), "nobody looks, so the bus is closed"
        browser.click("tab-can")
        browser.wait(lambda: "ValveFbA" in browser.text("panel-can"), "a message of the bus")
        assert "Neutral (0)" in browser.text("panel-can") and "Position" in browser.text("panel-can")
        browser.click("tab-ticks")
        browser.wait(lambda: "median" in browser.text("panel-ticks"), "the histograms")
        assert browser.value("document.querySelectorAll('#panel-ticks canvas').length") == 4
        browser.wait(lambda: not console.can_tap.tables()[0].get("rows"), "the bus is closed again")
    finally:
        browser.close()
