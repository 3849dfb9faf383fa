"""The console's server: permissions, guards and the page's state."""

from __future__ import annotations

import asyncio
import base64
import errno
import hashlib
import json
import math
import re
import signal
import socket
import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from starlette.applications import Starlette
from starlette.testclient import TestClient
from starlette.websockets import WebSocket, WebSocketDisconnect

from autonomy.perception.log_list import decode_logs, decode_request
from can_dbc.messages.crane import WATCH_ACTIONS, OperatorAction, OperatorCommand
from can_dbc.messages.datagrams import decode, encode
from can_dbc.messages.operator_link import credential_path
from can_dbc.timing.durations import Durations
from can_dbc.timing.page import STAGES, Timing, TimingWriter
from console import server
from console.__main__ import _address as address_of
from console.__main__ import main, serve_plant
from console.console import Console
from console.exposure import StartError
from console.plant_link import PlantLink, create_plant_app
from console.replay_server import create_replay_app
from console.server import STATIC, create_app
from console.state import (
    EDGES_US,
    REPORT_TIMEOUT_NS,
    SHOWN,
    TIMING_TIMEOUT_NS,
    CraneState,
    describe_machine,
    histograms,
)
from machine.joints import JOINTS, Joint
from machine.loading.profile_file import load_profile, profile_hash
from machine.status.explanation import describe
from machine.status.modes import Mode
from machine.status.stale_inputs import CRANE_INPUT_BITS, ENCODER_BIT, STALE_INPUT_NAMES
from tests.codes import coded
from tests.console.page_client import BROWSING, HERE, page_client, socket_of, visitor
from tests.console.recorded_run import RecordedRun
from tests.console.state_reports import REPORT, at
from tests.operator_end import OperatorEnd, udp_end

PROFILE = load_profile("palms_471")
CHECK = 0x123456


@pytest.fixture
def controller_socket():
    with udp_end(5) as s:
        yield s


@pytest.fixture
def operator_socket(tmp_path):
    """The controller's end of the operator's commands."""
    with OperatorEnd(tmp_path / "operator") as s:
        s.settimeout(5)
        yield s


@pytest.fixture
def console(operator_socket):
    path = Path(operator_socket.getsockname())
    return Console(PROFILE, profile_hash(PROFILE), path, clock=lambda: 10**10, profile_check=CHECK)


def client_of(console, peer="127.0.0.1", **options):
    """A page there; on this machine it has the control lease."""
    return page_client(console, peer, leads=peer == "127.0.0.1", **options)


@pytest.fixture
def client(console):
    return client_of(console)


def test_page_and_every_file_beside_it_are_served_from_here(client):
    page = client.get("/")
    assert page.status_code == 200 and 'id="stop"' in page.text
    assert "http://" not in page.text and "https://" not in page.text
    files = [path for path in STATIC.rglob("*") if path.suffix in (".js", ".css", ".svg", ".txt")]
    assert {"app.js", "icon.svg", "three.module.min.js", "three.LICENSE.txt"} <= {path.name for path in files}
    for path in files:
        assert client.get(f"/static/{path.relative_to(STATIC)}").status_code == 200, path


@pytest.mark.parametrize("file", ["carrier.js", "map.js"])
def test_the_machine_description_has_all_carrier_dimensions(file):
    told = describe_machine(load_profile("aoro_fc8"))["carrier"]
    wanted = set(re.findall(r"\bc\.(\w+)", (STATIC / file).read_text()))
    assert wanted and wanted <= set(told)


def test_policy_allows_no_other_source(client):
    policy = client.get("/").headers["content-security-policy"]
    assert policy.startswith("default-src 'none'; script-src 'self' 'sha256-")
    assert "http" not in policy and "unsafe" not in policy and "*" not in policy
    assert client.get("/static/app.js").headers["content-security-policy"] == policy
    assert client.get("/healthz").headers["x-content-type-options"] == "nosniff"


def test_policy_names_the_hash_of_the_import_map(client):
    page = client.get("/").text
    inline = page.split('<script type="importmap">')[1].split("</script>")[0]
    digest = base64.b64encode(hashlib.sha256(inline.encode()).digest()).decode()
    assert f"'sha256-{digest}'" in client.get("/").headers["content-security-policy"]
    assert page.count("<script") == 2 and "<style" not in page and "onclick" not in page


