"""Drive setpoints: every reason for refusal, the lease, the stop, and crane and carrier one at a time."""

import math
from itertools import islice

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from can_dbc.messages.crane import OperatorAction, SpoolKnot, SpoolTest
from can_dbc.messages.datagrams import encode
from can_dbc.messages.vehicle import DriveSetpoint, Driving, Steering
from controller.step import step
from controller.tick import Inputs
from machine.joints import Joint
from machine.status.modes import Mode
from machine.status.reasons import Reason
from tests.controller.bench import AORO, GNSS, MACHINE, bytes_kept, count_until
from tests.controller.drive_bench import CARRIER, MS, TRANSPORT, DriveBench, T

LIMIT = CARRIER.articulation_limit_rad
RATE = CARRIER.articulation_rate_limit_rad_s
TOP = CARRIER.speed_limit_m_s


def high(i, by=0.01):
    return tuple(CARRIER.arm_travel_m + by if k == i else 0.3 for k in range(4))


BAD = {
    "wrong profile": (Reason.WRONG_PROFILE, 0, lambda b: b.to(9, 0, profile_hash=1)),
    "replayed": (Reason.OUT_OF_ORDER, 0, lambda b: b.to(9, 0, sequence=1)),
    "stamp of the past": (Reason.OUT_OF_ORDER, 0, lambda b: b.to(9, 0, stamp_ns=5)),
    "stamp of the future": (Reason.STAMP_FUTURE, 0, lambda b: b.to(9, 0, stamp_ns=b.now_ns + 50 * MS)),
    "too late": (Reason.STAMP_OLD, 0, lambda b: b.to(9, 0, lease_ms=1)),
    "lease too long": (Reason.LEASE_TOO_LONG, 0, lambda b: b.to(9, 0, lease_ms=201)),
    "too fast": (Reason.DRIVE_SPEED, 0, lambda b: b.to(9, 0, TOP + 0.01)),
    "too fast backwards": (Reason.DRIVE_SPEED, 0, lambda b: b.bend(0.0, speed_m_s=-TOP - 0.01)),
    "backwards to a waypoint": (Reason.DRIVE_SPEED, 0, lambda b: b.to(9, 0, -0.1)),
    "waypoint far away": (Reason.DRIVE_WAYPOINT, 0, lambda b: b.to(501, 60)),
    "waypoint in another country": (Reason.DRIVE_WAYPOINT, 0, lambda b: b.drive_setpoint(latitude_deg=19.9)),
    "no latitude": (Reason.DRIVE_WAYPOINT, 0, lambda b: b.drive_setpoint(latitude_deg=1e300)),
    "no longitude": (Reason.DRIVE_WAYPOINT, 0, lambda b: b.drive_setpoint(longitude_deg=-180.1)),
    "bent too far": (Reason.DRIVE_ARTICULATION, 0, lambda b: b.bend(-LIMIT - 0.01)),
    "bent too fast": (Reason.DRIVE_ARTICULATION, 0, lambda b: b.bend(0.0, RATE + 0.01)),
    "arm too high": (Reason.DRIVE_HEIGHT, 2, lambda b: b.to(9, 0, heights_m=high(2))),
    "arm too low": (Reason.DRIVE_HEIGHT, 1, lambda b: b.to(9, 0, heights_m=(0.1, -0.01, 0.1, 0.1))),
    "both axles float": (Reason.FLOAT_BOTH, 0, lambda b: b.to(9, 0, float_front=True, float_rear=True)),
}
EDGES = {
    "the fastest": lambda b: b.to(9, 0, TOP),
    "the fastest backwards": lambda b: b.bend(0.0, speed_m_s=-TOP),
    "bent to the limit": lambda b: b.bend(LIMIT, -RATE),
    "a far waypoint": lambda b: b.to(498, 0),
    "both ends of the travel": lambda b: b.to(9, 0, heights_m=(0.0, CARRIER.arm_travel_m, 0.0, 0.6)),
    "the front floats": lambda b: b.to(9, 0, float_front=True),
    "the rear floats": lambda b: b.to(9, 0, float_rear=True),
    "the longest lease": lambda b: b.to(9, 0, lease_ms=200),
}


def ready() -> DriveBench:
    bench = DriveBench().armed()
    bench.run(40)
    return bench


