"""Faults of the carrier: detection in time while the machine drives, the reaction, and no false alarms."""

import math

import pytest

from can_dbc.messages.vehicle import Driving
from controller.carrier.dead_reckoning import CROSSWISE_SAMPLES_COUNT, MAX_JUMP_M, MAX_REPEATED_JUMP_M
from controller.carrier.monitors import ARM_STUCK_NS, DISAGREE_RAD, OVERSPEED_M_S, OVERSPEED_RATIO
from controller.carrier.vehicle import RTK_FLOAT_SPEED_SHARE
from machine.joints import ARTICULATION
from machine.status.faults import FAULTS
from machine.status.modes import Mode
from machine.status.reasons import Reaction, Reason
from tests.controller.drive_bench import CARRIER, MS, DriveBench

SWAY = math.degrees(CARRIER.tilt_limit_rad)


def turning() -> DriveBench:
    """Drive through a bend to the left."""
    return DriveBench().under_way(300, 4.0, 30.0)


def aside() -> DriveBench:
    """Just commanded to turn around: it bends at its limit."""
    return DriveBench().under_way(20, 2.0, 30.0)


def straight() -> DriveBench:
    return DriveBench().under_way(250)


def until(bench: DriveBench, reason: Reason, limit_ms: int, *place: float, **fields) -> int:
    """Milliseconds until the reason is set while the planner continues; fails when it takes too long."""
    since = bench.now_ns
    while bench.now_ns - since < limit_ms * MS:
        bench.go(1, *(place or (50.0, 0.0)), **fields) if bench.count % 10 == 0 else bench.run(1)
        if bench.reason == reason:
            return (bench.now_ns - since) // MS
    raise AssertionError(f"{reason.name} not seen within {limit_ms} ms: {bench.mode.name} {bench.reason!r}")


def lose(message):
    return lambda bench: bench.dropped.add(message)


def lie(message, **values):
    """What is sent in place of the truth; a function is given the bench."""

    def inject(b):
        b.lies[message] = {name: value(b) if callable(value) else value for name, value in values.items()}

    return inject


def put(**values):
    """Something else is true from now on."""

    def inject(b):
        for name, value in values.items():
            setattr(b, name, value(b) if callable(value) else value)

    return inject


def heading(b):
    return b.changed["VesselHeading"]["Heading"]


TOO_FAST = OVERSPEED_RATIO * 0.6 + OVERSPEED_M_S + 0.02
CASES = {
    "position lost": (Reason.POSITION_LOST, straight, lose("PositionRapidUpdate")),
    "position not available": (
        Reason.POSITION_LOST,
        straight,
        lie("PositionRapidUpdate", Latitude=None, Longitude=None),
    ),
    "heading lost": (Reason.HEADING_LOST, straight, lose("VesselHeading")),
    "heading not available": (Reason.HEADING_LOST, straight, lie("VesselHeading", Heading=None)),
    "heading magnetic": (Reason.HEADING_LOST, straight, lie("VesselHeading", Reference=1)),
    "heading of unknown reference": (Reason.HEADING_LOST, straight, lie("VesselHeading", Reference=None)),
    "fix lost": (Reason.FIX_LOST, straight, lie("GnssPositionData", Method=1)),
    "position jump": (Reason.POSITION_JUMP, straight, put(east_m=lambda b: b.east_m + 3.0)),
    "heading flipped": (
        Reason.HEADING_JUMP,
        straight,
        lie("VesselHeading", Heading=lambda b: (heading(b) + math.pi) % math.tau),
    ),
    "heading frozen": (Reason.HEADING_FROZEN, turning, lie("VesselHeading", Heading=heading)),
    "carrier fault": (Reason.CARRIER_FAULT, straight, lie("VehStat", Fault=1)),
    "arms fault": (Reason.ARMS_FAULT, straight, lie("ArmHeightA", State=3)),
    "carrier fault not available": (Reason.CARRIER_FAULT, straight, lie("VehStat", Fault=None)),
    "arms state not available": (Reason.ARMS_FAULT, straight, lie("ArmHeightA", State=None)),
    "roll not available": (Reason.ARMS_FAULT, straight, lie("ArmHeightB", Roll=None)),
    "pitch not available": (Reason.ARMS_FAULT, straight, lie("ArmHeightB", Pitch=None)),
    "runaway": (Reason.CARRIER_RUNAWAY, straight, lie("VehStat", Speed=TOO_FAST)),
    "rolls back": (Reason.CARRIER_RUNAWAY, straight, lie("VehStat", Speed=-OVERSPEED_M_S - 0.02)),
    "stuck": (Reason.CARRIER_STUCK, straight, put(blocked=True, speed_m_s=0.0)),
    "steering disagrees": (
        Reason.STEERING_DISAGREES,
        straight,
        lie("VehStat", Articulation=lambda b: b.bend_rad + DISAGREE_RAD + 0.01),
    ),
    "tilted aside": (Reason.TILTED, straight, lie("ArmHeightB", Roll=SWAY + 0.5)),
    "tilted down": (Reason.TILTED, straight, lie("ArmHeightB", Pitch=-SWAY - 0.5)),
    "steering stuck": (Reason.STEERING_STUCK, aside, put(steering_gain=0.0)),
    "steering reversed": (Reason.STEERING_RUNAWAY, aside, put(steering_gain=-1.0)),
    "steering valve stuck open": (Reason.STEERING_RUNAWAY, straight, put(steering_drift=0.2)),
    "arm outside": (Reason.ARM_OUTSIDE, straight, lie("ArmHeightA", Arm3=400.0)),
}