@pytest.mark.parametrize(
    "host",
    [
        "evil.example",
        "evil.example:8471",
        "127.0.0.1.evil.example",
        "",
        "evil@127.0.0.1",
        "evil@127.0.0.1:8471",
        "127.0.0.1:8471:80",
        "127.0.0.1/x",
        "127.0.0.1 ",
        "127.0.0.1:x",
    ],
)
def test_foreign_host_is_refused(client, host):
    assert client.get("/api/state", headers={"host": host}).status_code == 403
    with pytest.raises(WebSocketDisconnect), client.websocket_connect("/ws", headers={"host": host}):
        pass


@pytest.mark.parametrize("host", ["localhost:8471", "[::1]:8471", "127.0.0.1:8471"])
def test_own_names_are_served(client, host):
    assert client.get("/api/state", headers={"host": host}).status_code == 200


@pytest.mark.parametrize(
    ("name", "host"), [("forwarder", "forwarder:8471"), ("Forwarder.local", "forwarder.local"), ("[::2]", "[::2]:8471")]
)
def test_allowed_host_is_served(console, name, host):
    assert visitor(console, allow_hosts=(name,)).get("/healthz", headers={"host": host}).status_code == 200


@pytest.mark.parametrize("action", [a for a in OperatorAction if a not in WATCH_ACTIONS])
def test_command_sends_its_datagram(client, operator_socket, action):
    answer = client.post(f"/api/operator/{action.name.lower()}", headers={"origin": HERE})
    assert answer.status_code == 204
    message = decode(operator_socket.recv(100))
    assert isinstance(message, OperatorCommand)
    assert (message.action, message.profile_hash, message.profile_check) == (action, profile_hash(PROFILE), CHECK)


def test_command_sequence_grows(client, operator_socket):
    for _ in range(3):
        client.post("/api/operator/stop")
    sequences = [decode(operator_socket.recv(100)).sequence for _ in range(3)]
    assert sequences == sorted(set(sequences))


def test_a_command_needs_the_credential_and_stop_does_not(console, client, tmp_path, operator_socket):
    credential_path(tmp_path / "operator").unlink()
    assert client.post("/api/operator/arm").status_code == 502
    assert client.post("/api/operator/stop").status_code == 204
    assert decode(operator_socket.recv(100)).action is OperatorAction.STOP


def test_stop_from_another_machine_is_sent_but_arm_is_refused(console, operator_socket):
    client = visitor(console, "192.0.2.7")
    assert client.post("/api/operator/stop").status_code == 204
    assert decode(operator_socket.recv(100)).action is OperatorAction.STOP
    for action in ("arm", "disarm", "reset"):
        assert client.post(f"/api/operator/{action}").status_code == 403
    assert client.get("/api/state").json()["may_command"] is False


def test_command_by_get_or_unknown_is_refused(client):
    assert client.get("/api/operator/stop").status_code == 405
    assert client.post("/api/operator/launch").status_code == 404


def test_an_unreachable_controller_is_reported(console, operator_socket):
    operator_socket.close()
    answer = client_of(console).post("/api/operator/stop")
    assert answer.status_code == 502 and str(console.operator) in answer.text


def test_a_path_too_long_for_a_socket_is_told_in_words(tmp_path):
    answer = client_of(Console(PROFILE, 1, tmp_path / ("x" * 120))).post("/api/operator/stop")
    assert answer.status_code == 502 and "too long" in answer.text


def test_a_console_without_a_controller_is_read_only():
    client = client_of(Console(PROFILE, 1))
    assert client.post("/api/operator/stop").status_code == 409
    assert client.get("/api/state").json()["may_stop"] is False


def test_state_flows_over_the_websocket(console, client):
    console.crane_state.on_report(encode(REPORT), 10**10)
    with client.websocket_connect(socket_of(client), headers=BROWSING) as ws:
        state = ws.receive_json()
        assert state["mode"] == "ACTIVE" and state["alive"] and state["may_command"]
        console.crane_state.on_report(encode(replace(REPORT, mode=Mode.FAULT)), 10**10)
        while ws.receive_json()["mode"] != "FAULT":
            pass