@pytest.fixture(scope="module")
def standing() -> DriveBench:
    bench = ready()
    bench.tick([bench.to(9, 0, 0.0)])
    assert bench.mode is Mode.ACTIVE
    return bench


@pytest.mark.parametrize("name", BAD)
def test_drive_setpoint_is_refused_with_its_reason_and_changes_nothing(name, standing):
    reason, detail, make = BAD[name]
    standing.run(201)  # the third refusal within a second would hold the machine
    standing.tick([standing.to(9, 0, 0.0, lease_ms=200)])
    vehicle = standing.vehicle
    before, obeyed = vehicle.gate.refused, vehicle.setpoint
    standing.tick([make(standing)])
    assert (vehicle.gate.refusal, vehicle.gate.detail, vehicle.gate.refused) == (reason, detail, before + 1)
    assert vehicle.setpoint is obeyed and standing.mode is Mode.ACTIVE
    assert standing.controller.gate.refused == 0, "the crane's refusals are counted apart"
    standing.run(10)
    assert standing.last_report.refusal == reason | detail << 8
    assert standing.last_report.refused == (before + 1) & 0xFFFF


@pytest.mark.parametrize("name", EDGES)
def test_drive_setpoint_at_the_limit_is_accepted(name):
    bench = ready()
    bench.tick([EDGES[name](bench)])
    assert bench.mode is Mode.ACTIVE and bench.vehicle.gate.refused == 0


def test_not_armed():
    bench = DriveBench().boot()
    bench.tick([bench.to(9, 0)])
    assert bench.mode is Mode.STANDBY and bench.vehicle.gate.refusal is Reason.NOT_ARMED
    assert bench.vehicle.driving is Driving.STANDING


@pytest.mark.parametrize(
    ("lie", "reason"),
    [
        ({"PositionRapidUpdate": {"Latitude": None, "Longitude": None}}, Reason.POSITION_LOST),
        ({"VesselHeading": {"Heading": None}}, Reason.HEADING_LOST),
        ({"VesselHeading": {"Reference": 1}}, Reason.HEADING_LOST),
        ({"GnssPositionData": {"Method": 1}}, Reason.FIX_LOST),
        ({"VehStat": {"Fault": 1}}, Reason.CARRIER_FAULT),
        ({"ArmHeightA": {"State": 3}}, Reason.ARMS_FAULT),
        ({"ArmHeightB": {"Roll": 20.0}}, Reason.TILTED),
    ],
)
def test_missing_inputs_refuse_a_drive(lie, reason):
    bench = ready()
    bench.lies = lie
    bench.run(220)
    bench.tick([bench.to(9, 0)])
    assert bench.vehicle.gate.refusal is reason and bench.mode is Mode.ARMED
    bench.tick([bench.bend(0.0)])
    of_gnss = reason in (Reason.POSITION_LOST, Reason.HEADING_LOST, Reason.FIX_LOST)
    assert (bench.mode is Mode.ACTIVE) is of_gnss, "an angle of the articulation needs no GNSS"


def test_three_refusals_within_a_second_stop_a_driving_machine():
    bench = DriveBench().under_way(120)
    for k in range(3):
        assert bench.mode is Mode.ACTIVE, k
        bench.tick([bench.to(9, 0, TOP + 1.0)])
    assert bench.mode is Mode.STOP and bench.reason == Reason.SETPOINTS_REFUSED


def test_three_unreadable_datagrams_within_a_second_stop_a_driving_machine():
    """Nobody can tell for whom they were: they count for whatever moves.  The lease would stop it 50 ms later."""
    bench = DriveBench().under_way(120)
    for sent in (b"?", b"rubbish"):
        bench.tick([sent])
        assert bench.run(9) is Mode.ACTIVE
    bench.tick([bench.to(50, 0, math.nan)])
    assert bench.mode is Mode.STOP and bench.reason == Reason.SETPOINTS_REFUSED
    assert bench.vehicle.gate.refused == bench.controller.gate.refused == 3


def test_what_an_operator_sends_is_no_refused_drive_setpoint():
    bench = DriveBench().under_way(120)
    for _ in range(3):
        bench.tick_with([bench.to(50, 0)], [b"rubbish"])
    assert bench.mode is Mode.ACTIVE and bench.vehicle.gate.refused == 0


