"""The view of a simulated plant: answers relayed, levers only from this machine, a silent plant named."""

from __future__ import annotations

import json
import threading
from collections.abc import Iterator

import pytest
from starlette.testclient import TestClient

from console.plant_link import create_plant_app
from tests.operator_end import udp_end

ANSWERS = {"scene": {"title": "a plant"}, "view": {"time_s": 1.5}, "lever": {"ok": True}}


@pytest.fixture
def plant() -> Iterator[tuple[tuple[str, int], list[dict[str, str]]]]:
    """A stand-in for the plant's request port; it keeps the requests."""
    asked: list[dict[str, str]] = []
    port = udp_end(None)

    def answer() -> None:
        while True:
            question, sender = port.recvfrom(4096)
            request = json.loads(question)
            if request["op"] == "quit":
                return
            asked.append(request)
            refused = request.get("name") == "boom"
            reply = {"error": "no lever boom"} if refused else ANSWERS[request["op"]]
            port.sendto(json.dumps(reply).encode(), sender)

    thread = threading.Thread(target=answer)
    thread.start()
    yield port.getsockname(), asked
    port.sendto(b'{"op": "quit"}', port.getsockname())
    thread.join()
    port.close()


def test_the_page_and_the_constant_data_are_served(plant) -> None:
    with TestClient(create_plant_app(plant[0]), base_url="http://127.0.0.1") as page:
        assert 'id="scene"' in page.get("/plant").text
        assert page.get("/api/plant").json() == {"title": "a plant"}


def test_poses_are_pushed_by_the_websocket(plant) -> None:
    with (
        TestClient(create_plant_app(plant[0]), base_url="http://127.0.0.1") as page,
        page.websocket_connect("/ws/plant", headers={"host": "127.0.0.1"}) as ws,
    ):
        assert ws.receive_json() == {"time_s": 1.5}
        assert ws.receive_json() == {"time_s": 1.5}


def test_a_lever_request_returns_the_plants_refusal(plant) -> None:
    with TestClient(create_plant_app(plant[0]), base_url="http://127.0.0.1") as page:
        assert page.post("/api/plant/lever?name=slew&value=0.6").status_code == 204
        refused = page.post("/api/plant/lever?name=boom&value=0.6")
    assert plant[1][0] == {"op": "lever", "name": "slew", "value": "0.6"}
    assert (refused.status_code, refused.text) == (409, "no lever boom")


def test_levers_are_refused_to_other_machines(plant) -> None:
    with TestClient(create_plant_app(plant[0]), base_url="http://127.0.0.1", client=("192.0.2.7", 50000)) as page:
        assert page.post("/api/plant/lever?name=slew&value=0.6").status_code == 403
    assert plant[1] == []


def test_a_silent_plant_is_reported() -> None:
    with (
        udp_end(None) as deaf,
        TestClient(create_plant_app(deaf.getsockname()), base_url="http://127.0.0.1") as page,
    ):
        answer = page.get("/api/plant")
    assert answer.status_code == 504 and answer.text
