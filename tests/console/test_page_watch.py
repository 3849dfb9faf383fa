"""The watch of the pages: answers of a browser become heartbeats, and only a page closed on purpose ends the watch."""

from __future__ import annotations

import itertools
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import msgspec
import pytest
from starlette.testclient import TestClient, WebSocketTestSession

from can_dbc.messages.crane import LinkWatch, OperatorAction, OperatorCommand
from can_dbc.messages.datagrams import decode, encode
from console.console import CLOSED_PAGES, MIN_BEAT_NS, Console, PageWatch
from console.state import CraneState
from machine.loading.profile_file import load_profile, profile_hash
from tests.console.page_client import BROWSING, Clock, page_client, socket_of
from tests.console.state_reports import at
from tests.operator_end import OperatorEnd

MS = 1_000_000
LIMIT_NS = 1000 * MS
PROFILE = load_profile("palms_471")


def answer(page: str, at_ms: int) -> str:
    return f"{page} {at_ms}"


# -- the pure part


def test_an_answer_is_a_heartbeat_with_the_stamp_of_the_state_that_it_answers() -> None:
    watch = PageWatch(LIMIT_NS)
    assert watch.beat(answer("a", 5000), 5020 * MS) == 5000 * MS
    assert watch.beat(answer("a", 5200), 5270 * MS) == 5200 * MS


def test_many_pages_send_no_more_than_one() -> None:
    watch = PageWatch(LIMIT_NS)
    sent = [watch.beat(answer(f"page-{k % 7}", 5000 + 10 * k), (5005 + 10 * k) * MS) for k in range(100)]
    stamps = [stamp for stamp in sent if stamp is not None]
    assert 5 <= len(stamps) <= 1000 * MS // MIN_BEAT_NS + 1
    assert all(b - a >= MIN_BEAT_NS for a, b in itertools.pairwise(stamps))


def test_an_answer_that_waited_for_the_limit_is_no_heartbeat() -> None:
    watch = PageWatch(LIMIT_NS)
    assert watch.beat(answer("a", 5000), 6000 * MS) is None
    assert watch.beat(answer("a", 5000), 6000 * MS - 1) == 5000 * MS
    assert watch.beat(answer("a", 7000), 6999 * MS) is None, "of a state that has not left"


@pytest.mark.parametrize(
    "text", ["", "a", "5000", "A 5000", "a 5000 ", "a -1", "a 5e3", "x" * 33 + " 5000", "a\n 5000"]
)
def test_other_texts_are_ignored(text: str) -> None:
    assert PageWatch(LIMIT_NS).beat(text, 5000 * MS) is None


def test_a_limit_of_zero_watches_nothing() -> None:
    watch = PageWatch(0)
    assert watch.beat(answer("a", 5000), 5000 * MS) is None and not watch.end("a", 5000 * MS)


def test_the_last_page_that_closes_ends_the_watch() -> None:
    watch = PageWatch(LIMIT_NS)
    watch.beat(answer("a", 5000), 5000 * MS)
    watch.beat(answer("b", 5100), 5100 * MS)
    assert not watch.end("a", 5200 * MS)
    assert watch.end("b", 5200 * MS)


def test_a_page_that_vanished_just_before_another_closed_is_still_seen() -> None:
    watch = PageWatch(LIMIT_NS)
    watch.beat(answer("gone", 5000), 5000 * MS)
    watch.beat(answer("b", 5000), 5000 * MS)
    assert not watch.end("b", 5999 * MS), "the controller holds"
    watch.beat(answer("c", 6000), 6000 * MS)
    assert watch.end("c", 6010 * MS), "it was another page's turn to watch"


def test_an_answer_on_its_way_while_its_page_closed_begins_no_watch() -> None:
    watch = PageWatch(LIMIT_NS)
    watch.beat(answer("a", 5000), 5000 * MS)
    assert watch.end("a", 5200 * MS)
    assert watch.beat(answer("a", 5200), 5210 * MS) is None
    assert watch.beat(answer("a-again", 5200), 5210 * MS) == 5200 * MS


def test_memory_is_bounded() -> None:
    watch = PageWatch(LIMIT_NS)
    for k in range(1000):
        watch.beat(answer(f"open-{k}", 5000 + 100 * k), (5000 + 100 * k) * MS)
        watch.end(f"closed-{k}", (5000 + 100 * k) * MS)
    assert len(watch._heard_ns) <= 10 and len(watch._closed) == CLOSED_PAGES
    assert not watch.end("x" * 33, 10**12)


# -- the server


