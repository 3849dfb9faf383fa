"""A simulated plant behind a page: answers relayed, levers only from this machine, a silent plant named; and its true
logs, which only a console with a plant serves.
"""

from __future__ import annotations

import json
import threading
from collections.abc import Iterator

import pytest
from starlette.testclient import TestClient

from autonomy.perception.log_list import LogObservation, encode_logs
from console.console import Console
from console.plant_link import create_plant_app
from machine.loading.profile_file import load_profile, profile_hash
from tests.console.page_client import visitor
from tests.console.played_detector import detector
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


def page_of(address: tuple[str, int], peer: str = "127.0.0.1") -> TestClient:
    return TestClient(create_plant_app(address), base_url="http://127.0.0.1", client=(peer, 50000))


def test_the_page_and_the_constant_data_are_served(plant) -> None:
    with page_of(plant[0]) as page:
        assert 'id="scene"' in page.get("/plant").text
        assert page.get("/api/plant").json() == {"title": "a plant"}


def test_poses_are_pushed_by_the_websocket(plant) -> None:
    with page_of(plant[0]) as page, page.websocket_connect("/ws/plant", headers={"host": "127.0.0.1"}) as ws:
        assert ws.receive_json() == {"time_s": 1.5}
        assert ws.receive_json() == {"time_s": 1.5}


def test_a_lever_request_returns_the_plants_refusal(plant) -> None:
    with page_of(plant[0]) as page:
        assert page.post("/api/plant/lever?name=slew&value=0.6").status_code == 204
        refused = page.post("/api/plant/lever?name=boom&value=0.6")
    assert plant[1][0] == {"op": "lever", "name": "slew", "value": "0.6"}
    assert (refused.status_code, refused.text) == (409, "no lever boom")


def test_levers_are_refused_to_other_machines(plant) -> None:
    with page_of(plant[0], "192.0.2.7") as page:
        assert page.post("/api/plant/lever?name=slew&value=0.6").status_code == 403
    assert plant[1] == []


def test_a_silent_plant_is_reported() -> None:
    with udp_end(None) as deaf, page_of(deaf.getsockname()) as page:
        answer = page.get("/api/plant")
    assert answer.status_code == 504 and answer.text


def test_an_answer_that_comes_late_is_not_taken_for_that_to_the_next_request(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("console.plant_link.RESPONSE_TIMEOUT_S", 0.1)
    with udp_end(5.0) as plant:

        def answer() -> None:
            _, first = plant.recvfrom(4096)
            _, second = plant.recvfrom(4096)
            for answer, sender in (({"title": "a plant"}, first), ({"error": "no lever boom"}, second)):
                plant.sendto(json.dumps(answer).encode(), sender)

        thread = threading.Thread(target=answer)
        thread.start()
        with page_of(plant.getsockname()) as page:
            assert page.get("/api/plant").status_code == 504
            monkeypatch.setattr("console.plant_link.RESPONSE_TIMEOUT_S", 5.0)
            refused = page.post("/api/plant/lever?name=boom&value=0.6")
        thread.join()
    assert (refused.status_code, refused.text) == (409, "no lever boom")


# -- the true logs

PROFILE = load_profile("palms_471")
LOG = LogObservation(2, (0.5, 3.0, -0.4), (1.0, 0.0, 0.0), 3.0, 0.2)


def client_of(truth: tuple[str, int] | None) -> TestClient:
    return visitor(Console(PROFILE, profile_hash(PROFILE), truth=truth))


def test_the_plants_logs_are_served_and_asked_for_once() -> None:
    with detector(encode_logs([LOG]), bytes) as (address, asked), client_of(address) as client:
        assert not asked, "no page shows them"
        told = [client.get("/api/true-logs").json() for _ in range(5)]
        assert told[0] == told[-1] and told[0][0]["center_m"] == [0.5, 3.0, -0.4] and told[0][0]["id"] == 2
        assert asked == [b'{"op":"logs"}']
        assert client.get("/api/machine").json()["truth"] is True


def test_a_machine_has_no_true_logs() -> None:
    with client_of(None) as client:
        assert client.get("/api/true-logs").status_code == 404
        assert client.get("/api/machine").json()["truth"] is False


def test_a_silent_plant_is_said_to_be_silent() -> None:
    with udp_end(None) as deaf, client_of(deaf.getsockname()) as client:
        answer = client.get("/api/true-logs")
        assert answer.status_code == 504