def test_refused_crane_setpoints_do_not_stop_a_driving_machine():
    bench = DriveBench().under_way(120)
    for _ in range(3):
        bench.tick([bench.to(50, 0), crane_to(bench, 0.1)])
    assert bench.mode is Mode.ACTIVE and bench.controller.gate.refused == 3


def test_lease_that_ends_while_driving_stops_smoothly_and_nothing_starts_again():
    bench = DriveBench().under_way(300)
    assert bench.speed_m_s == pytest.approx(0.6, abs=0.01)
    bench.tick([bench.to(50, 0, lease_ms=100)])
    assert bench.run(18) is Mode.ACTIVE and not bench.braked
    assert bench.run(1) is Mode.STOP and bench.reason == Reason.LEASE_LOST
    assert bench.vehicle.driving is Driving.BRAKING
    speeds = []
    for _ in range(140):
        before = bench.speed_m_s
        bench.tick([bench.to(50, 0)])
        speeds.append((before - bench.speed_m_s) / (T * 1e-9))
        assert bench.drive_command["ArticRate"] == 0.0 or bench.vehicle.driving is not Driving.BRAKING
    assert max(speeds) < 5.1 and bench.speed_m_s == 0.0 and bench.braked
    assert bench.mode is Mode.STOP and bench.vehicle.driving is Driving.STANDING
    bench.run(100)
    bench.go(10)
    assert bench.mode is Mode.STOP and bench.braked, "only a human arms again"
    bench.press(OperatorAction.ARM)
    bench.go(60)
    assert bench.mode is Mode.ACTIVE and not bench.braked


def test_inputs_are_checked_during_the_stop_after_a_lost_lease():
    bench = DriveBench().under_way(300)
    assert bench.run(45) is Mode.STOP and bench.vehicle.driving is Driving.BRAKING
    bench.dropped.add("VehStat")
    assert bench.run(20) is Mode.FAULT and bench.reason == Reason.CARRIER_LOST and bench.drive_command["ArmKey"] == 0


def test_lease_that_ends_at_standstill_is_no_fault():
    bench = ready()
    bench.tick([bench.to(9, 0, 0.0, heights_m=(0.2,) * 4)])
    assert bench.run(20) is Mode.ACTIVE and bench.braked and bench.drive_command["ArmKey"] == 0xA
    assert bench.run(25) is Mode.ARMED and bench.reason == Reason.NONE and bench.drive_command["ArmKey"] == 0
    assert bench.machine_commands["ArmCmdA"]["Arm1"] == 0.0


def test_stop_by_the_operator_stops_the_carrier():
    bench = DriveBench().under_way(300)
    assert bench.press(OperatorAction.STOP) is Mode.STOP and bench.vehicle.driving is Driving.BRAKING
    bench.run(200)
    assert bench.speed_m_s == 0.0 and bench.braked and bench.drive_command["ArmKey"] == 0


def test_fault_that_latches_brakes_at_once():
    bench = DriveBench().under_way(300)
    bench.lies = {"VehStat": {"Fault": 2}}
    count_until(bench.tick, lambda: bench.mode is not Mode.ACTIVE, 10)
    assert bench.reason == Reason.CARRIER_FAULT
    assert bench.braked and bench.drive_command["ArmKey"] == 0, "in the same tick, not with the next period"


def test_new_session_restarts_the_sequence():
    bench = DriveBench().under_way(60)
    old = bench.to(50, 0, stamp_ns=bench.now_ns - 150 * MS, lease_ms=200)
    bench.press(OperatorAction.STOP)
    bench.run(35)
    bench.press(OperatorAction.ARM)
    bench.tick([old])
    assert bench.mode is Mode.ARMED and bench.vehicle.gate.refusal is Reason.OUT_OF_ORDER
    bench.tick([bench.to(50, 0, sequence=0)])
    assert bench.mode is Mode.ACTIVE


def crane_to(bench: DriveBench, by: float) -> bytes:
    there = [r if r == r else 0.0 for r in bench.controller.reference_position]
    end = list(there)
    end[Joint.SLEW] += by
    return bench.setpoint([(0, there, (0.0,) * 5), (2000, end, (0.0,) * 5)])


