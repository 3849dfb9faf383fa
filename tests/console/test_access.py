"""Roles, tokens, the control lease and the audit log, attacked: who may command, and who is refused."""

from __future__ import annotations

import errno
import json
import os
import socket
import string
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from starlette.datastructures import Headers
from starlette.testclient import TestClient
from starlette.websockets import WebSocketDisconnect

from can_dbc.messages.crane import OperatorAction
from can_dbc.messages.datagrams import decode
from can_dbc.messages.mission import MissionAction
from console.__main__ import serve
from console.access import FAILURES_NS, LEASE_NS, MAX_FAILURES, MAX_PAGES, SESSION_NS, ControlLease
from console.access_guards import MAX_REFUSED, TOKEN_HEADER, AuditLog, session_of
from console.accounts import Accounts, Role, account_line, read_accounts, with_account
from console.console import Console
from console.exposure import StartError
from console.server import create_app
from machine.loading.profile_file import load_profile, profile_hash
from runtime.errors import ConfigError
from tests.codes import coded
from tests.console.page_client import BROWSING, HERE, WS, Clock, page_client, socket_of, visitor
from tests.operator_end import OperatorEnd, udp_end

PROFILE = load_profile("aoro_fc8")
HASH = profile_hash(PROFILE)
MS = 1_000_000
PASSWORD = "hemlock and spruce"
TRIES = [
    *("/api/operator/arm", "/api/operator/reset", "/api/mission/auto", "/api/mission/next-step"),
    *("/api/mission/abort", "/api/mission/single-step", "/api/mission/run-through"),
]
"""What needs the lease."""


@dataclass
class Stage:
    """A console with both receivers of its commands."""

    console: Console
    operator: socket.socket
    planner: socket.socket
    clock: Clock

    def nothing_sent(self) -> bool:
        for link in (self.operator, self.planner):
            link.settimeout(0.02)
            try:
                link.recv(2000)
            except TimeoutError:
                continue
            return False
        return True


@pytest.fixture
def stage(tmp_path: Path) -> Iterator[Stage]:
    with OperatorEnd(tmp_path / "operator") as operator, udp_end(None) as planner:
        clock = Clock()
        log = AuditLog(tmp_path / "audit.jsonl", clock)
        places = {"planner": planner.getsockname(), "missions": tmp_path / "missions"}
        console = Console(PROFILE, HASH, tmp_path / "operator", audit=log, clock=clock, **places)
        yield Stage(console, operator, planner, clock)
        log.close()


@pytest.fixture
def page(stage: Stage) -> TestClient:
    """A page that does not lead."""
    return page_client(stage.console)


@pytest.fixture(scope="module")
def accounts() -> Accounts:
    lines = (account_line(role.name.lower(), role, PASSWORD).split() for role in Role)
    return Accounts({name: (Role[role.upper()], known) for name, role, known in lines})


@pytest.fixture
def guarded(stage: Stage, accounts: Accounts) -> Stage:
    """The same console for persons who sign in."""
    was = stage.console
    ends = {"planner": was.planner, "audit": was.audit, "clock": stage.clock}
    stage.console = Console(PROFILE, HASH, was.operator, accounts=accounts, **ends)
    return stage


def signed_in(console: Console, name: str, peer: str = "192.0.2.7") -> TestClient:
    """The page of a person on another machine."""
    client = visitor(console, peer)
    assert client.post("/api/sign-in", json={"name": name, "password": PASSWORD}).status_code == 204
    client.headers[TOKEN_HEADER] = client.post("/api/session").json()["token"]
    return client


# -- the lease, pure


def test_a_lease_ends_with_the_signs_of_life_of_its_page() -> None:
    lease = ControlLease()
    assert lease.take(1, 0, 0) and lease.holder(LEASE_NS - 1) == 1
    lease.renew(1, LEASE_NS - 1)
    assert lease.holder(2 * LEASE_NS - 2) == 1 and lease.holder(2 * LEASE_NS - 1) == 0
    lease.renew(1, 2 * LEASE_NS)
    assert lease.holder(2 * LEASE_NS) == 0, "nothing revives it"