@dataclass
class Served:
    console: Console
    clock: Clock
    operator: socket.socket

    def client(self) -> TestClient:
        return page_client(self.console)

    @contextmanager
    def answering(
        self, page: str = "page", peer: str = "127.0.0.1"
    ) -> Iterator[tuple[TestClient, WebSocketTestSession]]:
        """A client and its websocket, on which a page has answered the first state."""
        client = page_client(self.console, peer)
        with client.websocket_connect(socket_of(client), headers=BROWSING) as ws:
            ws.send_text(answer(page, ws.receive_json()["sent_ms"]))
            yield client, ws

    def heard(self, timeout_s: float = 5.0) -> OperatorCommand | None:
        self.operator.settimeout(timeout_s)
        try:
            command = decode(self.operator.recv(100))
        except TimeoutError:
            return None
        assert isinstance(command, OperatorCommand)
        return command


@pytest.fixture
def served(tmp_path: Path) -> Iterator[Served]:
    with OperatorEnd(tmp_path / "operator") as operator:
        clock = Clock()
        yield Served(Console(PROFILE, profile_hash(PROFILE), tmp_path / "operator", clock=clock), clock, operator)


def test_an_answer_on_the_websocket_becomes_a_heartbeat(served: Served) -> None:
    client = served.client()
    with client.websocket_connect(socket_of(client), headers=BROWSING) as ws:
        sent_ms = ws.receive_json()["sent_ms"]
        served.clock.now_ns += 60 * MS
        ws.send_text(answer("page", sent_ms))
        command = served.heard()
    assert command is not None and command.action is OperatorAction.WATCH
    assert (command.stamp_ns, command.profile_hash) == (sent_ms * MS, profile_hash(PROFILE))


def test_the_server_alone_makes_no_heartbeat(served: Served) -> None:
    """A cut network keeps the websocket open for minutes: without answers of the browser nothing may be sent."""
    client = served.client()
    with client.websocket_connect(socket_of(client), headers=BROWSING) as ws:
        for _ in range(8):
            ws.receive_json()
        assert served.heard(0.05) is None


def test_the_end_of_the_connection_is_no_end_of_the_watch(served: Served) -> None:
    with served.answering() as (_, ws):
        assert served.heard() is not None
        ws.send_bytes(b"\xff")
    assert served.heard(0.1) is None


def test_a_page_that_closes_ends_the_watch(served: Served) -> None:
    with served.answering() as (client, _):
        assert served.heard() is not None
    assert client.post("/api/watch-end/page").status_code == 204
    command = served.heard()
    assert command is not None and command.action is OperatorAction.WATCH_END


def test_a_page_that_closes_beside_an_open_one_ends_nothing(served: Served) -> None:
    with served.answering("other") as (client, _):
        assert served.heard() is not None
        assert client.post("/api/watch-end/page").status_code == 204
    assert served.heard(0.1) is None


def test_a_page_of_another_machine_neither_watches_nor_ends_the_watch(served: Served) -> None:
    with served.answering(peer="192.0.2.7") as (client, ws):
        ws.receive_json()
    assert client.post("/api/watch-end/page").status_code == 403
    assert client.post("/api/watch-end/page", headers={"origin": "http://evil.example"}).status_code == 403
    assert served.heard(0.1) is None


def test_heartbeats_are_no_buttons(served: Served) -> None:
    for name in ("watch", "watch_end"):
        assert served.client().post(f"/api/operator/{name}").status_code == 404
    assert page_client(Console(PROFILE, 1)).post("/api/watch-end/page").status_code == 409


def test_a_missing_controller_ends_no_connection(served: Served) -> None:
    served.operator.close()
    with served.answering() as (_, ws):
        for _ in range(4):
            ws.receive_json()


def test_a_profile_without_a_limit_sends_no_heartbeat(served: Served) -> None:
    timeouts = msgspec.structs.replace(PROFILE.timeouts, operator_link_ms=0)
    served.console = Console(
        msgspec.structs.replace(PROFILE, timeouts=timeouts), 1, served.console.operator, clock=served.clock
    )
    with served.answering() as (_, ws):
        for _ in range(4):
            ws.receive_json()
    assert served.heard(0.05) is None


@pytest.mark.parametrize(
    ("link", "words"), [(LinkWatch.OFF, "not watched"), (LinkWatch.WATCHED, "watched"), (LinkWatch.LOST, "lost")]
)
def test_the_page_tells_whether_the_link_is_watched(link: LinkWatch, words: str) -> None:
    crane_state = CraneState(PROFILE)
    crane_state.on_report(encode(at((0.1,) * 5, 3, operator_link=link)), 0)
    assert crane_state.state(0)["operator_link"] == words