def test_crane_may_be_held_but_not_moved_while_driving():
    bench = DriveBench().under_way(200)
    bench.tick([crane_to(bench, 0.1)])
    assert bench.controller.gate.refusal is Reason.CARRIER_MOVES and bench.mode is Mode.ACTIVE
    assert bench.neutral
    bench.tick([crane_to(bench, 0.0)])
    assert bench.controller.gate.refused == 1 and bench.controller.crane.leased
    test = SpoolTest(9999, bench.settings.profile_hash, bench.now_ns, 200 * MS, 0, (SpoolKnot(0, 0.0),))
    bench.tick([encode(test)])
    assert bench.controller.gate.refusal is Reason.CARRIER_MOVES and bench.controller.gate.refused == 2


def test_crane_may_move_while_the_carrier_creeps():
    bench = DriveBench().under_way(200, speed_m_s=0.08)
    bench.tick([crane_to(bench, 0.1)])
    assert bench.controller.gate.refused == 0 and bench.controller.crane.leased


def test_drive_is_refused_while_the_crane_moves():
    bench = ready()
    bench.tick([bench.hold()])
    bench.drive(0, 0.08, 60)
    bench.tick([bench.to(9, 0), bench.moving(0, 0.08)])
    assert bench.vehicle.gate.refusal is Reason.CRANE_MOVES and bench.vehicle.setpoint is None
    assert bench.braked and bench.drive_command["ArmKey"] == 0
    bench.press(OperatorAction.STOP)
    bench.run(60)
    bench.press(OperatorAction.ARM)
    bench.go(20)
    assert bench.mode is Mode.ACTIVE and bench.vehicle.driving is Driving.DRIVING


def test_crane_and_carrier_have_separate_leases():
    bench = DriveBench().under_way(200, speed_m_s=0.0)
    bench.tick([crane_to(bench, 0.0)])
    bench.go(10, speed_m_s=0.0)
    assert bench.controller.crane.leased and bench.vehicle.setpoint is not None
    final = bench.hold(final=True)
    bench.tick([final])
    bench.go(60, speed_m_s=0.0)
    assert not bench.controller.crane.leased and bench.mode is Mode.ACTIVE, "the drive continues"
    assert bench.run(45) is Mode.ARMED


def test_lost_lease_of_the_crane_stops_the_carrier_as_well():
    bench = DriveBench().under_way(200)
    bench.tick([crane_to(bench, 0.0)])
    bench.go(45)
    assert bench.mode is Mode.STOP and bench.reason == Reason.LEASE_LOST
    assert bench.vehicle.driving is Driving.BRAKING


def test_float_valves_open_only_while_rolling():
    bench = ready()
    bench.tick([bench.to(9, 0, 0.0, float_rear=True)])
    bench.run(8)
    assert bench.machine_commands["ArmCmdB"]["FloatRear"] == 0
    bench.go(30, float_rear=True)
    assert bench.machine_commands["ArmCmdB"] | {"FloatRear": 1, "FloatFront": 0} == bench.machine_commands["ArmCmdB"]
    bench.go(200, speed_m_s=0.0, float_rear=True)
    assert bench.machine_commands["ArmCmdB"]["FloatRear"] == 0 and bench.braked


def test_vehicle_report_carries_known_values():
    bench = DriveBench().under_way(400, 20.0, 20.0)
    report = bench.last_report
    assert len(bench.vehicle_reports) == pytest.approx(bench.count / 10, abs=2)
    assert report.driving == Driving.DRIVING and report.stale_mask == 0
    assert (report.fix, report.satellites) == (4, 19) and report.sigma_m == pytest.approx(0.0105)
    assert report.heading_rad == pytest.approx(math.pi / 2 - bench.yaw_rad, abs=0.05)
    assert report.yaw_rate_rad_s > 0.05, "positive when it turns left"
    assert report.articulation_rad == pytest.approx(bench.bend_rad, abs=0.01)
    assert report.speed_m_s == pytest.approx(bench.speed_m_s, abs=0.01)
    assert report.heights_m == pytest.approx(TRANSPORT, abs=0.002)
    for stamp_ns, age_ms in ((report.position_ns, 105), (report.heading_ns, 105), (report.motion_ns, 25)):
        assert 0 < report.stamp_ns - stamp_ns <= age_ms * MS
    assert report.drive_sequence == bench.vehicle.gate.sequence > 0