def test_only_who_names_the_holder_takes_over() -> None:
    lease = ControlLease()
    lease.take(1, 0, 0)
    assert not lease.take(2, 0, 1) and not lease.take(2, 3, 1) and lease.holder(1) == 1
    lease.renew(2, LEASE_NS - 1)
    lease.give_back(2, 2)
    assert lease.holder(LEASE_NS - 1) == 1, "another page neither keeps nor ends it"
    assert lease.take(2, 1, 2) and lease.holder(2) == 2 and not lease.take(1, 0, 3)
    lease.give_back(2, 3)
    assert lease.holder(3) == 0


# -- commands on this machine


@pytest.mark.parametrize("path", TRIES)
def test_what_moves_the_machine_needs_the_lease(stage: Stage, path: str) -> None:
    page = page_client(stage.console)
    refused = page.post(path)
    assert refused.status_code == 403 and stage.nothing_sent()
    assert page.post("/api/lease/take", json={"over": 0}).status_code == 204
    assert page.post(path).status_code == 204 and not stage.nothing_sent()


def test_stop_needs_nothing_while_another_has_control(stage: Stage) -> None:
    page_client(stage.console, leads=True)
    assert visitor(stage.console, "192.0.2.7").post("/api/operator/stop").status_code == 204
    assert decode(stage.operator.recv(100)).action is OperatorAction.STOP


@pytest.mark.parametrize("path", ["/api/operator/disarm", "/api/mission/pause"])
def test_what_only_stops_needs_no_lease(stage: Stage, path: str) -> None:
    page_client(stage.console, leads=True)
    assert page_client(stage.console).post(path).status_code == 204 and not stage.nothing_sent()


def test_a_lease_cannot_be_stolen(stage: Stage) -> None:
    """By asking, by guessing, by naming the wrong page, by a made-up token, or by renewing it from elsewhere."""
    holder = page_client(stage.console, leads=True)
    thief = page_client(stage.console)
    for body in ({"over": 0}, {"over": 99}, {"over": -1}):
        assert thief.post("/api/lease/take", json=body).status_code == 409
    for body in ({"over": "1"}, {"over": 1, "page": 1}, {}, [], 1, {"over": 2**70}):
        assert thief.post("/api/lease/take", json=body).status_code in (409, 422), body
    for token in ("", "1", "null", holder.headers[TOKEN_HEADER][:-1], "x" * 43):
        assert thief.post("/api/operator/arm", headers={TOKEN_HEADER: token}).status_code == 403
    thief.post("/api/lease/give-back")
    seen = {"page": 1, "holder": "this machine (page 1)", "mine": False, "may_take": True}
    with thief.websocket_connect(socket_of(thief), headers=BROWSING) as ws:
        assert ws.receive_json()["lease"] == seen
    assert thief.post("/api/operator/arm").status_code == 403 and stage.nothing_sent()
    assert holder.post("/api/operator/arm").status_code == 204


def test_a_takeover_is_explicit_and_seen_by_both(stage: Stage) -> None:
    first, second = page_client(stage.console, leads=True), page_client(stage.console)
    assert second.post("/api/lease/take", json={"over": 1}).status_code == 204
    seen = first.get("/api/state").json()["lease"]
    assert (seen["page"], seen["holder"], seen["mine"]) == (2, "this machine (page 2)", False)
    assert second.get("/api/state").json()["lease"]["mine"] is True
    assert first.post("/api/operator/arm").status_code == 403 and stage.nothing_sent()


def test_the_lease_ends_when_the_page_is_gone_and_lives_while_it_answers(stage: Stage) -> None:
    page = page_client(stage.console, leads=True)
    with page.websocket_connect(socket_of(page), headers=BROWSING) as ws:
        for _ in range(4):
            stage.clock.now_ns += LEASE_NS // 2
            while (sent_ms := ws.receive_json()["sent_ms"]) * MS < stage.clock.now_ns:
                pass
            ws.send_text(f"abc {sent_ms}")
            while stage.console.access.lease._heard_ns < stage.clock.now_ns:
                pass
        assert page.get("/api/state").json()["lease"]["mine"]
        ws.send_text(f"abc {sent_ms - 5000}")
    stage.clock.now_ns += LEASE_NS
    assert page.get("/api/state").json()["lease"]["page"] == 0
    assert page.post("/api/mission/auto").status_code == 403


