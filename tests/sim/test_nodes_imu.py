"""The emulated inertial sensor on a grapple: readings, directions, delay, and no effect on other nodes."""

from __future__ import annotations

import math

import msgspec
import pytest

from can_dbc.dbc.codec import load
from can_dbc.frame import Frame
from can_dbc.protocols.canopen import NmtCommand, nmt_frame, sync_frame
from machine.loading.profile_file import load_profile
from machine.profile import Imu
from sim.nodes import Outbox
from sim.nodes.imu import LATENCY_NS, LEAN_NOISE_RAD, MOUNTING_RAD, RATE_NOISE_RAD_S, ImuNode
from sim.plant import Plant
from sim.world import STEP_NS, open_world

PLAIN = load_profile("palms_471")
IMU = Imu(0x23, "GrappleImu", gain=0.4, pendulum_m=0.8, pin_speed_m_s=0.12, dead_zone_rad=0.014)
SENSING = msgspec.structs.replace(PLAIN, imu=IMU)
CRANE = load("crane")
CODEC = CRANE.message("GrappleImu")
OWN_KEYS = (CODEC.key, 0x700 + IMU.node)
START_NS = 1_000_000_000
SIGNALS = ("LeanRadial", "LeanTangential", "RateRadial", "RateTangential")


def heard(node: ImuNode, outbox: Outbox) -> list[dict[str, float]]:
    frames = [CODEC.named(CODEC.receive(data)) for key, data in outbox if key == CODEC.key]
    outbox.clear()
    return frames


def test_it_reports_lean_and_rate_with_delay_and_error():
    outbox: Outbox = []
    node = ImuNode(IMU, CRANE, outbox, STEP_NS, seed=3)
    said, true = [], []
    for k in range(4000):
        now_s = k * STEP_NS * 1e-9
        node.observe((0.2 * math.sin(3.5 * now_s), -0.1 * math.cos(3.5 * now_s)))
        node.tick(START_NS + k * STEP_NS)
        for frame in heard(node, outbox):
            late_s = now_s - LATENCY_NS * 1e-9
            said.append([frame[name] for name in SIGNALS])
            true.append(
                [
                    0.2 * math.sin(3.5 * late_s),
                    -0.1 * math.cos(3.5 * late_s),
                    0.7 * math.cos(3.5 * late_s),
                    0.35 * math.sin(3.5 * late_s),
                ]
            )
    assert len(said) == 999, "nothing was felt when the first was due"
    off = [[s - t for s, t in zip(a, b, strict=True)] for a, b in zip(said[5:], true[5:], strict=True)]
    means = [sum(column) / len(off) for column in zip(*off, strict=True)]
    spreads = [math.sqrt(sum((row[i] - m) ** 2 for row in off) / len(off)) for i, m in enumerate(means)]
    assert all(0.0 < abs(m) < 3.0 * MOUNTING_RAD for m in means[:2])
    assert means[2:] == pytest.approx([0.0, 0.0], abs=1e-3)
    assert spreads == pytest.approx([LEAN_NOISE_RAD] * 2 + [RATE_NOISE_RAD_S] * 2, rel=0.2)


def test_a_cut_cable_is_silent():
    outbox: Outbox = []
    node = ImuNode(IMU, CRANE, outbox, STEP_NS, seed=3)
    for k in range(40):
        node.silent = k >= 20
        node.observe((0.0, 0.0))
        node.tick(START_NS + k * STEP_NS)
        if k == 19:
            assert heard(node, outbox)
    assert not outbox


@pytest.mark.parametrize("slew", [0.0, 1.0])
@pytest.mark.parametrize(("hinge", "outward", "left"), [("hanger", 1.0, 0.0), ("fork", 0.0, 1.0)])
def test_the_lean_is_the_grapples_direction_from_its_pin(slew, hinge, outward, left):
    world = open_world(PLAIN, home={"slew": slew})
    try:
        body = world.crane
        for sign in (1.0, -1.0):
            body.place({hinge: world.q[hinge] + sign * 0.1})
            radial, tangential = world.lean_rad()
            (px, py, _), (x, y, _) = body.pose("hanger")[0], body.pose("rotator")[0]
            turn = slew + PLAIN.kinematics.theta1_offset_rad
            out = (x - px) * math.cos(turn) + (y - py) * math.sin(turn)
            side = (y - py) * math.cos(turn) - (x - px) * math.sin(turn)
            assert (radial, tangential) == pytest.approx((sign * 0.1 * outward, sign * 0.1 * left), abs=0.02)
            assert (out if outward else side) * (radial if outward else tangential) > 0.0
            body.place({hinge: world.q[hinge]})
    finally:
        world.close()


def frames(profile, ticks: int) -> list[tuple[str, int, bytes]]:
    plant = Plant(profile, 5, logs=0)
    try:
        sent = plant.step(START_NS, [("crane0", Frame(START_NS, *nmt_frame(NmtCommand.START)))])
        for k in range(1, ticks):
            now_ns = START_NS + k * 5_000_000
            sent += plant.step(now_ns, [("crane0", Frame(now_ns - 5_000_000, *sync_frame(k % 240 + 1)))])
        return sent
    finally:
        plant.close()


def test_only_a_machine_with_an_imu_sends_it_and_all_other_frames_are_equal():
    plain, sensing = frames(PLAIN, 100), frames(SENSING, 100)
    assert not [key for _, key, _ in plain if key in OWN_KEYS]
    own = [(key, data) for _, key, data in sensing if key in OWN_KEYS]
    assert own[0] == (0x723, b"\x00")
    assert 45 <= sum(key == CODEC.key for key, _ in own) <= 51
    assert [frame for frame in sensing if frame[1] not in OWN_KEYS] == plain
