"""Set-up of the encoders against emulated nodes, and supervision of all nodes of crane0."""

import msgspec
import pytest

from can_dbc.frame import Frame
from can_dbc.protocols.canopen import SDO_TO_SERVER, Emergency, Sdo, SdoKind, emergency_frame, heartbeat_frame
from controller.crane.inputs import HEARTBEAT_TIMEOUT_NS, NodeMonitor
from controller.crane.startup import EncoderSetup, Phase
from controller.step import Controller
from machine.status.modes import Mode
from machine.status.reasons import Reason
from runtime.errors import ConfigError
from tests.codes import coded
from tests.controller.bench import DATABASE, MS, PROFILE, Bench, T, settings_of

SLEW = PROFILE.joints["slew"]


def test_every_encoder_is_configured_as_in_the_bus_reference():
    bench = Bench().boot()
    rotary, linear = bench.encoders[2].objects, bench.encoders[5].objects
    assert [rotary[0x1A00, i] for i in (1, 2, 3)] == [0x60040020, 0x21200010, 0x65030010]
    assert [linear[0x1A00, i] for i in (1, 2, 3, 4)] == [0x60040020, 0x60300110, 0x51220108, 0x51220208]
    assert rotary[0x1A00, 0] == 3 and linear[0x1A00, 0] == 4
    for node, encoder in bench.encoders.items():
        assert encoder.state == 0x05
        assert encoder.objects[0x1800, 2] == 1 and encoder.objects[0x1017, 0] == 100
        assert encoder.objects[0x1800, 1] == 0x180 + node
        writes = [w[:2] for w in encoder.writes]
        assert encoder.writes[0] == (0x1800, 1, 0x80000180 + node), "the PDO is off while it is mapped"
        assert writes.index((0x1A00, 1)) < writes.index((0x1800, 2))
    assert bench.now_ns - 10**9 < 2_000 * MS


def test_at_most_one_frame_per_tick():
    bench = Bench()
    for _ in range(120):
        outputs = bench.tick()
        setup = [key for key, _ in outputs.frames if key == 0 or SDO_TO_SERVER < key < SDO_TO_SERVER + 128]
        assert len(setup) <= 1


def test_absent_encoder_is_reported_and_set_up_when_it_appears():
    bench = Bench()
    bench.encoders[4].silent = True
    assert bench.run(500) is Mode.BOOT
    assert bench.reason == Reason.NODE_ABSENT and bench.controller.supervisor.detail == 4
    assert bench.press(1) is Mode.BOOT and bench.controller.gate.refusal is Reason.NODE_ABSENT
    bench.encoders[4].silent = False
    assert bench.run(200) is Mode.STANDBY


@pytest.mark.parametrize(("place", "value"), [((0x1000, 0), 0x00080196), ((0x6001, 0), 4096), ((0x6002, 0), 1)])
def test_wrong_identity_or_range_is_refused_until_reset(place, value):
    bench = Bench()
    good = bench.encoders[3].objects[place]
    bench.encoders[3].objects[place] = value
    assert bench.run(300) is Mode.BOOT
    assert bench.reason == Reason.NODE_IDENTITY and bench.controller.supervisor.detail == 3
    bench.encoders[3].objects[place] = good
    assert bench.run(100) is Mode.BOOT
    bench.press(4)
    assert bench.run(100) is Mode.STANDBY


def test_refused_set_up_is_a_configuration_fault():
    bench = Bench()
    bench.encoders[6].refuses.add((0x1A00, 2))
    bench.run(200)
    assert bench.reason == Reason.NODE_CONFIGURATION and bench.controller.supervisor.detail == 6


@pytest.mark.parametrize(
    ("node", "place", "value"),
    [
        pytest.param(2, (0x1018, 1), 8, id="another device"),
        pytest.param(4, (0x6003, 0), 1234, id="lost preset"),
    ],
)
def test_device_swapped_or_reset_while_running_is_detected(node, place, value):
    bench = Bench().boot()
    bench.encoders[node].objects[place] = value
    bench.extra.append((0x700 + node, b"\x00"))
    bench.encoders[node].state = 0x7F
    assert bench.run(100) is Mode.STANDBY
    assert bench.reason == Reason.NODE_IDENTITY and bench.controller.supervisor.detail == node


