"""The page's state of mission and vehicle, and the permissions for mission commands."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import pymap3d
import pytest
from starlette.testclient import TestClient

from can_dbc.messages.datagrams import encode
from can_dbc.messages.mission import MissionAction, MissionCommand, decode_mission_command, encode_mission
from can_dbc.messages.vehicle import VEHICLE_INPUTS, Driving
from console.console import Console
from console.mission_state import DRIVING, FIXES, INPUT_NAMES, MISSION_TIMEOUT_NS, TRAIL_M, VEHICLE_TIMEOUT_NS
from console.state import CraneState, describe_machine
from machine.geometry.map_projection import MapProjection
from machine.loading.profile_file import load_profile, profile_hash
from tests.can_dbc.example_mission_report import HERE, MISSION_REPORT
from tests.console.page_client import HERE as PAGE
from tests.console.page_client import page_client
from tests.console.vehicle_reports import HASH, PROFILE, VEHICLE
from tests.operator_end import udp_end


def crane_state(profile=PROFILE, key=None) -> CraneState:
    return CraneState(profile, key, profile_hash(profile))


def told(state: CraneState, stamp_ns: int = 10**9, code: int = HASH, key=None, now_ns: int = 10**9) -> bool:
    return state.on_report(encode_mission(MISSION_REPORT, 1, code, stamp_ns, key), now_ns)


# ---- the mission ------------------------------------------------------------------------------------------------


def test_the_mission_state_is_in_text_and_metres() -> None:
    seen = crane_state()
    assert seen.mission_state.mission() is None and seen.state(0)["mission_age_s"] is None
    assert told(seen)
    mission = seen.mission_state.mission()
    json.dumps(mission, allow_nan=False)
    assert (mission["words"], mission["on_board"], mission["targets"]) == (MISSION_REPORT.words, 3, (7,))
    assert mission["given_up"] == [{"log": 9, "reason": MISSION_REPORT.given_up[0].reason}]
    assert mission["route"][0] == (0.0, 0.0) and mission["route"][1] == pytest.approx((39.7, 0.0), abs=0.1)
    log = mission["logs"][1]
    assert (log["number"], log["given_up"]) == (9, True) and log["yaw_rad"] == pytest.approx(math.pi / 4, abs=1e-3)


def test_a_silent_planner_is_detected_and_its_age_shown() -> None:
    seen = crane_state()
    told(seen, now_ns=10**9)
    assert seen.state(10**9 + MISSION_TIMEOUT_NS - 1)["mission_alive"]
    late = seen.state(10**9 + 4 * MISSION_TIMEOUT_NS)
    assert not late["mission_alive"] and late["mission_age_s"] == 8.0


def test_only_newer_authenticated_reports_of_this_machine_are_accepted() -> None:
    seen = crane_state(key=b"right")
    assert not told(seen) and not told(seen, key=b"wrong") and not told(seen, key=b"right", code=HASH ^ 1)
    assert not told(seen, key=b"right", stamp_ns=5 * 10**9), "from the future"
    assert seen.mission_state.report_count == 0
    assert told(seen, key=b"right")
    assert not told(seen, key=b"right"), "once more"
    assert told(seen, key=b"right", stamp_ns=10**9 + 1) and seen.mission_state.report_count == 2


# ---- the vehicle ------------------------------------------------------------------------------------------------


def test_the_vehicle_state_is_in_degrees_at_its_articulation() -> None:
    seen = crane_state()
    assert seen.state(0)["vehicle"] is None
    assert seen.on_report(encode(VEHICLE), 10**9)
    shown = seen.state(10**9)["vehicle"]
    json.dumps(shown, allow_nan=False)
    assert (shown["driving"], shown["fix"], shown["satellites"]) == (DRIVING[Driving.DRIVING], FIXES[4], 18)
    assert (shown["heading_deg"], shown["articulation_deg"]) == (pytest.approx(90.0), pytest.approx(11.459, abs=1e-3))
    place, carrier = shown["place"], PROFILE.carrier
    # The vehicle heads east: the antenna is this far east of the articulation axis.
    assert place["x_m"] == pytest.approx(-carrier.antenna_main_m[0]) and place["y_m"] == pytest.approx(0.0, abs=1e-3)
    assert place["front_rad"] == pytest.approx(0.0, abs=1e-3) and place["rear_rad"] == pytest.approx(-0.2, abs=1e-3)
    assert not seen.state(10**9 + VEHICLE_TIMEOUT_NS)["vehicle"]["alive"]


def test_the_vehicle_is_drawn_with_its_heading() -> None:
    seen = crane_state()
    seen.on_report(encode(replace(VEHICLE, heading_rad=math.radians(30.0))), 1)
    place, ahead = seen.state(1)["vehicle"]["place"], PROFILE.carrier.antenna_main_m[0]
    assert place["x_m"] == pytest.approx(-ahead * 0.5, abs=2e-3)
    assert place["y_m"] == pytest.approx(-ahead * math.sqrt(0.75), abs=2e-3)


def test_an_unknown_position_keeps_the_last_one_as_outdated() -> None:
    seen = crane_state()
    seen.on_report(encode(VEHICLE), 0)
    lost = replace(VEHICLE, latitude_deg=math.nan, roll_rad=math.nan, fix=0, stale_mask=1 << 3 | 1 << 7)
    seen.on_report(encode(lost), VEHICLE_TIMEOUT_NS)
    shown = seen.state(VEHICLE_TIMEOUT_NS)["vehicle"]
    assert shown["alive"] and not shown["place_alive"] and shown["place"] is not None
    assert shown["roll_deg"] is None and shown["fix"] == FIXES[0]
    assert shown["stale"] == ["position", "articulation"]
    assert set(INPUT_NAMES) == set(VEHICLE_INPUTS)


def test_the_trail_grows_with_the_distance() -> None:
    seen = crane_state()
    for k in range(100):
        seen.on_report(encode(replace(VEHICLE, longitude_deg=HERE[1] + 1e-6 * k)), k)
    trail, step_m = seen.mission_state.trail, 0.0495
    assert len(trail) == pytest.approx(99 * step_m / (TRAIL_M + step_m / 2), abs=2)
    assert trail[-1][0] - trail[0][0] == pytest.approx(99 * step_m, abs=0.3)


def test_the_projection_agrees_with_the_ellipsoid() -> None:
    ground = MapProjection()
    ground.metres(*HERE)
    for lat, lon in ((63.6600, 19.8955), (63.6578, 19.9050), (63.6550, 19.8900)):
        east, north, _ = pymap3d.geodetic2enu(lat, lon, 0.0, *HERE, 0.0)
        assert ground.metres(lat, lon) == pytest.approx((east, north), abs=0.05)
    assert MapProjection().metres(*HERE) == (0.0, 0.0)


def test_a_stationary_machine_has_no_carrier() -> None:
    assert describe_machine(load_profile("palms_471"))["carrier"] is None
    carrier = describe_machine(PROFILE)["carrier"]
    assert describe_machine(PROFILE)["reach_m"] == pytest.approx(9.0, abs=0.1) and carrier["track_width_m"] == 2.1


# ---- the server -------------------------------------------------------------------------------------------------


@pytest.fixture
def planner():
    with udp_end(5) as s:
        yield s


def client_of(console: Console, peer: str = "127.0.0.1") -> TestClient:
    return page_client(console, peer, leads=peer == "127.0.0.1")


def console_of(planner=None, key=None) -> Console:
    return Console(PROFILE, HASH, key=key, planner=planner and planner.getsockname(), clock=lambda: 10**10)


@pytest.mark.parametrize("order", list(MissionAction))
def test_a_mission_command_sends_its_datagram(planner, order) -> None:
    client = client_of(console_of(planner, b"key"))
    for _ in range(2):
        name = order.name.lower().replace("_", "-")
        assert client.post(f"/api/mission/{name}", headers={"origin": PAGE}).status_code == 204
    first, second = (decode_mission_command(planner.recv(100), b"key") for _ in range(2))
    assert first == MissionCommand(first.sequence, HASH, 10**10, order) and second.sequence > first.sequence


def test_mission_commands_pass_the_same_guards(planner) -> None:
    console = console_of(planner)
    assert client_of(console, "192.0.2.7").post("/api/mission/pause").status_code == 403
    here = client_of(console)
    assert here.get("/api/mission/pause").status_code == 405 and here.post("/api/mission/dance").status_code == 404
    planner.settimeout(0.05)
    with pytest.raises(TimeoutError):
        planner.recv(100)
    assert here.get("/api/state").json()["may_order"] is True
    assert client_of(console, "192.0.2.7").get("/api/state").json()["may_order"] is False


def test_an_unreachable_planner_is_reported(planner) -> None:
    assert client_of(console_of()).post("/api/mission/pause").status_code == 409
    console = console_of(planner)
    planner.close()
    assert client_of(console).post("/api/mission/pause").status_code == 502


def test_the_websocket_sends_new_mission_reports() -> None:
    console = console_of()
    with client_of(console) as client, client.websocket_connect("ws://127.0.0.1:8471/ws") as ws:
        assert "mission" not in ws.receive_json()
        console.crane_state.on_report(encode(VEHICLE), 10**10)
        told(console.crane_state, stamp_ns=10**10, now_ns=10**10)
        while "mission" not in (state := ws.receive_json()):
            pass
        assert state["mission"]["words"] == MISSION_REPORT.words and state["vehicle"]["place"]
        assert "mission" not in ws.receive_json()
        assert client.get("/api/state").json()["mission"]["targets"] == [7]
        assert len(client.get("/api/trail").json()) == 1