def test_an_answer_that_waited_in_a_slow_network_keeps_no_lease(stage: Stage) -> None:
    page = page_client(stage.console, leads=True)
    stage.clock.now_ns += LEASE_NS - 1
    access = stage.console.access
    known = access.page(page.headers[TOKEN_HEADER], next(iter(access._sessions)))
    assert known is not None
    stage.console.watch(f"abc {(stage.clock.now_ns - LEASE_NS) // MS}", known)
    stage.clock.now_ns += 1
    assert page.get("/api/state").json()["lease"]["page"] == 0


def test_a_duplicated_tab_is_a_page_of_its_own(stage: Stage) -> None:
    page = page_client(stage.console)
    token = page.headers[TOKEN_HEADER]
    assert page.post("/api/session").json()["token"] == token, "a page that is loaded again keeps its token"
    with page.websocket_connect(socket_of(page), headers=BROWSING) as ws:
        ws.receive_json()
        assert page.post("/api/session").json()["token"] != token


def test_memory_is_bounded_and_the_holder_is_kept(stage: Stage) -> None:
    holder = page_client(stage.console, leads=True)
    fresh = page_client(stage.console)
    for _ in range(MAX_PAGES + 10):
        fresh.post("/api/session")
    assert len(stage.console.access._pages) <= MAX_PAGES
    assert holder.post("/api/operator/arm").status_code == 204


# -- attacks from this machine


def test_without_a_session_nothing_moves_but_stop_works(stage: Stage) -> None:
    """A process of this machine without the console's token: it asks for all that a page asks for."""
    page_client(stage.console)
    thief = visitor(stage.console)
    for token in ("", "x", stage.console.access.token[:-1], stage.console.access.token + "=", "\u00e9"):
        assert thief.get("/", params={"token": token}).url.path == "/sign-in"
        assert thief.post("/api/sign-in", json={"token": token}).status_code == 403
    for body in (b"", b"{}", b"[]", b'{"token": 1}', b'{"name": "a", "password": "b"}'):
        assert thief.post("/api/sign-in", content=body).status_code == 422
    assert not thief.cookies and thief.post("/api/session").json()["token"] == ""
    for page in ("", "x" * 43):
        for path in (*TRIES, "/api/operator/disarm", "/api/mission/pause", "/api/shift/begin", "/api/plan/check"):
            assert thief.post(path, headers={TOKEN_HEADER: page, "origin": HERE}).status_code == 403, path
        assert thief.post("/api/lease/take", json={"over": 0}, headers={TOKEN_HEADER: page}).status_code == 403
    with thief.websocket_connect(WS, headers=BROWSING) as ws:
        state = ws.receive_json()
        assert state["role"] == "viewer" and not (state["may_command"] or state["may_order"])
    assert stage.nothing_sent()
    assert thief.post("/api/operator/stop").status_code == 204 and not stage.nothing_sent()


def test_the_printed_address_opens_a_session_that_scripts_and_other_sites_cannot_use(stage: Stage) -> None:
    person = visitor(stage.console)
    answer = person.get("/plan", params={"token": stage.console.access.token}, follow_redirects=False)
    assert (answer.status_code, answer.headers["location"]) == (303, "/plan"), "the token leaves the address"
    kept = answer.headers["set-cookie"].lower()
    assert "httponly" in kept and "samesite=strict" in kept and stage.console.access.token.lower() not in kept
    assert person.post("/api/operator/arm").status_code == 403, "a cookie alone is no page"
    token = person.post("/api/session").json()["token"]
    thief = visitor(stage.console)
    assert thief.post("/api/lease/take", json={"over": 0}, headers={TOKEN_HEADER: token}).status_code == 403
    with pytest.raises(WebSocketDisconnect), thief.websocket_connect(f"{WS}?page={token}", headers=BROWSING):
        pass
    answer = person.get("//evil.example/", params={"token": stage.console.access.token}, follow_redirects=False)
    assert answer.headers.get("location", "/").startswith("//") is False