def test_reports_arrive_by_udp(controller_socket):
    reports = udp_end()
    console = Console(PROFILE, 1, reports=reports)
    with client_of(console) as client:
        with client.websocket_connect("ws://127.0.0.1:8471/ws") as ws:
            assert not ws.receive_json()["alive"]
            controller_socket.sendto(encode(REPORT), reports.getsockname())
            while not ws.receive_json()["alive"]:
                pass
        while (health := client.get("/healthz").json())["controller"] != "alive":  # the last report may be old by now
            controller_socket.sendto(encode(REPORT), reports.getsockname())
        assert health == {"console": "ok", "controller": "alive"}


def test_logs_of_a_detector_are_shown(controller_socket):
    console = Console(PROFILE, 1, scene=controller_socket.getsockname())
    log = {"position_m": [1, 2, -1], "axis": [0, 2, 0], "length_m": 2.4, "diameter_m": 0.2}
    answer = json.dumps([log]).encode()
    (known,) = decode_logs(answer)
    with client_of(console) as client:
        question, peer = controller_socket.recvfrom(100)
        assert all(value != value for value in decode_request(question).q), "the request has no joints"
        controller_socket.sendto(b'{"nonsense": 1}', peer)
        controller_socket.sendto(answer, peer)
        with client.websocket_connect("ws://127.0.0.1:8471/ws") as ws:
            while not (logs := ws.receive_json()["logs"]):
                pass
        (shown,) = logs
        assert shown["axis"] == [0.0, 1.0, 0.0] and shown["center_m"] == list(known.center_m)
        assert {"center_m", "axis", "length_m", "diameter_m"} <= set(shown)  # the dimensions drawn by scene.js


# ---- the pure part ----------------------------------------------------------------------------------------------


def watched(report=REPORT, at_ns=0, seen_ns=0):
    crane_state = CraneState(PROFILE)
    assert crane_state.on_report(encode(report), at_ns)
    return crane_state.state(seen_ns)


def test_the_state_has_the_reason_and_the_stale_inputs():
    state = watched()
    assert state["reason"] == describe(REPORT.reason)
    assert state["stale"] == [STALE_INPUT_NAMES[k] for k in (CRANE_INPUT_BITS["EstopStat"], ENCODER_BIT + Joint.TILT)]
    assert state["refused"] == 4 and state["refusal"] == ""


def test_unknown_reason_and_mode_are_still_shown():
    state = watched(replace(REPORT, reason=250, mode=77))
    assert "250" in state["reason"] and state["mode"] == "MODE 77"


def test_unknown_numbers_are_none_and_the_state_is_json():
    unknown = (math.nan,) * 5
    state = watched(replace(REPORT, position=unknown, reference=unknown, clamp_bar=math.nan))
    assert state["position"] == [None] * 5 and state["clamp_bar"] is None and state["points"] is None
    json.dumps(state, allow_nan=False)


def test_a_silent_controller_is_detected():
    crane_state = CraneState(PROFILE)
    crane_state.on_report(encode(REPORT), 0)
    assert crane_state.state(REPORT_TIMEOUT_NS - 1)["alive"] and not crane_state.state(REPORT_TIMEOUT_NS)["alive"]


def test_peaks_hold_for_a_second():
    crane_state = CraneState(PROFILE)
    for k, tick_ns in enumerate((900_000, 100_000, 100_000)):
        report = replace(REPORT, tick_ns=tick_ns, stamp_ns=k * 20_000_000, frames_received=64 * k)
        crane_state.on_report(encode(report), k * 20_000_000)
    assert crane_state.state(50_000_000)["tick_ms"] == 0.9
    assert crane_state.state(50_000_000)["frames_per_s"] == 3200
    assert crane_state.state(1_010_000_000)["tick_ms"] == 0.1


def test_timing_is_shown_while_the_controller_writes_it(timing):
    crane_state = CraneState(PROFILE)
    assert crane_state.state(0)["timing"] is None
    page = timing(100, missed=3, written_ns=10**10)
    crane_state.on_timing(page)
    seen = crane_state.state(10**10)["timing"]
    wake, cpu = page.durations["wake"], page.durations["cpu"]
    assert (seen["ticks"], seen["missed"]) == (100, 3)
    assert (seen["wake_us"], seen["cpu_us"]) == (wake.quantile_ns(0.99) / 1e3, cpu.quantile_ns(0.99) / 1e3)
    assert seen["sample_to_command_ms"] == page.durations["sample_to_command"].quantile_ns(0.99) / 1e6
    assert (seen["oldest_input"], seen["oldest_input_ms"]) == ("Input6", 16.0)
    json.dumps(seen, allow_nan=False)
    last, late = (crane_state.state(10**10 + TIMING_TIMEOUT_NS - k)["timing"] for k in (1, 0))
    assert last and not late


