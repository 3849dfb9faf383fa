"""A client of the console that is a page of a person's session: it has a token, and the control lease if it leads."""

from __future__ import annotations

from dataclasses import dataclass

from starlette.testclient import TestClient

from console.access_guards import TOKEN_HEADER
from console.console import Console
from console.server import create_app

HERE = "http://127.0.0.1:8471"
WS = "ws://127.0.0.1:8471/ws"
BROWSING = {"origin": HERE}
"""What a browser says with a websocket of the page."""


@dataclass
class Clock:
    """A clock that a test moves."""

    now_ns: int = 10**10

    def __call__(self) -> int:
        return self.now_ns


def page_client(console: Console, peer: str = "127.0.0.1", leads: bool = False, **options: object) -> TestClient:
    """A new page at ``peer`` of whoever opened the printed address."""
    client = visitor(console, peer, **options)
    assert client.get(f"/?token={console.access.token}").status_code == 200
    client.headers[TOKEN_HEADER] = client.post("/api/session").json()["token"]
    if leads:
        assert client.post("/api/lease/take", json={"over": 0}).status_code == 204
    return client


def visitor(console: Console, peer: str = "127.0.0.1", **options: object) -> TestClient:
    """A client without a session, as any process of this machine can be."""
    return TestClient(create_app(console, **options), base_url=HERE, client=(peer, 40000))


def socket_of(client: TestClient) -> str:
    """Address of its websocket."""
    return f"{WS}?page={client.headers[TOKEN_HEADER]}"
