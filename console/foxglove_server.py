"""The live run for Foxglove and Lichtblick: their WebSocket protocol, with the topics that the recorder writes.

The library serves in a thread of its own and drops what a slow client does not take.  It is read-only: no capability is
offered, so a client can subscribe to topics and nothing else.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Mapping
from typing import Final

import foxglove
import msgspec
from foxglove import Channel, Context, Schema
from foxglove.websocket import ChannelView, Client, ServerListener, WebSocketServer

from can_dbc.messages.crane import StateReport
from can_dbc.messages.json_schema import flat_schema
from can_dbc.messages.mission import MissionReport
from can_dbc.messages.vehicle import VehicleReport
from console.camera import Camera
from machine.foxglove import ENCODING, MachineTopics, Message
from machine.profile import Profile

REPORT: Final = "/controller/report"
VEHICLE: Final = "/controller/vehicle"
BACKLOG_MESSAGES: Final = 256
PICTURE_PERIOD_S: Final = 0.5
_JSON: Final = msgspec.json.Encoder()


class _Newcomers(ServerListener):
    """A client that subscribes while the machine rests shall see it, too."""

    def __init__(self, topics: MachineTopics) -> None:
        self._topics = topics

    def on_subscribe(self, client: Client, channel: ChannelView) -> None:
        self._topics.repeat()


class FoxgloveServer:
    """Serves on ``host`` and ``port`` (0: any free one) until ``close``.

    Raises:
        OSError: the port cannot be used.
    """

    def __init__(self, profile: Profile, host: str, port: int) -> None:
        self._context = context = Context()  # kept: the library lets go of a context that nobody holds
        self._topics = MachineTopics(profile)
        self._offset_ns = time.time_ns() - time.monotonic_ns()
        self._channels: Mapping[str, Channel] = {
            topic: Channel(topic, schema=schema, message_encoding=ENCODING, context=context)
            for topic, schema in self._topics.topics
        } | {
            topic: _json_channel(topic, kind, context)
            for topic, kind in ((REPORT, StateReport), (VEHICLE, VehicleReport))
            if profile.carrier is not None or topic == REPORT
        }
        try:
            self._server: WebSocketServer = foxglove.start_server(
                name=f"timberhand {profile.name}",
                host=host,
                port=port,
                capabilities=[],
                context=context,
                message_backlog_size=BACKLOG_MESSAGES,
                server_listener=_Newcomers(self._topics),
            )
        except RuntimeError as error:
            raise OSError(str(error)) from error

    @property
    def port(self) -> int:
        """The port that is served."""
        return self._server.port

    def close(self) -> None:
        """End it; its clients are disconnected."""
        self._server.stop()

    def on_report(self, report: StateReport | VehicleReport) -> None:
        """Send what a report of the controller says."""
        time_ns = report.stamp_ns + self._offset_ns
        if isinstance(report, VehicleReport):
            self._send([(VEHICLE, _JSON.encode(report)), *self._topics.on_position(report, time_ns)], time_ns)
        else:
            self._send([(REPORT, _JSON.encode(report)), *self._topics.on_state(report, time_ns)], time_ns)

    def on_mission(self, report: MissionReport, stamp_ns: int) -> None:
        """Send the log map of the planner's mission report."""
        time_ns = stamp_ns + self._offset_ns
        self._send(self._topics.on_mission(report, time_ns), time_ns)

    def on_picture(self, camera: str, jpeg: bytes, measured_ns: int) -> None:
        """Send a picture that a detector measured."""
        time_ns = measured_ns + self._offset_ns
        self._send(self._topics.on_picture(camera, jpeg, time_ns), time_ns)

    def wants_pictures(self) -> bool:
        """Tell whether a client is subscribed to a camera."""
        return any(c.has_sinks() for topic, c in self._channels.items() if topic.startswith("/camera/"))

    def _send(self, messages: list[Message], time_ns: int) -> None:
        for topic, data in messages:
            if (channel := self._channels.get(topic)) is not None:
                channel.log(data, log_time=time_ns)


async def feed_pictures(server: FoxgloveServer, camera: Camera) -> None:
    """Hand over each new picture of the camera while a client is subscribed to one, until cancelled."""
    sent_ns = 0
    while True:
        await asyncio.sleep(PICTURE_PERIOD_S)
        if not server.wants_pictures():
            continue
        newest = await camera.newest()
        if newest is not None and newest[0].measured_ns != sent_ns:
            facts, jpeg = newest
            sent_ns = facts.measured_ns
            server.on_picture(facts.camera, jpeg, sent_ns)


def _json_channel(topic: str, kind: type[StateReport] | type[VehicleReport], context: Context) -> Channel:
    schema = Schema(name=kind.__name__, encoding="jsonschema", data=flat_schema(kind))
    return Channel(topic, schema=schema, message_encoding="json", context=context)
