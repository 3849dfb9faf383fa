"""Every reason to refuse a setpoint, each with a setpoint that differs from a good one in that respect only."""

import math
import struct
import zlib

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from can_dbc.messages.crane import OperatorAction, StateReport
from can_dbc.messages.datagrams import encode
from can_dbc.messages.envelope import DatagramFault
from can_dbc.messages.vehicle import DriveSetpoint, Steering
from controller.crane.reference_governor import extremes, hermite, peak_speed
from machine.status.modes import Mode
from machine.status.reasons import Reason
from tests.controller.bench import MS, SETTINGS, Bench

ZERO = [0.0] * 5
HASH = SETTINGS.profile_hash


def at(bench, j=None, by=0.0):
    q = list(bench.controller.reference_position)
    if j is not None:
        q[j] += by
    return q


def speed(j, v):
    return [v if i == j else 0.0 for i in range(5)]


def refresh_crc(data: bytes) -> bytes:
    return data[:-4] + struct.pack("<I", zlib.crc32(data[:-4]))


def far_knots(b, j, by, after_ms=400):
    return [(0, at(b), ZERO), (after_ms, at(b, j, by), ZERO)]


def stamped(b):
    return 99, HASH, b.now_ns, 200 * MS


DRIVE = (63.0, 19.0, 0.0, 0.0, 0.5, (0.3,) * 4, False, False)
REPORT = ((0.0,) * 5, (0.0,) * 5, (0.0,) * 5, 0.0, 0.0, 0.0, 0, 0, 0, 0)
BAD = {
    "wrong profile": (Reason.WRONG_PROFILE, 0, lambda b: b.hold(profile_hash=HASH ^ 1)),
    "replayed": (Reason.OUT_OF_ORDER, 0, lambda b: b.hold(sequence=1)),
    "stamp of the past": (Reason.OUT_OF_ORDER, 0, lambda b: b.hold(stamp_ns=5)),
    "stamp of the future": (Reason.STAMP_FUTURE, 0, lambda b: b.hold(stamp_ns=b.now_ns + 50 * MS)),
    "too late": (Reason.STAMP_OLD, 0, lambda b: b.hold(lease_ms=1, stamp_ns=b.now_ns)),
    "lease too long": (Reason.LEASE_TOO_LONG, 0, lambda b: b.hold(lease_ms=201)),
    "out of range": (Reason.JOINT_RANGE, 1, lambda b: b.setpoint([(0, at(b), ZERO), (9000, at(b, 1, 0.9), ZERO)])),
    "first knot out of range": (Reason.JOINT_RANGE, 3, lambda b: b.setpoint([(0, at(b, 3, 9.0), ZERO)])),
    "overshoot out of range": (
        Reason.JOINT_RANGE,
        1,
        lambda b: b.setpoint(
            [(0, at(b), ZERO), (8000, at(b, 1, 0.8), speed(1, 0.1)), (10000, at(b, 1, 0.8), speed(1, -0.1))]
        ),
    ),
    "knot too fast": (Reason.JOINT_SPEED, 0, lambda b: b.setpoint([(0, at(b), ZERO), (400, at(b), speed(0, 0.4))])),
    "too fast between knots": (Reason.JOINT_SPEED, 2, lambda b: b.setpoint(far_knots(b, 2, 0.1))),
    "position jump": (Reason.REFERENCE_JUMP, 0, lambda b: b.setpoint([(0, at(b, 0, 0.05), ZERO)])),
    "velocity jump": (
        Reason.REFERENCE_JUMP,
        0,
        lambda b: b.setpoint([(0, at(b), speed(0, 0.3)), (400, at(b, 0, 0.12), speed(0, 0.3))]),
    ),
    "final but moving": (
        Reason.FINAL_MOVING,
        0,
        lambda b: b.setpoint([(0, at(b), ZERO), (400, at(b, 0, 0.01), speed(0, 0.05))], final=True),
    ),
    "drive": (Reason.CANNOT_DRIVE, 0, lambda b: encode(DriveSetpoint(*stamped(b), Steering.WAYPOINT, *DRIVE))),
    "a report": (Reason.DATAGRAM_KIND, 0, lambda b: encode(StateReport(1, HASH, b.now_ns, *[0] * 7, *REPORT))),
    "arm by a planner": (Reason.NO_AUTHORITY, 0, lambda b: b.operator(OperatorAction.ARM)),
    "truncated": (Reason.DATAGRAM_CRC, 0, lambda b: b.hold()[:-1]),
    "short": (Reason.DATAGRAM_LENGTH, 0, lambda b: b"\x54"),
    "no magic": (Reason.DATAGRAM_MAGIC, 0, lambda b: b"?" + b.hold()[1:]),
    "other version": (Reason.DATAGRAM_VERSION, 0, lambda b: b.hold()[:4] + b"\x09\x00" + b.hold()[6:]),
    "unknown kind": (Reason.DATAGRAM_KIND, 0, lambda b: refresh_crc(b.hold()[:6] + b"\x63\x00" + b.hold()[8:])),
    "bit flip": (Reason.DATAGRAM_CRC, 0, lambda b: b.hold()[:40] + b"\xff" + b.hold()[41:]),
    "not finite": (Reason.DATAGRAM_NOT_FINITE, 0, lambda b: b.setpoint([(0, [math.nan] * 5, ZERO)])),
    "infinite velocity": (Reason.DATAGRAM_NOT_FINITE, 0, lambda b: b.setpoint([(0, at(b), [math.inf] * 5)])),
    "unknown grapple command": (
        Reason.DATAGRAM_VALUE,
        0,
        lambda b: refresh_crc(b.hold()[:28] + b"\x09" + b.hold()[29:]),
    ),
}