def test_the_printed_address_may_be_opened_again(stage: Stage) -> None:
    page = page_client(stage.console, leads=True)
    again = page.get("/plan", params={"token": stage.console.access.token}, follow_redirects=False)
    assert again.status_code == 303 and "set-cookie" not in again.headers
    assert page.post("/api/operator/arm").status_code == 204, "the page keeps its control"


def test_a_session_of_the_printed_address_ends_with_the_shift(stage: Stage) -> None:
    page = page_client(stage.console, leads=True)
    stage.clock.now_ns += SESSION_NS
    assert page.post("/api/operator/arm").status_code == 403 and stage.nothing_sent()


def test_consoles_share_no_cookie(stage: Stage) -> None:
    page, other = page_client(stage.console), Console(PROFILE, HASH)
    port = {"host": "127.0.0.1:8472"}
    assert page.get(f"/?token={stage.console.access.token}", headers=port, follow_redirects=False).status_code == 303
    assert len(page.cookies) == 2 and page_client(other).get("/api/state").json()["role"] == "technician"


def test_a_cookie_of_another_page_hides_no_session() -> None:
    """Browsers send all cookies of a host, and JSON is an ordinary value of one."""
    cookies = 'prefs={"theme":"dark"}; timberhand-session-8471=abc; a b=@'
    assert session_of(Headers({"host": "127.0.0.1:8471", "cookie": cookies})) == "abc"


def test_a_websocket_without_origin_only_shows(stage: Stage) -> None:
    page = page_client(stage.console, leads=True)
    with page.websocket_connect(socket_of(page)) as ws:
        state = ws.receive_json()
        assert not (state["may_command"] or state["lease"]["mine"])
        ws.send_text(f"abc {state['sent_ms']}")
        for _ in range(3):
            ws.receive_json()
    assert stage.nothing_sent()


# -- attacks from a browser


def test_a_websocket_is_not_hijacked(stage: Stage) -> None:
    page = page_client(stage.console, leads=True)
    for headers in (
        {"origin": "http://evil.example"},
        {"origin": "http://127.0.0.1:9999"},
        {"origin": "null"},
        {"host": "evil.example:8471"},
    ):
        with pytest.raises(WebSocketDisconnect), page.websocket_connect(socket_of(page), headers=headers):
            pass
    for token in ("", "wrong"):
        with pytest.raises(WebSocketDisconnect), page.websocket_connect(f"{WS}?page={token or 'x'}", headers=BROWSING):
            pass
    with page.websocket_connect(WS) as ws:  # without a token it shows, and its answers are nobody's
        state = ws.receive_json()
        assert not (state["may_command"] or state["lease"]["mine"] or state["lease"]["may_take"])
        ws.send_text(f"abc {state['sent_ms']}")
        for _ in range(3):
            ws.receive_json()
    assert stage.nothing_sent()


@pytest.mark.parametrize(
    "path",
    [
        *TRIES,
        "/api/lease/take",
        "/api/lease/give-back",
        "/api/plan/upload/a.geojson",
        "/api/plan/missions/a.geojson",
        "/api/watch-end/abc",
        "/api/sign-out",
    ],
)
def test_a_forged_request_is_refused(stage: Stage, path: str) -> None:
    """CSRF by a form or fetch of another site, without Origin by something older, and DNS rebinding."""
    page = page_client(stage.console, leads=True)
    token = page.headers[TOKEN_HEADER]
    assert page.post(path, headers={"origin": "http://evil.example"}).status_code == 403
    assert page.post(path, headers={"host": "evil.example"}).status_code == 403
    del page.headers[TOKEN_HEADER]
    without = page.post(path, headers={"origin": HERE, "content-type": "text/plain"})
    assert without.status_code == 403
    assert page.get(path, headers={TOKEN_HEADER: token}).status_code in (404, 405, 422)
    assert stage.nothing_sent()
    assert page.get("/api/state", headers={TOKEN_HEADER: token}).json()["lease"]["mine"], "and nobody lost control"


# -- persons