def test_three_tries_of_300_ms_then_again():
    setup = EncoderSetup(SLEW.encoder)
    sent = [k * T // MS for k in range(400) if setup.frame(k * T) is not None]
    assert sent[:5] == [0, 5, 305, 605, 910]
    assert setup.reason is Reason.NODE_ABSENT


def test_stray_answer_is_ignored():
    setup = EncoderSetup(SLEW.encoder)
    stray = Sdo(SdoKind.UPLOAD, 2, 0x6004, 0, b"\1\0\0\0", 0)
    setup.receive(stray)
    setup.frame(0)
    setup.frame(T)
    setup.receive(stray)
    assert setup.phase is Phase.CONFIGURING and setup.reason is Reason.NODE_ABSENT


def test_encoder_that_left_operational_by_itself_is_set_up_again_by_a_reset():
    bench = Bench().boot()
    bench.encoders[3].state = 0x7F  # what a CiA 301 device does after a communication error
    bench.run(100)
    assert bench.press(1) is Mode.STANDBY
    bench.press(4)
    bench.run(200)
    assert bench.encoders[3].state == 0x05
    assert bench.press(1) is Mode.ARMED


def test_node_that_boots_late_is_started():
    bench = Bench().boot()
    starts = [f for f in _frames(bench, 40) if f == (0, b"\x01\x00")]
    assert not starts
    bench.extra.append((0x710, b"\x00"))  # boot-up of the valve node
    assert (0, b"\x01\x00") in _frames(bench, 40)


def _frames(bench, ticks):
    return [frame for _ in range(ticks) for frame in list(bench.tick().frames)]


def test_node_that_cannot_send_its_message_is_a_configuration_error():
    slew = msgspec.structs.replace(SLEW, encoder=msgspec.structs.replace(SLEW.encoder, node=16))
    profile = msgspec.structs.replace(PROFILE, joints=PROFILE.joints | {"slew": slew})
    with pytest.raises(ConfigError, check=coded("config.encoder-node")):
        Controller(settings_of(profile), DATABASE)


# -- the nodes of crane0: findings by frames and by silence


def receive(nodes, now_ns, *frames):
    nodes.begin_tick()
    for key, data in frames:
        assert nodes.receive(Frame(now_ns, key, data), now_ns)


def test_silence_is_detected_without_any_frame():
    nodes = NodeMonitor([2])
    receive(nodes, 10 * MS, heartbeat_frame(2, 5), heartbeat_frame(0x20, 5))
    receive(nodes, 15 * MS, heartbeat_frame(0x10, 5))
    end_ns = 10 * MS + HEARTBEAT_TIMEOUT_NS
    for now_ns in (15 * MS, 200 * MS, end_ns):
        receive(nodes, now_ns)
        assert nodes.worst_finding(now_ns) == (Reason.NONE, 0)
    receive(nodes, end_ns + 1)
    assert nodes.worst_finding(end_ns + 1) == (Reason.ENCODER_NODE_LOST, 2), "worse than the lost pressure module"
    receive(nodes, end_ns + 6 * MS)
    assert nodes.worst_finding(end_ns + 6 * MS) == (Reason.SAFETY_NODE_LOST, 0x10)


def test_hardest_finding_wins_in_any_order():
    nodes = NodeMonitor([2])
    receive(nodes, 0, emergency_frame(Emergency(2, 0x4200, 1, b"")), emergency_frame(Emergency(0x22, 0x5000, 1, b"")))
    assert nodes.worst_finding(0) == (Reason.EMERGENCY_MESSAGE, 0x22)
    receive(nodes, 1, emergency_frame(Emergency(0x22, 0, 0, b"")))
    assert nodes.worst_finding(1) == (Reason.EMERGENCY_WARNING, 2)


def test_restart_between_heartbeats_counts_in_one_tick():
    bench = Bench().boot()
    while bench.count % 20 != 2:
        bench.tick()
    bench.extra += [heartbeat_frame(1, 0), heartbeat_frame(1, 5)]
    bench.tick()
    assert bench.reason == Reason.NODE_RESTARTED and bench.controller.supervisor.detail == 1
    bench.tick()
    assert bench.reason == Reason.NONE
