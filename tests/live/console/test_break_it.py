"""Try to break it: only with the desk of a live run, only from this machine; the card tells what became of it."""

from __future__ import annotations

import json
import socketserver
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from starlette.testclient import TestClient

from can_dbc.messages.datagrams import encode
from console.console import Console
from console.server import create_app
from machine.loading.profile_file import load_profile, profile_hash
from machine.status.modes import Mode
from machine.status.reasons import Reason, pack
from tests.console.page_client import HERE, page_client
from tests.console.state_reports import at
from tests.live.console.browser import MISSING, Browser, installed
from tests.live.console.control import take_control
from tests.live.console.served_page import fed, served
from tests.operator_end import udp_end

PROFILE = load_profile("palms_471")
HASH = profile_hash(PROFILE)
REFUSED = "not now"
OFFER = {"name": "estop", "title": "The emergency stop is pressed", "what": "pressed", "why_not": ""}


class _Desk(socketserver.StreamRequestHandler):
    """A live run's desk; its server keeps the orders, and carries them out while ``answers`` is set."""

    def handle(self) -> None:
        request = json.loads(self.rfile.readline())
        told = {"faults": [OFFER]}
        if request["op"] == "inject":
            self.server.answers.wait(5.0)
            if REFUSED in self.server.ordered:
                self.wfile.write(json.dumps({"error": REFUSED}).encode() + b"\n")
                return
            self.server.ordered.append(request["name"])
            told = {"at_ns": time.monotonic_ns(), "title": OFFER["title"], "said": "begun"}
            if request["name"] != "estop":
                told = {"error": "this fault is not offered"}
        self.wfile.write(json.dumps(told).encode() + b"\n")


@pytest.fixture
def desk(tmp_path: Path) -> Iterator[tuple[Path, list[str], threading.Event]]:
    path = tmp_path / "desk"
    with socketserver.UnixStreamServer(str(path), _Desk) as server:
        server.ordered, server.answers = [], threading.Event()
        server.answers.set()
        thread = threading.Thread(target=server.serve_forever, args=(0.05,))
        thread.start()
        yield path, server.ordered, server.answers
        server.shutdown()
        thread.join()


def client_of(console: Console, peer: str = "127.0.0.1") -> TestClient:
    return page_client(console, peer, leads=peer == "127.0.0.1")


def test_a_fault_is_ordered_and_followed(desk) -> None:
    console = Console(PROFILE, HASH, faults=desk[0])
    client = client_of(console)
    assert client.get("/api/faults").json() == [OFFER]
    assert "faults" in client.get("/api/machine").json()["panels"]
    assert client.post("/api/faults/estop", headers={"origin": HERE}).status_code == 204
    assert desk[1] == ["estop"] and console.crane_state.fault_watch.card()["title"] == OFFER["title"]
    assert client.post("/api/faults/other").status_code == 409


def test_a_console_of_a_machine_has_no_faults(desk) -> None:
    client = client_of(Console(PROFILE, HASH))
    assert "faults" not in client.get("/api/machine").json()["panels"]
    assert client.get("/api/faults").status_code == client.post("/api/faults/estop").status_code == 404
    assert desk[1] == []


def test_other_machines_and_other_sites_cannot_inject(desk) -> None:
    console = Console(PROFILE, HASH, faults=desk[0])
    assert client_of(console, "192.0.2.7").post("/api/faults/estop").status_code == 403
    here = client_of(console)
    assert here.post("/api/faults/estop", headers={"origin": "http://evil.example"}).status_code == 403
    assert here.get("/api/faults/estop").status_code == 405
    assert page_client(console).post("/api/faults/estop").status_code == 403, "another page has control"
    assert desk[1] == []


def test_a_silent_desk_is_named(tmp_path: Path) -> None:
    answer = client_of(Console(PROFILE, HASH, faults=tmp_path / "none")).post("/api/faults/estop")
    assert answer.status_code == 409


