"""A recording opens in Foxglove and Lichtblick without a plug-in: topics have schemas, frames chain, pictures show.

The messages are decoded with the schema that the file itself carries, as those programs do.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from mcap.reader import make_reader
from scipy.spatial.transform import Rotation

from autonomy.localization.local_plane import LocalPlane
from can_dbc.messages.datagrams import encode
from can_dbc.messages.mission import ChosenGrasp, encode_grasp, encode_mission
from can_dbc.messages.picture import PictureFacts, encode_picture
from machine.foxglove import MachineTopics
from machine.geometry import carrier
from machine.geometry.kinematics import chain_points
from machine.loading.profile_file import load_profile, profile_hash
from machine.status.modes import Mode
from recorder.manifest import describe
from recorder.recorder import Recorder
from tests.can_dbc.example_mission_report import MISSION_REPORT
from tests.console.state_reports import REPORT
from tests.console.vehicle_reports import VEHICLE

S = 10**9
JPEG = b"\xff\xd8\xff" + bytes(range(256))


def recorded(folder: Path, name: str) -> Path:
    """Two seconds of reports at 50 Hz: active, then a stop; and a picture."""
    profile = load_profile(name)
    recorder = Recorder(folder, profile, describe(profile, (profile.crane_bus,), seed=1))
    for k in range(100):
        mode = Mode.ACTIVE if k < 50 else Mode.STOP
        at = S + k * S // 50
        recorder.on_report(encode(replace(REPORT, stamp_ns=at, mode=mode, profile_hash=profile_hash(profile))))
        if profile.carrier is not None:
            recorder.on_report(encode(replace(VEHICLE, stamp_ns=at)))
            if k % 25 == 0:
                recorder.on_report(encode_mission(MISSION_REPORT, 1 + k, profile_hash(profile), at))
    camera = next(iter(profile.cameras))
    facts = PictureFacts(1, camera, 2 * S, "", 4, 4)
    recorder.on_picture(encode_picture(facts, JPEG))
    recorder.on_picture(encode_picture(facts))  # nothing newer
    recorder.on_picture(b'{"error":"no camera"}')
    grasp = ChosenGrasp(1, (1.0, 2.0, 3.0), 0.5, (7,), "alone")
    recorder.on_report(encode_grasp(grasp, 1, profile_hash(profile), 2 * S))
    assert recorder.refused == 0
    recorder.close()
    return folder / "run.mcap"


def messages_of(path: Path) -> dict[str, list[Any]]:
    """The decoded messages of the topics with a protobuf schema; and that every other topic has one or is raw."""
    found: dict[str, list[Any]] = {}
    with path.open("rb") as file:
        for schema, channel, message in make_reader(file).iter_messages():
            if schema is None or schema.encoding != "protobuf":
                assert channel.message_encoding != "json" or schema is not None
                continue
            files = descriptor_pb2.FileDescriptorSet.FromString(schema.data)
            pool = descriptor_pool.DescriptorPool()
            for one in files.file:
                pool.Add(one)
            kind = message_factory.GetMessageClass(pool.FindMessageTypeByName(schema.name))
            found.setdefault(channel.topic, []).append(kind.FromString(message.data))
    return found


def test_frames_joints_scene_and_mode_are_drawn_from_the_reports(tmp_path: Path) -> None:
    found = messages_of(recorded(tmp_path / "run", "palms_471"))
    assert {topic: len(messages) for topic, messages in found.items()} == {
        "/tf": 34,
        "/joints": 34,
        "/reference": 34,
        "/machine": 1,
        "/mode": 2,
        "/camera/stick": 1,
    }
    frames = {t.child_frame_id: t for t in found["/tf"][0].transforms}
    grapple = frames["grapple"].translation
    expected = chain_points(load_profile("palms_471").kinematics, REPORT.position).grapple
    assert (grapple.x, grapple.y, grapple.z) == pytest.approx(expected)
    assert {e.frame_id for e in found["/machine"][0].entities} <= {*frames, "base"}, "every body has its frame"
    first = found["/joints"][0].joints[0]
    assert (first.name, first.position) == ("slew", pytest.approx(REPORT.position[0]))
    assert found["/reference"][0].joints[0].position == pytest.approx(REPORT.reference[0])
    active, stopped = found["/mode"]
    assert active.message.startswith("ACTIVE: ") and stopped.message.startswith("STOP: ")
    assert stopped.level > active.level
    assert (found["/camera/stick"][0].data, found["/camera/stick"][0].format) == (JPEG, "jpeg")


def test_a_machine_that_drives_has_its_position_on_the_map(tmp_path: Path) -> None:
    found = messages_of(recorded(tmp_path / "run", "aoro_fc8"))
    place = found["/position"][0]
    assert (place.latitude, place.longitude) == (VEHICLE.latitude_deg, VEHICLE.longitude_deg)
    assert len(found["/position"]) == 10 and len(found["/camera/front"]) == 1


def test_the_log_map_is_drawn_in_the_frame_in_which_the_machine_stands(tmp_path: Path) -> None:
    """The machine heads 1.6 rad at a place, and log 7 lies east and west, 13 m east and 3 m north of it."""
    profile = load_profile("aoro_fc8")
    found = messages_of(recorded(tmp_path / "run", "aoro_fc8"))
    first = found["/logs"][0]
    assert len(found["/logs"]) == 1, "what does not change is told again after two seconds"
    assert [d.type for d in first.deletions] == [1], "all that was drawn before goes"
    seven, nine = first.entities
    assert (seven.id, seven.frame_id, nine.id) == ("log 7", "map", "log 9")
    assert nine.metadata[0].value == "3" and nine.cylinders[0].color.a < 1.0, "given up"
    (log,) = seven.cylinders
    assert (log.size.x, log.size.z) == (0.25, 2.0) and log.pose.position.z == pytest.approx(0.125)
    assert turned(log.pose.orientation, (0.0, 0.0, 1.0)) == pytest.approx((1.0, 0.0, 0.0), abs=1e-9), "bearing 90 deg"
    bases = [t for f in found["/tf"] for t in f.transforms if (t.parent_frame_id, t.child_frame_id) == ("map", "base")]
    assert len(bases) == 34
    plane, base = LocalPlane(VEHICLE.latitude_deg, VEHICLE.longitude_deg), bases[0]
    east, north, _ = plane.local(*MISSION_REPORT.logs[0].place)
    assert (log.pose.position.x, log.pose.position.y) == pytest.approx((east, north), abs=0.02)
    antenna = carrier.base_from_rear(
        profile.carrier, carrier.rear_from_front(VEHICLE.articulation_rad, profile.carrier.antenna_main_m)
    )
    x, y, _ = turned(base.rotation, antenna)
    there = (base.translation.x + x, base.translation.y + y)
    assert there == pytest.approx((0.0, 0.0), abs=1e-6), "the antenna is where it was reported, the origin of the map"
    assert base.translation.z > profile.carrier.crane_base_m[2]


def test_a_stationary_crane_has_no_log_map() -> None:
    assert not {topic.name for topic in MachineTopics(load_profile("palms_471")).topics} & {"/logs", "/position"}
    assert MachineTopics(load_profile("palms_471")).on_mission(MISSION_REPORT, S) == []


def turned(q: Any, v: tuple[float, float, float]) -> tuple[float, ...]:
    """A vector turned by a quaternion with x, y, z, w."""
    return tuple(Rotation.from_quat((q.x, q.y, q.z, q.w)).apply(v).tolist())


def test_the_same_reports_give_the_same_bytes(tmp_path: Path) -> None:
    one, two = (recorded(tmp_path / name, "palms_471").read_bytes() for name in ("one", "two"))
    assert one == two


def test_reports_have_fields_that_a_viewer_can_plot(tmp_path: Path) -> None:
    import json

    with recorded(tmp_path / "run", "aoro_fc8").open("rb") as file:
        summary = make_reader(file).get_summary()
    schemas = {
        c.topic: json.loads(summary.schemas[c.schema_id].data)
        for c in summary.channels.values()
        if c.topic in ("/controller/report", "/controller/vehicle")
    }
    report = schemas["/controller/report"]["properties"]
    assert report["position"] == {"type": "array", "items": {"type": "number"}}
    assert report["mode"] == {"type": "integer"} and "speed_m_s" in schemas["/controller/vehicle"]["properties"]
    assert "$ref" not in json.dumps(schemas)