@pytest.mark.parametrize("name", CASES)
def test_fault_is_detected_in_time_and_the_machine_stops(name):
    reason, prepare, inject = CASES[name]
    bench = prepare()
    inject(bench)
    place = {turning: (4.0, 30.0), aside: (2.0, 30.0)}.get(prepare, ())
    until(bench, reason, FAULTS[reason].bound_ms + 25, *place)  # a frame of mach0 may just have gone
    reaction = FAULTS[reason].reaction
    assert reaction >= Reaction.HOLD
    assert bench.mode is (Mode.FAULT if reaction is Reaction.CUT else Mode.STOP)
    if reaction > Reaction.HOLD:
        assert bench.braked and bench.drive_command["ArmKey"] == 0
    else:
        assert bench.vehicle.driving is Driving.BRAKING
    bench.run(300)
    assert bench.braked and bench.mode in (Mode.STOP, Mode.FAULT), "and nothing starts by itself"


GNSS = {name: case for name, case in CASES.items() if Reason.POSITION_LOST <= case[0] <= Reason.HEADING_REVERSED}


@pytest.mark.parametrize("name", GNSS)
def test_gnss_faults_do_not_stop_articulation_steering(name):
    _, _, inject = GNSS[name]
    bench = DriveBench().armed()
    bench.run(40)
    for k in range(400):
        if k == 200:
            inject(bench)
        bench.tick([bench.bend(0.1)] if k % 10 == 0 else ())
    assert bench.mode is Mode.ACTIVE and bench.vehicle.driving is Driving.DRIVING


@pytest.mark.parametrize("name", [n for n in CASES if n not in ("runaway", "rolls back")])
def test_machine_that_does_not_drive_is_not_stopped(name):
    _, _, inject = CASES[name]
    bench = DriveBench().armed()
    bench.run(60)
    inject(bench)
    assert bench.run(300) is Mode.ARMED


def test_carrier_that_rolls_under_the_crane_is_a_runaway():
    bench = DriveBench().armed()
    bench.lies["VehStat"] = {"Speed": OVERSPEED_M_S + 0.02}
    until(bench, Reason.CARRIER_RUNAWAY, FAULTS[Reason.CARRIER_RUNAWAY].bound_ms, speed_m_s=0.0)
    assert bench.mode is Mode.FAULT


def test_swapped_antennas_are_detected_in_motion():
    bench = DriveBench().armed()
    bench.yaw_rad = math.pi  # backwards to what it says
    bench.run(60)
    bench.lies["VesselHeading"] = {"Heading": math.pi / 2}
    bench.run(60)
    elapsed_ms, since = 0, None
    for k in range(800):
        bench.tick([bench.to(30, 0)] if k % 10 == 0 and bench.operating else ())
        if since is None and bench.speed_m_s > 0.3:
            since = bench.now_ns
        if bench.reason == Reason.HEADING_REVERSED:
            elapsed_ms = (bench.now_ns - (since or bench.now_ns)) // MS
            break
    assert bench.reason == Reason.HEADING_REVERSED
    assert elapsed_ms <= FAULTS[Reason.HEADING_REVERSED].bound_ms


def test_a_machine_that_slips_back_on_spinning_wheels_is_no_antenna_fault():
    """A forwarder on two diagonal wheels slid backwards at half the speed of its wheels; its mast rocked."""
    bench = straight()
    bench.lies["CogSogRapidUpdate"] = {"Cog": 3 * math.pi / 2, "Sog": 0.7 * bench.speed_m_s}
    bench.go(400)
    assert bench.mode is Mode.ACTIVE


