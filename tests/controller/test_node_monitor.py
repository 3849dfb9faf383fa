"""Supervision of the nodes of crane0: findings by frames and by silence."""

from can_dbc.frame import Frame
from can_dbc.protocols.canopen import Emergency, emergency_frame, heartbeat_frame
from controller.crane.inputs import HEARTBEAT_TIMEOUT_NS, NodeMonitor
from machine.status.reasons import Reason
from tests.controller.bench import MS, Bench


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
