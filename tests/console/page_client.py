"""A client of the console that is a page of it: it has a token, and the control lease if it leads."""

from __future__ import annotations

from starlette.testclient import TestClient

from console.access_guards import TOKEN_HEADER
from console.console import Console
from console.server import create_app

HERE = "http://127.0.0.1:8471"
WS = "ws://127.0.0.1:8471/ws"


def page_client(console: Console, peer: str = "127.0.0.1", leads: bool = False, **options: object) -> TestClient:
    """A new page at ``peer``."""
    client = TestClient(create_app(console, **options), base_url=HERE, client=(peer, 40000))
    client.headers[TOKEN_HEADER] = client.post("/api/session").json()["token"]
    if leads:
        assert client.post("/api/lease/take", json={"over": 0}).status_code == 204
    return client


def socket_of(client: TestClient) -> str:
    """Address of its websocket."""
    return f"{WS}?page={client.headers[TOKEN_HEADER]}"