def test_every_duration_is_in_the_bar_of_its_size(timing) -> None:
    found = {name: Durations() for name in STAGES}
    sizes_us = (0, 1, 3, 49, 51, 999, 1500, 60_000, 150_000)
    for us in sizes_us:
        found["wake"].add(us * 1000)
    seen = histograms(Timing(timing(9).facts, found))
    json.dumps(seen, allow_nan=False)
    wake = next(h for h in seen["of"] if h["name"] == "wake")
    expected = [0] * (len(EDGES_US) + 1)
    for us in sizes_us:  # a bin of 1 us begins at its lower edge
        expected[next((i for i, edge in enumerate(EDGES_US) if us < edge), len(EDGES_US))] += 1
    assert wake["counts"] == expected and sum(wake["counts"]) == len(sizes_us)
    assert [h["name"] for h in seen["of"]] == list(SHOWN) and wake["max_us"] == 150_000


def test_the_timing_page_is_read_until_it_ends(timing, tmp_path, monkeypatch):
    monkeypatch.setattr("console.server.TIMING_PERIOD_S", 0.01)
    monkeypatch.setattr("console.state.TIMING_TIMEOUT_NS", 200_000_000)
    path = tmp_path / "controller.timing"
    console = Console(PROFILE, 1, timing_page=path)
    with client_of(console) as client, client.websocket_connect("ws://127.0.0.1:8471/ws") as ws:
        assert ws.receive_json()["timing"] is None
        writer, written = TimingWriter(path), timing(100)
        writer.publish(written.facts, written.durations)
        while not (seen := ws.receive_json()["timing"]):
            written = timing(100)
            writer.publish(written.facts, written.durations)
        assert seen["ticks"] == 100
        writer.close()
        while ws.receive_json()["timing"]:
            pass


def test_foreign_datagrams_change_nothing():
    crane_state = CraneState(PROFILE)
    good = encode(REPORT)
    command = OperatorCommand(1, 2, 3, OperatorAction.STOP)
    for bad in (b"", b"x", good[:-1], good[:40] + b"\xff" + good[41:], encode(command)):
        assert not crane_state.on_report(bad, 0)
    assert "mode" not in crane_state.state(0)


def test_drawing_hangs_the_grapple_below_the_pin():
    state = watched()
    base, _, _, _, pin, rotator, grapple = state["points"]
    assert base == [0, 0, 0] and pin[:2] == grapple[:2] and pin[2] > rotator[2] > grapple[2]
    assert state["reference_points"][4] != pin
    assert state["jaws"]["yaw_rad"] == pytest.approx(0.4)


@pytest.mark.parametrize("told", [math.nan, 0.3])
def test_a_rotator_without_encoder_is_drawn_at_its_reference(told):
    q = (0.5, 0.9, -2.0, 0.5, math.nan)

    def drawn(machine, reference):
        profile, unknown = load_profile(machine), dict.fromkeys(("opening_pct", "clamp_bar", "load_kg"), math.nan)
        crane_state = CraneState(profile)
        changes = unknown | {"profile_hash": profile_hash(profile), "reference": (*q[:4], reference)}
        assert crane_state.on_report(encode(at(q, 5_000_000_000, **changes)), 0)
        state = crane_state.state(0)
        json.dumps(state, allow_nan=False)
        return state

    across = drawn("aoro_fc8", math.nan)["jaws"]["yaw_rad"]
    seen = drawn("aoro_fc8", told)
    assert seen["jaws"]["yaw_rad"] == pytest.approx(across + (0.0 if math.isnan(told) else told))
    assert seen["position"][4] is None and seen["opening_pct"] is None
    assert drawn("palms_471", told)["points"] is None, "a lost encoder is not guessed"


def test_machine_description_names_every_joint_once():
    names = [j["name"] for j in describe_machine(PROFILE)["joints"]]
    assert names == [j.name.lower() for j in JOINTS]


