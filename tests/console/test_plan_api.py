"""The requests of the plan page: who may send them, what they refuse, and what they answer."""

from __future__ import annotations

import hashlib
import json
import os
import threading
from pathlib import Path

import msgspec
import pytest
from starlette.testclient import TestClient

from autonomy.missions.export import FORMATS
from autonomy.missions.folder import MissionFolder
from autonomy.missions.mission_file import load_mission
from autonomy.missions.model import MissionError
from can_dbc.messages.mission import decode_mission_upload, encode_mission
from console.console import Console
from console.plan_api import MAX_BODY_BYTES
from machine.loading.profile_file import load_profile, profile_hash
from tests.autonomy.mission_checks import EXAMPLES
from tests.can_dbc.example_mission_report import MISSION_REPORT
from tests.console.page_client import page_client
from tests.operator_end import udp_end

PROFILE = load_profile("aoro_fc8")
PAPER_B = load_mission(EXAMPLES / "paper_b.geojson").mission
POINT = {"latitude_deg": 63.0, "longitude_deg": 19.0}
POSTS = ["check", "import", "export/kml", "missions/m.geojson", "upload/m.geojson"]


def document(**changes: object) -> dict:
    """Paper B's mission as the page sends it."""
    return msgspec.json.decode(msgspec.json.encode(PAPER_B)) | changes


def client_of(folder: Path | None = None, peer: str = "127.0.0.1", profile: str = "aoro_fc8", **more) -> TestClient:
    console = Console(load_profile(profile), profile_hash(PROFILE), missions=folder, **more)
    return page_client(console, peer, leads=peer == "127.0.0.1")


@pytest.fixture
def client(tmp_path: Path) -> TestClient:
    return client_of(tmp_path / "missions")


def test_the_plan_page_and_every_file_it_names_are_served_from_here(client: TestClient) -> None:
    page = client.get("/plan")
    assert page.status_code == 200 and 'id="stop"' in page.text
    assert not any(word in page.text for word in ("http://", "https://", "<style", "style=", "onclick", "<script>"))
    named = [word.split('"')[0] for part in ('src="', 'href="') for word in page.text.split(part)[1:]]
    assert len(named) > 5
    for name in named:
        assert client.get(f"/{name.removeprefix('./')}").status_code == 200, name


def test_a_mission_is_checked_as_by_plan_check(client: TestClient) -> None:
    told = client.post("/api/plan/check", json=document()).json()
    assert told["errors"] == told["warnings"] == [] and told["estimate"]["logs"] == 24
    assert told["wood"]["logs"] == 12 and told["wood"]["volume_m3"] > 0
    moved = document()
    moved["waypoints"][2]["latitude_deg"] += 0.01
    (error,) = client.post("/api/plan/check", json=moved).json()["errors"]
    assert (error["code"], error["part"]) == ("mission.waypoint-outside-fence", ["waypoint", 2])
    bare = client.post("/api/plan/check", json=document(fences=[])).json()
    assert [w["code"] for w in bare["warnings"]] == ["mission.no-fence"]


def test_exchanged_axes_are_named(client: TestClient) -> None:
    turned = [{"latitude_deg": p.longitude_deg, "longitude_deg": p.latitude_deg} for p in PAPER_B.waypoints]
    told = client.post("/api/plan/check", json={"waypoints": turned}).json()
    assert told["errors"][0]["code"] == "mission.swapped-axes"


@pytest.mark.parametrize(
    ("body", "name"),
    [
        ({"waypoint": []}, "waypoint"),
        ({"waypoints": [POINT | {"altitude": 3}]}, "altitude"),
        ({"options": {"laps": "2"}}, "laps"),
        ({"schema": 2}, "schema"),
        ([], ""),
        ({"fences": {}}, "fences"),
        ({"waypoints": [{"latitude_deg": 1}]}, "longitude_deg"),
    ],
)
@pytest.mark.parametrize("path", ["check", "export/kml", "missions/m.geojson"])
def test_what_is_not_the_schema_is_refused_in_one_sentence(client: TestClient, path: str, body, name: str) -> None:
    answer = client.post(f"/api/plan/{path}", json=body)
    assert answer.status_code == 422 and answer.json()["code"] == "plan.document"
    assert name in answer.json()["sentence"] and answer.json()["sentence"].count("\n") == 0