@pytest.mark.parametrize("name", BAD)
def test_setpoint_is_refused_with_its_reason_and_nothing_moves(name):
    reason, detail, make = BAD[name]
    bench = Bench().armed()
    bench.tick([bench.hold()])
    bench.run(2)
    before = bench.controller.gate.refused
    lease_end = bench.controller.crane.lease_end_ns
    bench.tick_with([make(bench)])
    gate = bench.controller.gate
    assert (gate.refusal, gate.detail, gate.refused) == (reason, detail, before + 1)
    assert bench.controller.crane.lease_end_ns == lease_end and bench.mode is Mode.ACTIVE
    bench.run(4)
    if bench.reports:
        assert bench.reports[-1].refusal == reason | detail << 8


def test_every_refusal_reason_is_tried():
    unreachable = {Reason.DATAGRAM_AUTHENTICATION, Reason.NOT_ARMED}  # own tests below
    unreachable |= {Reason.TEST_FUNCTION, Reason.TEST_SPOOL, Reason.TEST_BUSY}  # in test_spool_tests
    unreachable |= {r for r in Reason if Reason.DRIVE_SPEED <= r <= Reason.CARRIER_MOVES}  # in test_drive_setpoints
    unreachable |= {Reason.BELOW_GROUND, Reason.KEEP_OUT, Reason.RAISES_MOMENT}  # in test_workspace and test_load
    tried = {reason for reason, _, _ in BAD.values()} | unreachable
    assert tried == {r for r in Reason if r > 100}
    assert {100 + f for f in DatagramFault} <= set(Reason)


def test_setpoint_is_refused_while_not_armed():
    bench = Bench().boot()
    bench.tick([bench.hold()])
    assert bench.mode is Mode.STANDBY and bench.controller.gate.refusal is Reason.NOT_ARMED


def test_datagrams_of_strangers_are_counted_and_stop_nothing():
    """Whoever has no key sends what he likes: the planner, who has one, goes on."""
    bench = Bench().active()
    before = bench.controller.gate.refused
    for _ in range(5):
        bench.tick_with(planner=[b"", b"", b""])
    assert bench.mode is Mode.ACTIVE and bench.controller.gate.refused == before + 15
    assert bench.controller.gate.refusal is Reason.DATAGRAM_AUTHENTICATION


def test_strangers_hide_no_refusals_of_the_planner():
    bench = Bench().active()
    bench.tick_with(planner=[b"", b"\x54", b"", b"", b"\x54", b""])
    assert bench.mode is Mode.ACTIVE
    bench.tick_with(planner=[b"", b"\x54"])
    assert bench.mode is Mode.STOP


def test_new_session_may_count_from_the_beginning_but_not_go_back_in_time():
    bench = Bench().active()
    old = bench.moving(0, 0.08)
    bench.press(2)
    bench.run(40)
    assert bench.press(1) is Mode.ARMED
    bench.tick([old])
    assert bench.mode is Mode.ARMED, "a replay from the last session"
    bench.tick([bench.hold(sequence=0)])
    assert bench.mode is Mode.ACTIVE


def test_stamp_may_lead_the_nominal_time_by_the_lateness():
    bench = Bench().armed()
    bench.tick([bench.hold(stamp_ns=bench.now_ns + 7 * MS)])
    assert bench.mode is Mode.ARMED
    bench.tick([bench.hold(stamp_ns=bench.now_ns + 7 * MS)], late_ns=3 * MS)
    assert bench.mode is Mode.ACTIVE


piece = st.tuples(*[st.floats(-3, 3), st.floats(-1, 1), st.floats(-3, 3), st.floats(-1, 1), st.floats(0.01, 5)])


@given(piece)
@settings(max_examples=200, deadline=None)
def test_peak_and_extremes_bound_the_cubic(p):
    p0, v0, p1, v1, h = p
    samples = [hermite(p0, v0, p1, v1, h, i / 200) for i in range(201)]
    assert samples[0] == pytest.approx((p0, v0)) and samples[-1] == pytest.approx((p1, v1), abs=1e-6)
    low, high = extremes(*p)
    assert low - 1e-9 <= min(q for q, _ in samples) and max(q for q, _ in samples) <= high + 1e-9
    assert low >= min(q for q, _ in samples) - 0.02 * h and high <= max(q for q, _ in samples) + 0.02 * h
    peak = peak_speed(*p)
    fastest = max(abs(v) for _, v in samples)
    assert fastest - 1e-9 <= peak <= fastest * 1.01 + 1e-3
    k = 100
    slope = (samples[k + 1][0] - samples[k - 1][0]) / (2 * h / 200)
    assert slope == pytest.approx(samples[k][1], abs=0.01 * (1 + peak))