def test_nothing_is_shown_before_signing_in_but_stop_works(guarded: Stage) -> None:
    stranger = visitor(guarded.console)
    for path in ("/api/state", "/api/machine", "/api/timeline", "/api/plan/missions"):
        assert stranger.get(path).status_code == 401, path
    assert stranger.post("/api/session").status_code == 401
    with pytest.raises(WebSocketDisconnect), stranger.websocket_connect(WS):
        pass
    assert stranger.get("/sign-in").status_code == stranger.get("/static/sign-in.js").status_code == 200
    assert guarded.nothing_sent()
    assert stranger.post("/api/operator/stop").status_code == 204 and not guarded.nothing_sent()


def test_each_role_may_what_it_may(guarded: Stage) -> None:
    viewer, operator = signed_in(guarded.console, "viewer"), signed_in(guarded.console, "operator")
    state = viewer.get("/api/state").json()
    assert state["role"] == "viewer" and state["may_stop"] is True
    assert state["may_command"] is state["may_order"] is False
    assert viewer.post("/api/lease/take", json={"over": 0}).status_code == 409
    for path in ("/api/operator/disarm", "/api/mission/pause", "/api/plan/check", *TRIES):
        assert viewer.post(path).status_code == 403, path
    assert guarded.nothing_sent()
    assert operator.post("/api/lease/take", json={"over": 0}).status_code == 204
    assert operator.post("/api/operator/arm").status_code == 204
    assert operator.get("/api/state").json()["lease"]["holder"] == "operator (page 2)"


def test_a_token_is_worth_nothing_without_its_session(guarded: Stage) -> None:
    operator = signed_in(guarded.console, "operator")
    operator.post("/api/lease/take", json={"over": 0})
    token = operator.headers[TOKEN_HEADER]
    thief = signed_in(guarded.console, "viewer")
    assert thief.post("/api/operator/arm", headers={TOKEN_HEADER: token}).status_code == 403
    again = signed_in(guarded.console, "operator")
    assert again.post("/api/operator/arm", headers={TOKEN_HEADER: token}).status_code == 403, "another session of his"
    with pytest.raises(WebSocketDisconnect), thief.websocket_connect(f"{WS}?page={token}", headers=BROWSING):
        pass
    assert guarded.nothing_sent()


def test_a_session_ends_by_signing_out_and_with_the_shift(guarded: Stage) -> None:
    operator = signed_in(guarded.console, "operator")
    operator.post("/api/lease/take", json={"over": 0})
    with operator.websocket_connect(socket_of(operator), headers=BROWSING) as ws:
        ws.receive_json()
        assert operator.post("/api/sign-out").status_code == 204
        with pytest.raises(WebSocketDisconnect):
            while True:
                ws.receive_json()
    assert operator.get("/api/state").status_code == 401
    other = signed_in(guarded.console, "operator")
    assert other.get("/api/state").json()["lease"]["page"] == 0, "and his lease with it"
    guarded.clock.now_ns += SESSION_NS
    assert other.get("/api/state").status_code == 401


def test_a_websocket_without_a_token_ends_with_its_session_too(guarded: Stage) -> None:
    viewer = signed_in(guarded.console, "viewer")
    with viewer.websocket_connect(WS, headers=BROWSING) as ws:
        ws.receive_json()
        assert viewer.post("/api/sign-out").status_code == 204
        with pytest.raises(WebSocketDisconnect):
            for _ in range(100):
                ws.receive_json()


def test_passwords_are_not_guessed(guarded: Stage) -> None:
    stranger = visitor(guarded.console, "192.0.2.9")
    for name in ("operator", "nobody", "operator", "", "x" * 2000)[:MAX_FAILURES]:
        assert stranger.post("/api/sign-in", json={"name": name, "password": "wrong"}).status_code in (403, 422)
    stranger.post("/api/sign-in", json={"name": "operator", "password": "y" * 500})
    right = {"name": "operator", "password": PASSWORD}
    assert stranger.post("/api/sign-in", json=right).status_code == 429
    guarded.clock.now_ns += FAILURES_NS
    answer = stranger.post("/api/sign-in", json=right, headers={"origin": HERE})
    assert answer.status_code == 204
    cookie = answer.headers["set-cookie"].lower()
    assert "httponly" in cookie and "samesite=strict" in cookie and "secure" not in cookie
    assert stranger.post("/api/sign-in", json=right, headers={"origin": "http://evil.example"}).status_code == 403