# ---- the process ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("app", "path"),
    [
        (lambda: create_app(Console(PROFILE, 1)), "/ws"),
        (lambda: create_replay_app(RecordedRun(), PROFILE), "/ws"),
        (lambda: create_plant_app(("127.0.0.1", 24705)), "/ws/plant"),
    ],
    ids=["machine", "recording", "plant"],
)
def test_a_page_that_the_server_has_given_up_counts_as_gone(
    monkeypatch: pytest.MonkeyPatch, app: Callable[[], Starlette], path: str
) -> None:
    """It answered no ping: uvicorn has closed the connection, and says so with a RuntimeError when more is sent."""
    sent = threading.Event()

    async def closed(_socket: WebSocket, _text: str) -> None:
        sent.set()
        raise RuntimeError("Unexpected ASGI message 'websocket.send', after sending 'websocket.close'.")

    async def answered(*_: object) -> bytes:
        return b"{}"

    monkeypatch.setattr(WebSocket, "send_text", closed)
    monkeypatch.setattr(PlantLink, "request", answered)
    with TestClient(app(), base_url=HERE) as page, page.websocket_connect(f"ws://127.0.0.1:8471{path}"):
        assert sent.wait(10.0)  # and what the server raises is raised here


@pytest.mark.parametrize("option", ["--port", "--report-port", "--foxglove"])
@pytest.mark.parametrize("text", ["65536", "-1", "page"])
def test_a_port_that_no_computer_has_is_refused_with_the_option(
    capsys: pytest.CaptureFixture[str], option: str, text: str
) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["--report-port", "0", f"{option}={text}"])
    told = capsys.readouterr().err
    assert ended.value.code == 2 and option in told and f'"{text}" is no port' in told


@pytest.mark.parametrize(
    "reason", [OSError(errno.EADDRNOTAVAIL, "Cannot assign requested address"), socket.gaierror(-2, "Not known")]
)
def test_an_address_that_this_computer_does_not_have_is_not_taken_for_a_port_in_use(
    monkeypatch: pytest.MonkeyPatch, reason: OSError
) -> None:
    def bind(*_: object) -> None:
        raise reason

    monkeypatch.setattr(socket.socket, "bind", bind)
    with pytest.raises(StartError, match="choose another --bind", check=coded("console.bind")) as refused:
        serve_plant(port=0, plant="127.0.0.1:24705")
    assert refused.value.exit_code == 2


@pytest.mark.parametrize("text", ["::1:24705", "[::1]:24705", "planner:24705", "127.0.0.1"])
def test_an_address_that_takes_no_datagram_is_refused(text: str) -> None:
    assert address_of("127.0.0.1:24705", "--planner") == address_of("24705", "--planner") == ("127.0.0.1", 24705)
    with pytest.raises(StartError, match=f"--planner {re.escape(text)} is not .* IPv4", check=coded("console.address")):
        address_of(text, "--planner")


def test_an_address_to_which_there_is_no_way_is_refused() -> None:
    with pytest.raises(StartError, match=r"--scene .* cannot be reached", check=coded("console.address")):
        address_of("255.255.255.255:24705", "--scene")


def test_a_termination_ends_the_process_while_it_starts_although_ctrl_c_is_ignored(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """As a shell ignores it for what a script starts in the background."""

    def terminated(_name: str) -> None:
        signal.raise_signal(signal.SIGTERM)
        raise AssertionError("the process goes on")

    monkeypatch.setattr("console.__main__.load_profile", terminated)
    before = [signal.signal(number, signal.SIG_IGN) for number in (signal.SIGINT, signal.SIGTERM)]
    try:
        assert main(["--report-port", "0"]) == 0
    finally:
        for number, handler in zip((signal.SIGINT, signal.SIGTERM), before, strict=True):
            signal.signal(number, handler)


def test_a_desk_of_faults_that_hangs_is_told_with_the_time_that_was_waited(monkeypatch: pytest.MonkeyPatch) -> None:
    async def hang(*_: object, **__: object) -> None:
        raise TimeoutError

    monkeypatch.setattr(asyncio, "open_unix_connection", hang)
    told = asyncio.run(server._ask(Path("desk"), {"op": "list"}))
    assert "6 s" in told["error"] and "()" not in told["error"]
