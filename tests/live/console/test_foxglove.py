"""A client that speaks Foxglove's protocol connects to a live console and gets what the recorder would write."""

from __future__ import annotations

import base64
import json
import socket
import struct
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import pytest
from foxglove.messages import FrameTransforms
from mcap.reader import make_reader
from starlette.testclient import TestClient
from websockets.sync.client import ClientConnection, connect

from can_dbc.messages.datagrams import encode
from can_dbc.messages.mission import encode_mission
from can_dbc.messages.picture import PictureFacts, encode_picture
from console.__main__ import main
from console.console import Console
from console.foxglove_server import FoxgloveServer
from console.server import create_app
from machine.foxglove import MachineTopics
from machine.loading.profile_file import load_profile, profile_hash
from machine.profile import Profile
from recorder.manifest import describe
from recorder.recorder import Recorder
from recorder.recover import Channel, scan
from tests.can_dbc.example_mission_report import MISSION_REPORT
from tests.console.played_detector import detector
from tests.console.state_reports import REPORT

PROFILE, FORWARDER = load_profile("palms_471"), load_profile("aoro_fc8")
HASH = profile_hash(PROFILE)
PROTOCOL = "foxglove.sdk.v1"
MESSAGE = struct.Struct("<BIQ")
JPEG = b"\xff\xd8\xff" + bytes(99)


@pytest.fixture
def server() -> Iterator[FoxgloveServer]:
    live = FoxgloveServer(PROFILE, "127.0.0.1", 0)
    yield live
    live.close()


class Viewer:
    """A client of the protocol: what is advertised, and the messages of the topics that it subscribes to."""

    def __init__(self, link: ClientConnection, profile: Profile = PROFILE) -> None:
        self._link = link
        reports = 1 if profile.carrier is None else 2
        self.info = json.loads(link.recv(5))
        self.channels: dict[str, dict[str, Any]] = {}
        while len(self.channels) < len(MachineTopics(profile).topics) + reports:
            told = json.loads(link.recv(5))
            assert told["op"] == "advertise"
            self.channels |= {channel["topic"]: channel for channel in told["channels"]}

    def subscribe(self, *topics: str) -> None:
        wanted = [{"id": 100 + self.channels[t]["id"], "channelId": self.channels[t]["id"]} for t in topics]
        self._link.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))

    def receive(self) -> tuple[int, int, bytes]:
        """Channel, log time and bytes of the next message."""
        data = self._link.recv(10)
        assert isinstance(data, bytes)
        kind, subscription, time_ns = MESSAGE.unpack_from(data)
        assert kind == 1
        return subscription - 100, time_ns, data[MESSAGE.size :]


def viewing(port: int) -> ClientConnection:
    return connect(f"ws://127.0.0.1:{port}", subprotocols=[PROTOCOL], max_size=None)  # type: ignore[list-item]


def wait_for_sinks(server: FoxgloveServer, *topics: str) -> None:
    limit = time.monotonic() + 5
    while not all(server._channels[topic].has_sinks() for topic in topics):
        assert time.monotonic() < limit, "the subscription arrives"
        time.sleep(0.01)


def test_a_viewer_gets_frames_and_reports_of_the_live_run(server: FoxgloveServer) -> None:
    with viewing(server.port) as link:
        viewer = Viewer(link)
        assert "palms_471" in viewer.info["name"] and viewer.info["capabilities"] == [], "it is read-only"
        viewer.subscribe("/tf", "/controller/report")
        wait_for_sinks(server, "/tf", "/controller/report")
        sent = replace(REPORT, stamp_ns=time.monotonic_ns())
        server.on_report(sent)
        got = {n: (at, data) for n, at, data in (viewer.receive(), viewer.receive())}
        frames, report = (got[viewer.channels[topic]["id"]] for topic in ("/tf", "/controller/report"))
        assert abs(frames[0] - time.time_ns()) < 2_000_000_000, "logged in UTC"
        assert frames[1] == dict(MachineTopics(PROFILE).on_state(sent, frames[0]))["/tf"]
        assert json.loads(report[1])["position"] == list(REPORT.position)


