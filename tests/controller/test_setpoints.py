"""Every reason to refuse a setpoint, each with one that differs from a good one in that only; and the workspace."""

import itertools
import math
import struct
import zlib

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from can_dbc.messages.crane import Knot, OperatorAction, StateReport
from can_dbc.messages.datagrams import encode
from can_dbc.messages.envelope import DatagramFault
from can_dbc.messages.vehicle import DriveSetpoint, Steering
from controller.crane.reference_governor import extremes, hermite, peak_speed
from controller.crane.trajectory_check import MAX_KNOTS_CHECKED, WorkspaceCheck
from controller.requests import RequestRefused
from machine.geometry.bunk import stake_walls
from machine.geometry.grapple import FIXED_GROUND_M
from machine.geometry.kinematics import Unreachable, pin_position, solve
from machine.loading.profile_file import load_profile
from machine.profile import KeepOut
from machine.status.modes import Mode
from machine.status.reasons import Reason
from tests.controller.bench import MS, PROFILE, SETTINGS, Bench, settings_of

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
    unreachable |= {Reason.BELOW_GROUND, Reason.KEEP_OUT, Reason.RAISES_MOMENT}  # below and in test_load
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


# -- where the boom tip may go: ground, stakes and the profile's boxes; a setpoint that leads there is refused

KIN = PROFILE.kinematics
HANG_M = KIN.hanger_to_fork_m + KIN.fork_to_rotator_m
ABOVE = (-1.8, 4.4, 0.5)


def solved(point):
    return (*solve(PROFILE, *point), 0.0)


def knots(*points):
    return [Knot(i * 50_000_000, solved(p), ZERO) for i, p in enumerate(points)]


def refusal(check, *points):
    """The reason why a new check refuses a way that begins at the first point, where the reference is."""
    check.forget()
    try:
        check.check(solved(points[0]), knots(*points))
    except RequestRefused as refused:
        return refused.reason
    return Reason.NONE


def test_ground_is_refused_from_above_and_a_way_out_is_not():
    """The open grapple may stand a little lower than the ground should be; a closed one never comes there."""
    check = WorkspaceCheck(PROFILE)
    lowest = PROFILE.workspace.ground_z_m - FIXED_GROUND_M + PROFILE.grapple.jaws.tip_below_pin_m[0]
    x, y, _ = ABOVE
    assert refusal(check, ABOVE, (x, y, lowest + 0.01)) is Reason.NONE
    assert refusal(check, ABOVE, (x, y, lowest - 0.01)) is Reason.BELOW_GROUND
    assert refusal(check, (x, y, lowest - 0.2), (x, y, lowest - 0.1)) is Reason.NONE, "upward out of the ground"
    assert refusal(check, (x, y, lowest - 0.1), (x, y, lowest - 0.2)) is Reason.BELOW_GROUND


@pytest.mark.parametrize("row", [0, 1])
def test_stakes_are_refused_and_their_number_is_told(row):
    check, wall = WorkspaceCheck(PROFILE), stake_walls(PROFILE.bunk)[row]
    x, y, z = wall.center_m
    top = z + wall.half_m[2]
    with pytest.raises(RequestRefused) as refused:
        check.check(solved((x, y, top + 1.0)), knots((x, y, top + 1.0), (x, y, top + HANG_M - 0.02)))
    assert (refused.value.reason, refused.value.detail) == (Reason.KEEP_OUT, row)
    assert refusal(check, (x, y, top + 1.0), (x, y, top + HANG_M + 0.02)) is Reason.NONE, "over the stakes"
    bunk = PROFILE.bunk.center_m
    assert refusal(check, (*bunk, top + 1.0), (*bunk, top + HANG_M - 0.3)) is Reason.NONE, "between them"


def test_boxes_of_the_profile_are_turned_and_a_crane_inside_may_leave():
    box = KeepOut((-1.8, 4.4, 0.5), (1.0, 0.1, 0.3), 0.7853981633974483)
    check = WorkspaceCheck(msgspec.structs.replace(PROFILE, keep_out={"cabin": box}))
    along, across = (-1.8 + 0.6, 4.4 + 0.6, 0.5), (-1.8 + 0.6, 4.4 - 0.6, 0.5)
    high = (-1.8, 4.4, 1.6)
    assert refusal(check, high, along) is Reason.KEEP_OUT
    assert refusal(check, high, across) is Reason.NONE
    assert refusal(check, along, high) is Reason.NONE and refusal(check, along, (-1.8, 4.4, 0.5)) is Reason.NONE