@pytest.mark.skipif(installed() is None, reason=MISSING)
def test_a_button_breaks_the_run_and_the_card_says_what_happened(desk, tmp_path: Path) -> None:
    reports, since_ns = udp_end(), 0

    def told(now_ns: int) -> Iterator[bytes]:
        nonlocal since_ns
        since_ns = since_ns or (now_ns if desk[1] else 0)
        stopped = {"reason": pack(Reason.ESTOP_PRESSED, 0), "since_ns": since_ns, "numbers": (0.0, 0.0, 0.0)}
        mode, more = (Mode.STOP, stopped) if since_ns else (Mode.ACTIVE, {})
        yield encode(at((0.4, 0.9, -1.6, 0.5, 0.0), now_ns, mode, profile_hash=HASH, **more))

    console = Console(PROFILE, HASH, tmp_path / "operator", reports=reports, faults=desk[0])
    feeding = fed(reports.getsockname(), 0.02, told)
    with feeding, served(create_app(console)) as url, Browser(tmp_path, (1280, 800)) as browser:
        browser.open(url)
        browser.wait(lambda: browser.text("tab-faults"), "the page is ready")
        browser.click("tab-faults")
        assert browser.value("[...document.querySelectorAll('.fault-buttons button')].every(b => b.disabled)")
        assert desk[1] == []
        take_control(browser)
        ready = "document.querySelector('.fault-buttons button:not(:disabled)')"
        browser.until(f"Boolean({ready})")
        desk[2].clear()
        browser.value(f"{ready}.click()")
        browser.wait(lambda: "Is being injected" in browser.text("panel-faults"), "it is on its way")
        assert not browser.value(f"Boolean({ready})"), "one at a time"
        desk[2].set()
        browser.until(f"Boolean({ready})")
        browser.wait(lambda: "ESTOP_PRESSED" in browser.text("panel-faults"), "what stopped it")
        assert "ms" in browser.text("panel-faults") and "0.0 mm" in browser.text("panel-faults")


@pytest.mark.skipif(installed() is None, reason=MISSING)
def test_a_page_opened_before_the_run_is_up_gets_its_buttons(tmp_path: Path) -> None:
    path = tmp_path / "desk"
    console = Console(PROFILE, HASH, tmp_path / "operator", faults=path)
    with served(create_app(console)) as url, Browser(tmp_path, (1280, 800)) as browser:
        browser.open(url)
        browser.wait(lambda: browser.text("tab-faults"), "the page is ready")
        browser.click("tab-faults")
        browser.wait(lambda: "does not answer" in browser.text("panel-faults"), "why there are no buttons")
        with socketserver.UnixStreamServer(str(path), _Desk) as server:
            server.ordered = []
            thread = threading.Thread(target=server.serve_forever, args=(0.05,))
            thread.start()
            browser.wait(lambda: OFFER["title"] in browser.text("panel-faults"), "the buttons")
            assert "does not answer" not in browser.text("panel-faults")
            server.shutdown()
            thread.join()


@pytest.mark.skipif(installed() is None, reason=MISSING)
def test_a_fault_that_is_refused_does_not_stay_on_its_way(desk, tmp_path: Path) -> None:
    desk[1].append(REFUSED)
    console = Console(PROFILE, HASH, tmp_path / "operator", faults=desk[0])
    with served(create_app(console)) as url, Browser(tmp_path, (1280, 800)) as browser:
        browser.open(url)
        browser.wait(lambda: browser.text("tab-faults"), "the page is ready")
        browser.click("tab-faults")
        take_control(browser)
        ready = "document.querySelector('.fault-buttons button:not(:disabled)')"
        browser.until(f"Boolean({ready})")
        browser.value(f"{ready}.click()")
        browser.wait(lambda: REFUSED in browser.text("panel-faults"), "why not")
        browser.until(f"Boolean({ready})")
