"""The true logs: only a console with a plant serves them, and it asks the plant for all pages together."""

from __future__ import annotations

from starlette.testclient import TestClient

from autonomy.perception.log_list import LogObservation, encode_logs
from console.console import Console
from console.server import create_app
from machine.loading.profile_file import load_profile, profile_hash
from tests.console.played_detector import detector
from tests.operator_end import udp_end

PROFILE = load_profile("palms_471")
LOG = LogObservation(2, (0.5, 3.0, -0.4), (1.0, 0.0, 0.0), 3.0, 0.2)


def client_of(truth: tuple[str, int] | None) -> TestClient:
    return TestClient(
        create_app(Console(PROFILE, profile_hash(PROFILE), truth=truth)), base_url="http://127.0.0.1:8471"
    )


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