def test_vehicle_report_carries_nan_for_unknown_values():
    bench = DriveBench()
    bench.dropped |= {"PositionRapidUpdate", "VesselHeading", "RateOfTurn", "GnssPositionData"}
    bench.run(40)
    report = bench.last_report
    assert report.stale_mask & 0b1111000 == 0b1111000
    unknown = (report.latitude_deg, report.altitude_m, report.sigma_m, report.heading_rad, report.yaw_rate_rad_s)
    assert all(map(math.isnan, unknown)) and report.position_ns == report.heading_ns == report.fix == 0


OWN = {"VehCmd", "ArmCmdA", "ArmCmdB", "CtrlAlive", "AddressClaim"}  # these would end it at once
MACHINE_KEYS = [m.key for m in (*MACHINE.messages.values(), *GNSS.messages.values()) if m.name not in OWN]
number = st.one_of(st.floats(-2.0, 2.0), st.floats(allow_nan=True, allow_infinity=True))
wild = st.builds(
    DriveSetpoint,
    st.integers(0, 2**32 - 1),
    st.just(AORO.profile_hash),
    st.integers(0, 6_000 * MS),
    st.integers(0, 600 * MS),
    st.sampled_from(Steering),
    *[number] * 5,
    st.tuples(*[number] * 4),
    *[st.booleans()] * 3,
)
near = st.fixed_dictionaries(
    {
        "steering": st.sampled_from(Steering),
        "articulation_rad": st.floats(-0.6, 0.6),
        "articulation_rate_rad_s": st.floats(-0.2, 0.2),
        "speed_m_s": st.floats(-1.0, 1.0),
        "heights_m": st.tuples(*[st.floats(0.0, 0.6)] * 4),
        "float_front": st.booleans(),
        "float_rear": st.booleans(),
        "level": st.booleans(),
        "lease_ms": st.integers(1, 200),
    }
)
noise = st.lists(st.tuples(st.sampled_from(MACHINE_KEYS), st.binary(max_size=8)), max_size=4)
hostile = st.lists(st.tuples(st.one_of(wild.map(encode), near, st.none()), noise, st.integers(1, 12)), max_size=12)


@given(hostile)
@settings(max_examples=20, deadline=None)
def test_random_input_never_raises_or_leaves_the_envelope_of_the_carrier(script):
    bench = DriveBench().armed()
    for request, frames, ticks in script:
        bench.machine_extra += frames
        datagram = bench.drive_setpoint(**request) if isinstance(request, dict) else request
        bench.tick([datagram] if datagram else [])
        for _ in range(ticks):
            bench.tick()
            drive, floats = bench.drive_command, bench.machine_commands["ArmCmdB"]
            assert abs(drive["Speed"]) <= TOP and abs(drive["ArticRate"]) <= RATE + 1e-4
            assert floats["FloatFront"] + floats["FloatRear"] <= 1
            if bench.mode not in (Mode.ACTIVE, Mode.STOP):
                assert bench.braked and drive["ArmKey"] == 0 and floats["FloatFront"] == floats["FloatRear"] == 0


@pytest.mark.long
def test_driving_keeps_no_memory():
    """Repeat the same inputs on a second controller and measure its memory."""
    bench = DriveBench().armed()
    tape = []
    for k in range(2400):
        datagrams = [bench.to(60.0, 20.0) if k // 400 % 2 else bench.bend(0.1)] if k % 10 == 0 else []
        bench.tick(datagrams)
        tape.append((bench.inputs.frames, bench.inputs.machine_frames, datagrams, bench.now_ns))
    assert bench.vehicle.driving is Driving.DRIVING
    twin, inputs = DriveBench().armed(), Inputs()

    rest = iter(tape)

    def ticks(count):
        for inputs.frames, inputs.machine_frames, inputs.datagrams, now_ns in islice(rest, count):
            step(twin.controller, inputs, now_ns)

    assert bytes_kept(ticks, 600) < 2048
    assert twin.vehicle.driving is Driving.DRIVING and twin.vehicle.gate.sequence == bench.vehicle.gate.sequence