def test_over_tls_the_cookie_is_secure(guarded: Stage) -> None:
    guarded.console.tls = True
    client = TestClient(create_app(guarded.console), base_url="https://127.0.0.1:8471", client=("192.0.2.7", 1))
    answer = client.post("/api/sign-in", json={"name": "operator", "password": PASSWORD})
    assert "secure" in answer.headers["set-cookie"].lower()


# -- the file of accounts


def test_a_password_is_kept_as_its_hash_only(tmp_path: Path) -> None:
    path = tmp_path / "passwords"
    text = with_account("# accounts\n", account_line("anna", Role.VIEWER, PASSWORD))
    text = with_account(
        with_account(text, account_line("bo", Role.TECHNICIAN, "another one ")),
        account_line("anna", Role.OPERATOR, PASSWORD),
    )
    path.write_text(text)
    path.chmod(0o600)
    found = read_accounts(path)
    assert PASSWORD not in text and text.startswith("# accounts\n") and sorted(found.names) == ["anna", "bo"]
    person = found.check("anna", PASSWORD)
    assert person is not None and person.role is Role.OPERATOR
    assert found.check("anna", PASSWORD + "x") is None and found.check("carl", PASSWORD) is None


@pytest.mark.parametrize(
    ("text", "mode", "code"),
    [
        ("", 0o600, "accounts.empty"),
        ("anna operator\n", 0o600, "accounts.line"),
        ("anna operator secret\n", 0o600, "accounts.line"),
        ("anna boss $argon2id$v=19$m=8,t=1,p=1$YQ$YQ\n", 0o600, "accounts.line"),
        ("x\n", 0o644, "accounts.open-file"),
        ("x\n", 0o620, "accounts.open-file"),
        (b"\xff", 0o600, "accounts.unreadable"),
    ],
)
def test_a_wrong_file_of_accounts_is_refused(tmp_path: Path, text: str | bytes, mode: int, code: str) -> None:
    path = tmp_path / "passwords"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    path.chmod(mode)
    with pytest.raises(ConfigError, check=coded(code)):
        read_accounts(path)


@pytest.mark.parametrize(
    ("name", "password"), [("a b", PASSWORD), ("", PASSWORD), ("anna", "short"), ("anna", "x" * 300)]
)
def test_a_bad_name_or_password_is_refused(name: str, password: str) -> None:
    with pytest.raises(ConfigError):
        account_line(name, Role.VIEWER, password)


# -- the audit log


def test_the_audit_log_has_who_what_when_and_the_result(guarded: Stage) -> None:
    operator = signed_in(guarded.console, "operator")
    operator.post("/api/operator/arm")
    operator.post("/api/lease/take", json={"over": 0})
    operator.post("/api/operator/arm", headers={"origin": "http://evil.example"})
    operator.post("/api/operator/arm")
    operator.post("/api/sign-in", json={"name": "carl", "password": "wrong"})
    guarded.console.audit.close()
    lines = [json.loads(line) for line in guarded.console.audit.path.read_text().splitlines()]
    told = [(e["who"], e["page"], e["what"], e["result"], bool(e.get("why"))) for e in lines]
    assert told == [
        ("operator", 0, "POST /api/sign-in", 204, False),
        ("operator", 1, "POST /api/operator/arm", 403, True),
        ("operator", 1, "POST /api/lease/take", 204, False),
        ("", 0, "POST /api/operator/arm", 403, True),
        ("operator", 1, "POST /api/operator/arm", 204, False),
        ("carl", 1, "POST /api/sign-in", 403, True),
    ]
    assert all(e["at"].endswith("+00:00") and e["peer"] == "192.0.2.7" for e in lines)
    assert PASSWORD not in guarded.console.audit.path.read_text()