@pytest.mark.parametrize("body", [b"", b"{", b"\xff", b"[" * 100_000, b'{"name": NaN}', b"null"])
def test_what_is_not_json_is_refused(client: TestClient, body: bytes) -> None:
    assert client.post("/api/plan/check", content=body).status_code == 422


@pytest.mark.parametrize("path", POSTS)
def test_only_this_machine_and_this_page_may_post(path: str, tmp_path: Path) -> None:
    body = json.dumps(document())
    assert client_of(tmp_path / "a", "192.0.2.7").post(f"/api/plan/{path}", content=body).status_code == 403
    for origin in ("http://evil.example", "null"):
        answer = client_of(tmp_path / "a").post(f"/api/plan/{path}", content=body, headers={"origin": origin})
        assert answer.status_code == 403
    rebound = client_of(tmp_path / "a").post(f"/api/plan/{path}", content=body, headers={"host": "evil.example"})
    assert rebound.status_code == 403 and not (tmp_path / "a").exists()
    assert client_of(tmp_path / "a").get(f"/api/plan/{path}").status_code in (404, 405, 422)


@pytest.mark.parametrize("path", POSTS)
def test_a_large_body_is_refused_before_it_is_read(client: TestClient, path: str) -> None:
    headers = {"content-length": str(MAX_BODY_BYTES + 1)}
    assert client.post(f"/api/plan/{path}", content=b"{}", headers=headers).status_code == 413

    def endless():
        for _ in range((MAX_BODY_BYTES >> 20) + 2):
            yield b" " * (1 << 20)

    assert client.post(f"/api/plan/{path}", content=endless()).status_code == 413


def test_what_is_exported_is_imported_again(client: TestClient) -> None:
    for kind in FORMATS:
        told = client.post(f"/api/plan/export/{kind}", json=document()).json()
        found = client.post("/api/plan/import?name=a", content=told["text"].encode()).json()
        assert found["mission"]["waypoints"] == document()["waypoints"], kind
        assert (found["mission"] == document()) is not bool(told["left_out"])
    harvest = client.post("/api/plan/import", content=(EXAMPLES / "harvest.hpr").read_bytes()).json()
    assert harvest["format"].endswith("hpr") and harvest["mission"]["logs"]
    empty = b'{"type": "Feature", "properties": {}, "geometry": null}'
    assert client.post("/api/plan/import", content=empty).json()["notes"]
    bad = client.post("/api/plan/import?name=x.gpx", content=b"<gpx><rte><rtept/></rte></gpx>")
    assert bad.json()["code"] == "gpx.missing-coordinate" and "x.gpx:1" in bad.json()["sentence"]
    assert client.post("/api/plan/export/dxf", json=document()).json()["code"] == "mission.export-format"


@pytest.mark.parametrize("name", ["stand 12.geojson", "Süd-Wald Ødegård 12.geojson"])
def test_missions_are_saved_in_the_folder_alone(client: TestClient, name: str, tmp_path: Path) -> None:
    folder = tmp_path / "missions"
    assert client.get("/api/plan/missions").json() == []
    assert client.post(f"/api/plan/missions/{name}", json=document()).status_code == 200
    assert client.get("/api/plan/missions").json() == [name]
    assert client.get(f"/api/plan/missions/{name}").json()["mission"] == document()
    again = client.post(f"/api/plan/missions/{name}", json=document(name="b"))
    assert again.json()["code"] == "missions.exists"
    assert client.post(f"/api/plan/missions/{name}?replace=1", json=document(name="b")).status_code == 200
    assert load_mission(folder / name).mission.name == "b"
    assert [file.name for file in folder.iterdir()] == [name]