def test_it_has_the_topics_and_schemas_of_a_recording(server: FoxgloveServer, tmp_path: Path) -> None:
    Recorder(tmp_path / "run", PROFILE, describe(PROFILE, ("crane0",), seed=1)).close()
    recorded = {r.topic for r in scan(tmp_path / "run" / "run.mcap", None) if isinstance(r, Channel)}
    with viewing(server.port) as link:
        channels = Viewer(link).channels
    assert set(channels) <= recorded
    assert channels["/tf"]["schemaName"] == FrameTransforms.get_schema().name == "foxglove.FrameTransforms"
    assert channels["/camera/stick"]["schemaName"] == "foxglove.CompressedImage"


@pytest.fixture
def forwarder() -> Iterator[FoxgloveServer]:
    live = FoxgloveServer(FORWARDER, "127.0.0.1", 0)
    yield live
    live.close()


def test_the_log_map_is_that_of_a_recording(forwarder: FoxgloveServer, tmp_path: Path) -> None:
    """Topic, schema, and the bytes of the message but for its time."""
    code, at_ns = profile_hash(FORWARDER), time.monotonic_ns()
    console = Console(FORWARDER, code, foxglove=forwarder)
    with viewing(forwarder.port) as link:
        viewer = Viewer(link, FORWARDER)
        viewer.subscribe("/logs")
        wait_for_sinks(forwarder, "/logs")
        assert console.crane_state.on_report(encode_mission(MISSION_REPORT, 1, code, at_ns), at_ns)
        channel, time_ns, drawn = viewer.receive()
    told = viewer.channels["/logs"]
    assert channel == told["id"] and abs(time_ns - time.time_ns()) < 2_000_000_000
    manifest = describe(FORWARDER, ("crane0", "mach0"), seed=1)
    manifest = msgspec.structs.replace(manifest, start_utc_ns=time_ns, start_monotonic_ns=at_ns)
    recorder = Recorder(tmp_path / "run", FORWARDER, manifest)
    recorder.on_report(encode_mission(MISSION_REPORT, 1, code, at_ns))
    recorder.close()
    with (tmp_path / "run" / "run.mcap").open("rb") as file:
        ((schema, recorded, message),) = make_reader(file).iter_messages(["/logs"])
    assert schema is not None and (schema.name, recorded.message_encoding) == (told["schemaName"], told["encoding"])
    assert schema.data == base64.b64decode(told["schema"]) and schema.encoding == told["schemaEncoding"]
    assert (message.data, message.log_time) == (drawn, time_ns)


def test_who_comes_later_learns_the_mode_too(server: FoxgloveServer) -> None:
    server.on_report(replace(REPORT, stamp_ns=time.monotonic_ns()))
    with viewing(server.port) as link:
        viewer = Viewer(link)
        viewer.subscribe("/mode")
        wait_for_sinks(server, "/mode")
        server.on_report(replace(REPORT, stamp_ns=time.monotonic_ns()))
        assert b"ACTIVE" in viewer.receive()[2]


def test_the_console_feeds_reports_and_pictures(server: FoxgloveServer) -> None:
    facts = PictureFacts(1, "stick", time.monotonic_ns(), "", 4, 4)
    with detector(encode_picture(facts, JPEG)) as (address, asked):
        console = Console(PROFILE, HASH, scene=address, foxglove=server)
        with TestClient(create_app(console), base_url="http://127.0.0.1:8471"), viewing(server.port) as link:
            viewer = Viewer(link)
            time.sleep(0.7)
            assert not asked, "nobody is subscribed to a camera"
            viewer.subscribe("/camera/stick")
            assert JPEG in viewer.receive()[2]
            viewer.subscribe("/controller/report")
            wait_for_sinks(server, "/controller/report")
            assert console.crane_state.on_report(encode(replace(REPORT, stamp_ns=5)), 5)
            assert b"position" in viewer.receive()[2]


def test_a_port_in_use_is_refused_with_a_sentence(capsys: pytest.CaptureFixture[str]) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        assert main(["--port", "0", "--report-port", "0", "--foxglove", str(port)]) == 4
    assert "--foxglove" in capsys.readouterr().err
