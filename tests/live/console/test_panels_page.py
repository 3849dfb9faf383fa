"""The panels in a browser: the CAN table hears the bus while it is shown, a stop has its remedy, ticks have bars."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from can_dbc.bus.factory import open_bus
from can_dbc.dbc.codec import load
from can_dbc.messages.datagrams import encode
from can_dbc.protocols.e2e import Sender
from can_dbc.timing.page import TimingWriter
from console.console import Console
from console.server import create_app
from machine.loading.profile_file import load_profile, profile_hash
from machine.status.explanation import explain
from machine.status.modes import Mode
from machine.status.reasons import Reason, pack
from tests.console.state_reports import at
from tests.live.console.browser import MISSING, Browser, installed
from tests.live.console.served_page import fed, served
from tests.operator_end import udp_end

pytestmark = pytest.mark.skipif(installed() is None, reason=MISSING)
PROFILE, BUS = load_profile("palms_471"), "virtual:panels"
STOPPED = pack(Reason.JOINT_STUCK, 1)
Q = (0.4, 0.9, -1.6, 0.5, 0.0)


@pytest.fixture
def page(tmp_path: Path, timing) -> Iterator[tuple[Console, str]]:
    """A console with a bus on which a valve node and an encoder send, and a controller that stops."""
    times = tmp_path / "controller.timing"
    reports = udp_end()
    console = Console(
        PROFILE, profile_hash(PROFILE), reports=reports, timing_page=times, buses={PROFILE.crane_bus: BUS}
    )

    crane, writer, began = load("crane"), TimingWriter(times), time.monotonic_ns()
    valve, lift = crane.message("ValveFbA"), crane.message("EncLift")
    sender = Sender(valve.data_ids)

    def told(now_ns: int) -> Iterator[bytes]:
        mode, reason = (Mode.STOP, STOPPED) if now_ns - began > 10**9 else (Mode.ACTIVE, 0)
        yield encode(at(Q, now_ns, mode, reason=reason))
        bus.send(valve.key, sender.protect(bytes(valve.length)))
        bus.send(lift.key, bytes(lift.length))
        written = timing(400, written_ns=now_ns)
        writer.publish(written.facts, written.durations)

    with open_bus(BUS) as bus, fed(reports.getsockname(), 0.05, told), served(create_app(console)) as url:
        yield console, url
    writer.close()
    reports.close()


def test_the_panels_show_bus_stop_and_ticks(page: tuple[Console, str], tmp_path: Path) -> None:
    console, url = page
    with Browser(tmp_path, (1280, 800)) as browser:
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