def test_two_requests_that_save_the_same_mission_at_once_do_not_mix(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, link = MissionFolder(tmp_path), os.link

    def overtaken(draft: Path, path: Path) -> None:
        monkeypatch.setattr(os, "link", link)
        folder.write("m.geojson", b"the other's")
        link(draft, path)

    monkeypatch.setattr(os, "link", overtaken)
    with pytest.raises(MissionError) as refused:
        folder.write("m.geojson", b"the first's")
    assert refused.value.code == "missions.exists"
    assert folder.read("m.geojson") == b"the other's" and len(os.listdir(tmp_path)) == 1


@pytest.mark.parametrize(
    "name",
    [
        "..%2f..%2fetc.geojson",
        "%2e%2e%2fa.geojson",
        "a%2fb.geojson",
        "a%5cb.geojson",
        ".a.geojson",
        "a.txt",
        "a%00.geojson",
        "%2fetc%2fpasswd",
        "-a.geojson",
        "a.geojson%0a",
    ],
)
def test_no_name_leads_out_of_the_folder(client: TestClient, name: str, tmp_path: Path) -> None:
    for method in ("missions", "upload"):
        assert client.post(f"/api/plan/{method}/{name}", json=document()).status_code in (404, 409, 422)
    assert client.get(f"/api/plan/missions/{name}").status_code in (404, 422)
    assert [p for p in tmp_path.rglob("*") if p.is_file()] == []


def test_a_name_with_a_slash_is_refused_in_a_sentence(client: TestClient) -> None:
    for answer in (
        client.get("/api/plan/missions/north%2fa.geojson"),
        client.post("/api/plan/missions/north%2fa.geojson", json=document()),
    ):
        assert answer.json()["code"] == "missions.name" and "north/a.geojson" in answer.json()["sentence"]


def test_links_in_the_folder_are_not_followed(client: TestClient, tmp_path: Path) -> None:
    (tmp_path / "missions").mkdir()
    outside = tmp_path / "outside.geojson"
    outside.write_bytes((EXAMPLES / "paper_b.geojson").read_bytes())
    os.symlink(outside, tmp_path / "missions" / "m.geojson")
    assert client.get("/api/plan/missions").json() == []
    assert client.get("/api/plan/missions/m.geojson").json()["code"] == "missions.unreadable"
    client.post("/api/plan/missions/m.geojson?replace=1", json=document(name="new"))
    assert load_mission(outside).mission.name == PAPER_B.name, "the link is replaced, not its target"


def test_a_console_without_folder_planner_or_carrier_says_so(tmp_path: Path) -> None:
    assert client_of().post("/api/plan/missions/a.geojson", json=document()).status_code == 409
    assert client_of(tmp_path).post("/api/plan/upload/a.geojson", json=document()).status_code == 409
    standing = client_of(profile="palms_471")
    assert standing.get("/api/plan/settings").json()["site"] is None
    assert standing.post("/api/plan/check", json=document()).status_code == 409


@pytest.mark.parametrize("refusal", [("", ""), ("the machine is armed; disarm it first", "upload.armed")])
def test_a_mission_is_offered_to_the_planner(tmp_path: Path, refusal: tuple[str, str]) -> None:
    with udp_end(5) as planner:
        console = Console(PROFILE, 77, missions=tmp_path, planner=planner.getsockname(), clock=lambda: 10**12)
        offered = []

        def answer() -> None:
            upload = decode_mission_upload(planner.recv(1000))
            offered.append(upload)
            report = msgspec.structs.replace(
                MISSION_REPORT, order=upload.sequence, refusal=refusal[0], refusal_code=refusal[1]
            )
            console.crane_state.on_report(encode_mission(report, 1, 77, 10**12), 10**12)

        thread = threading.Thread(target=answer)
        thread.start()
        client = page_client(console, leads=True)
        answered = client.post("/api/plan/upload/m.geojson", json=document())
        thread.join()
        (upload,) = offered
        assert upload.digest == hashlib.sha256((tmp_path / "m.geojson").read_bytes()).digest()
        assert (answered.status_code, answered.json().get("code")) == ((409, refusal[1]) if refusal[0] else (200, None))


def test_a_mission_with_errors_is_not_offered(tmp_path: Path) -> None:
    client = client_of(tmp_path, planner=("127.0.0.1", 9))
    answer = client.post("/api/plan/upload/m.geojson", json=document(waypoints=[]))
    assert answer.json()["code"] == "mission.no-waypoints" and not list(tmp_path.iterdir())