def test_no_more_knots_than_promised_are_checked_and_the_last_always(monkeypatch):
    asked = []
    check = WorkspaceCheck(PROFILE)
    monkeypatch.setattr(
        "controller.crane.trajectory_check.pin_position", lambda kin, q: asked.append(q) or pin_position(kin, q)
    )
    for n in range(1, 17):
        asked.clear()
        path = knots(*[(x * 0.01 - 1.8, 4.4, 0.5) for x in range(n)])
        check.check(path[0].position, path)
        assert len(asked) <= 2 + MAX_KNOTS_CHECKED, "the reference's place and the first knot besides"
        assert path[0].position in asked and path[-1].position in asked


def test_what_lies_between_two_places_is_looked_at():
    """A box of 20 cm between two knots that lie 3 m apart, and one between the reference and the only knot."""
    box = KeepOut((-1.8, 4.4, 0.5), (0.1, 0.5, 0.3))
    check = WorkspaceCheck(msgspec.structs.replace(PROFILE, keep_out={"pole": box}))
    left, right = (-3.3, 3.8, 0.5), (-0.3, 4.8, 0.5)
    assert refusal(check, left, left, right) is Reason.KEEP_OUT
    with pytest.raises(RequestRefused):
        check.check(solved(left), knots(right))


def test_setpoints_that_each_lead_a_little_deeper_lead_nowhere():
    """Under the ground, where a hand lever left it, 0.9 mm a time: only the first until the machine is disarmed."""
    check = WorkspaceCheck(PROFILE)
    lowest = PROFILE.workspace.ground_z_m - FIXED_GROUND_M + PROFILE.grapple.jaws.tip_below_pin_m[0]
    x, y, _ = ABOVE

    def step(z):
        check.check(solved((x, y, z)), knots((x, y, z - 0.0009)))

    step(lowest - 0.1)
    with pytest.raises(RequestRefused):
        step(lowest - 0.1009)
    check.forget()
    step(lowest - 0.1009)


def test_the_controller_refuses_such_a_setpoint_and_keeps_what_it_does():
    bench = Bench().armed()
    bench.tick([bench.hold()])
    box = pin_position(KIN, bench.q)
    keep_out = {"pole": KeepOut((box[0], box[1], box[2] - 0.5), (0.05, 0.05, 0.05))}
    profile = msgspec.structs.replace(PROFILE, keep_out=keep_out)
    bench = Bench(settings_of(profile)).armed()
    bench.tick([bench.hold()])
    start = list(bench.controller.reference_position)
    down = [start[0], start[1] - 0.02, *start[2:]]
    refused = bench.controller.gate.refused
    bench.tick([bench.setpoint([(0, start, ZERO), (1000, down, ZERO)])])
    assert bench.controller.gate.refusal is Reason.KEEP_OUT and bench.controller.gate.refused == refused + 1
    assert bench.mode is Mode.ACTIVE
    up = [start[0], start[1] + 0.02, *start[2:]]
    bench.tick([bench.setpoint([(0, start, ZERO), (1000, up, ZERO)])])
    assert bench.controller.gate.refused == refused + 1


@pytest.mark.parametrize("name", ["palms_471", "aoro_fc8"])
def test_work_places_of_the_shipped_machines_stay_free(name):
    """The pin over every place where logs lie and in the bunk, as low as the closed jaws just reach the ground."""
    profile = load_profile(name)
    check, site, bunk = WorkspaceCheck(profile), profile.workspace, profile.bunk
    jaws = max(profile.grapple.jaws.tip_below_pin_m) - 0.35
    x, y = site.pick_center_m
    spread = (-site.pick_half_size_m, 0.0, site.pick_half_size_m)
    places = [(x + a, y + b, site.ground_z_m + jaws) for a, b in itertools.product(spread, spread)]
    places += [(*bunk.center_m, bunk.floor_z_m + jaws)]
    tried = 0
    for place in places:
        try:
            start, end = (solve(profile, place[0], place[1], z) for z in (place[2] + 1.0, place[2]))
        except Unreachable:
            continue
        check.check((*start, 0.0), [Knot(0, (*start, 0.0), ZERO), Knot(50_000_000, (*end, 0.0), ZERO)])
        tried += 1
    assert tried > 5