def test_the_audit_log_is_only_appended_to_and_floods_are_counted(tmp_path: Path) -> None:
    path, clock = tmp_path / "audit.jsonl", Clock()
    for _ in range(2):
        log = AuditLog(path, clock)
        for k in range(MAX_REFUSED + 7):
            log.record(refused=True, what=str(k))
        clock.now_ns += 10**9
        log.record(refused=False, what="last")
        log.close()
    lines = [json.loads(line) for line in path.read_text().splitlines()]
    left_out = [line.get("refusals_left_out") for line in lines if line["what"] == "last"]
    assert len(lines) == 2 * (MAX_REFUSED + 1) and left_out == [7, 7]
    assert path.stat().st_mode & 0o777 == 0o600


def test_a_line_of_which_the_disk_took_a_part_is_ended_before_the_next(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A disk may be full in the middle of a line, and have room again later."""
    room, write = [10, 0, 1000, 1000], os.write

    def filling(file: int, data: bytes) -> int:
        free = room.pop(0) if room else len(data)
        if not free:
            raise OSError(errno.ENOSPC, "No space left on device")
        return write(file, data[:free])

    monkeypatch.setattr("console.access_guards.os.write", filling)
    log = AuditLog(tmp_path / "audit.jsonl", Clock())
    for what in ("torn", "whole", "last"):
        log.record(refused=False, what=what)
    log.close()
    torn, *whole = log.path.read_text().splitlines()
    assert len(torn) == 10 and [json.loads(line)["what"] for line in whole] == ["whole", "last"]
    assert log.failed == ""


def test_a_full_disk_is_told_on_the_page(stage: Stage) -> None:
    log = AuditLog(Path("/dev/full"), stage.clock)
    stage.console.audit = log
    page_client(stage.console, leads=True)
    log.close()
    assert "/dev/full" in page_client(stage.console).get("/api/state").json()["audit"]


# -- anything at all


ANY_JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=20),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=10), inner, max_size=3),
    max_leaves=8,
)
PATHS = [
    "/api/lease/take",
    "/api/sign-in",
    "/api/plan/check",
    "/api/plan/import",
    "/api/plan/export/kml",
    "/api/plan/missions/m.geojson",
    "/api/plan/upload/m.geojson",
    "/api/session",
]


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.sampled_from(PATHS), st.binary(max_size=200) | ANY_JSON.map(lambda v: json.dumps(v).encode()))
def test_any_body_is_answered_and_commands_nothing(stage: Stage, page: TestClient, path: str, body: bytes) -> None:
    answer = page.post(path, content=body)
    assert answer.status_code < 500, (path, body, answer.text)
    assert stage.nothing_sent()


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.text(max_size=60), st.text(alphabet=string.ascii_letters + "_-.~ä%0", max_size=20))
def test_any_token_and_any_name_command_nothing(page: TestClient, token: str, name: str) -> None:
    printable = "".join(filter(str.isprintable, token)).encode("ascii", "ignore").decode()
    for path in (f"/api/operator/{name or 'x'}", f"/api/mission/{name or 'x'}"):
        status = page.post(path, headers={TOKEN_HEADER: printable}).status_code
        assert status < 500 and (status >= 400 or path == "/api/operator/stop")


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.lists(st.text(max_size=40) | st.binary(max_size=40), max_size=5))
def test_any_words_on_the_websocket_command_nothing(stage: Stage, page: TestClient, words: list[str | bytes]) -> None:
    with page.websocket_connect(socket_of(page), headers=BROWSING) as ws:
        for word in words:
            ws.send_text(word) if isinstance(word, str) else ws.send_bytes(word)
        assert ws.receive_json()["role"] == "technician"
    assert stage.nothing_sent()


def test_every_action_is_classified() -> None:
    """A new mission command needs the lease unless it is said to only stop."""
    assert {f"/api/mission/{a.name.lower().replace('_', '-')}" for a in MissionAction} - set(TRIES) == {
        "/api/mission/pause"
    }


def test_an_empty_key_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / "key").write_text("\n")
    with pytest.raises(StartError, match="too short", check=coded("console.key-file")):
        serve(profile="palms_471", port=0, report_port=0, key_file=tmp_path / "key")