@pytest.mark.parametrize(("more", "stops"), [(-2, False), (0, True)])
def test_a_front_half_that_slides_aside_for_a_moment_is_no_antenna_fault(more, stops):
    """On rough ground a turning forwarder's front slid aside at 0.5 m/s, its heading 110 degrees off the course."""
    bench = straight()
    bench.go(200)
    assert bench.speed_m_s > 0.3
    bench.lies["CogSogRapidUpdate"] = {"Cog": math.pi / 2 + math.radians(110.0), "Sog": 1.2 * bench.speed_m_s}
    bench.go((CROSSWISE_SAMPLES_COUNT + more) * 50)  # four samples of the course in a second
    del bench.lies["CogSogRapidUpdate"]
    bench.go(100)
    assert (bench.reason == Reason.HEADING_REVERSED) is stops


def test_rtk_float_slows_only_waypoint_driving():
    bench = straight()
    bench.lies["GnssPositionData"] = {"Method": 5}
    bench.go(400)
    assert bench.mode is Mode.ACTIVE
    assert bench.drive_command["Speed"] == pytest.approx(RTK_FLOAT_SPEED_SHARE * CARRIER.speed_limit_m_s)
    for k in range(300):
        bench.tick([bench.bend(0.0, speed_m_s=0.6)] if k % 10 == 0 else ())
    assert bench.drive_command["Speed"] == pytest.approx(0.6)


def test_position_step_needs_two_samples_and_a_small_one_is_accepted():
    bench = straight()
    bench.north_m += MAX_REPEATED_JUMP_M - 0.1
    bench.go(100)
    assert bench.mode is Mode.ACTIVE
    bench.north_m += MAX_REPEATED_JUMP_M + 0.2  # the next samples agree with it again: one is odd, not two
    bench.go(100)
    assert bench.mode is Mode.ACTIVE and MAX_REPEATED_JUMP_M + 0.2 < MAX_JUMP_M


def test_drifting_position_is_detected():
    bench = straight()
    for _ in range(100):
        bench.north_m += 0.03  # 6 m/s aside
        bench.go(1)
    assert bench.reason == Reason.POSITION_JUMP


def test_articulation_outside_its_range_latches():
    bench = straight()
    bench.bend_rad = CARRIER.articulation_limit_rad + 0.08
    bench.lies["VehStat"] = {"Articulation": bench.bend_rad}
    bench.go(12)
    assert bench.controller.supervisor.reason in (Reason.POSITION_OUTSIDE, Reason.ENCODER_JUMP)
    assert bench.controller.supervisor.detail == ARTICULATION and bench.braked


def test_arm_stuck():
    bench = DriveBench().armed()
    bench.run(40)
    bench.go(20, speed_m_s=0.0, heights_m=(0.45,) * 4)
    held = [1e3 * (h - CARRIER.arm_travel_m / 2) for h in bench.heights_m]
    bench.lies["ArmHeightA"] = {"Arm2": held[1]}
    ms = until(bench, Reason.ARM_STUCK, ARM_STUCK_NS // MS + 100, speed_m_s=0.0, heights_m=(0.45,) * 4)
    assert ms >= ARM_STUCK_NS // MS - 100 and bench.controller.supervisor.detail == 1


@pytest.mark.long
def test_long_drive_raises_no_fault():
    bench = DriveBench().armed()
    bench.run(40)
    places = [(12.0, 0.0), (12.0, 8.0), (0.0, 8.0), (0.0, 0.0)]
    for k in range(12000):
        if k % 10 == 0:
            east, north = places[0]
            if math.hypot(east - bench.east_m, north - bench.north_m) < 3.0:
                places.append(places.pop(0))
            bench.tick([bench.to(*places[0], float_rear=True)])
        else:
            bench.tick()
    assert bench.mode is Mode.ACTIVE and bench.vehicle.gate.refused == 0


def test_every_fault_of_the_carrier_is_tried():
    elsewhere = {Reason.HEADING_REVERSED, Reason.ARM_STUCK}
    assert {reason for reason, _, _ in CASES.values()} | elsewhere == {
        r for r in Reason if Reason.POSITION_LOST <= r <= Reason.STEERING_RUNAWAY
    }


def test_a_moved_hand_lever_stops_a_driving_carrier_softly():
    bench = DriveBench().under_way(300)
    bench.changed["EstopStat"] = {"Lever": 1}
    assert bench.run(2) is Mode.STOP and bench.reason == Reason.LEVER_MOVED
    assert bench.vehicle.driving is Driving.BRAKING
    assert bench.run(400) is Mode.STOP and bench.vehicle.driving is Driving.STANDING
