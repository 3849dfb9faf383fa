"""The carrier's nodes alone on virtual time: address claim, commands and their loss, floats, engine; cantools reads."""

from __future__ import annotations

import itertools
from pathlib import Path

import cantools
import pytest

import can_dbc
from can_dbc.dbc.codec import load
from can_dbc.frame import EXTENDED, identifier
from can_dbc.protocols.e2e import Checker, Sender, Status
from can_dbc.protocols.nmea2000 import join_id, split_id
from machine.loading.profile_file import load_profile
from sim.nodes.mach0 import (
    CLAIM_PGN,
    NULL_ADDRESS,
    REQUEST_PGN,
    ArmNode,
    ArmState,
    EngineNode,
    Gear,
    VehicleFault,
    VehicleNode,
    spool_for,
)

MACHINE = load("machine")
CARRIER = load_profile("aoro_fc8").carrier
ORACLE = cantools.database.load_file(Path(can_dbc.__file__).with_name("machine.dbc"))
assert CARRIER is not None
T_NS = 20_000_000
STEP_NS = 2_500_000


class Bench:
    """One node with its outbox; ``cycle`` is 20 ms: a command of each kind at most, then physics steps."""

    def __init__(self, make) -> None:
        self.out: list[tuple[int, bytes]] = []
        self.pilot = self.guard = True
        self.node = make(self.out, lambda: self.pilot)
        self.now_ns = 1_000_000_000
        self._senders = {m.name: Sender(m.data_ids) for m in MACHINE.messages.values() if m.data_ids}
        self.node.tick(self.now_ns)

    def send(self, name: str, *values: float | None) -> None:
        codec = MACHINE.message(name)
        self.node.receive(codec.key, self._senders[name].protect(codec.encode(0, 0, *values)), self.now_ns)

    def wait(self, ns: int) -> None:
        for k in range(ns // STEP_NS):
            if self.guard and k * STEP_NS % T_NS == 0:
                self.send("GuardAlive", 0xA, 0, 15, 0)
            self.now_ns += STEP_NS
            self.node.decide(self.now_ns)
            self.node.tick(self.now_ns)

    def last(self, name: str) -> dict:
        codec = MACHINE.message(name)
        return codec.named(codec.receive(next(d for k, d in reversed(self.out) if k == codec.key)))


@pytest.fixture
def vehicle():
    return Bench(lambda out, pilot: VehicleNode(MACHINE, out, CARRIER, pilot))


@pytest.fixture
def arms():
    return Bench(lambda out, pilot: ArmNode(MACHINE, out, pilot))


def drive(b: Bench, cycles: int = 3, key=0xA, rate=0.0, speed=0.6, brake=0.0) -> None:
    for _ in range(cycles):
        b.send("VehCmd", key, rate, speed, brake)
        b.wait(T_NS)


def lift(b: Bench, cycles: int = 3, key=0xA, spools=(50.0, -50.0, 0.05, 0.0), floats=(0, 0)) -> None:
    for _ in range(cycles):
        b.send("ArmCmdA", key, *spools)
        b.send("ArmCmdB", key, *floats)
        b.wait(T_NS)


# -- address claim ---------------------------------------------------------------------------------------------


def claims(out) -> list[tuple[int, bytes]]:
    return [(split_id(k).source, d) for k, d in out if split_id(k).pgn == CLAIM_PGN]


def test_a_node_claims_its_address_first_and_answers_requests(vehicle):
    assert split_id(vehicle.out[0][0]) == (6, CLAIM_PGN, 0x03, 255)
    name = ORACLE.get_message_by_name("AddressClaim").decode(vehicle.out[0][1], decode_choices=False)
    assert (name["IndustryGroup"], name["ManufacturerCode"], name["ArbitraryAddress"]) == (2, 2047, 0)
    for destination, answers in ((255, 1), (0x03, 1), (0x30, 0)):
        vehicle.out.clear()
        vehicle.node.receive(
            join_id(6, REQUEST_PGN, 0x27, destination), CLAIM_PGN.to_bytes(3, "little"), vehicle.now_ns
        )
        assert len(claims(vehicle.out)) == answers
    vehicle.out.clear()
    vehicle.node.receive(join_id(6, REQUEST_PGN, 0x27), (65226).to_bytes(3, "little"), vehicle.now_ns)
    assert vehicle.out == []


def test_the_smaller_name_wins_the_address(vehicle):
    own = int.from_bytes(vehicle.node.name, "little")
    drive(vehicle)
    key = join_id(6, CLAIM_PGN, 0x03)
    vehicle.out.clear()
    vehicle.node.receive(key, (own + 1).to_bytes(8, "little"), vehicle.now_ns)
    assert claims(vehicle.out) == [(0x03, vehicle.node.name)] and not vehicle.node.address_lost
    vehicle.node.receive(key, (own - 1).to_bytes(8, "little"), vehicle.now_ns)
    assert claims(vehicle.out)[-1] == (NULL_ADDRESS, vehicle.node.name)
    vehicle.out.clear()
    drive(vehicle)
    assert vehicle.out == [] and vehicle.node.brake and vehicle.node.drive_m_s == 0.0


def test_the_nodes_names_are_unique():
    nodes = [VehicleNode(MACHINE, [], CARRIER, bool), ArmNode(MACHINE, [], bool), EngineNode(MACHINE, [])]
    assert len({n.name for n in nodes}) == len({n.address for n in nodes}) == 3


# -- vehicle ---------------------------------------------------------------------------------------------------


def test_the_vehicle_follows_a_fresh_armed_command_and_echoes_it(vehicle):
    assert (vehicle.node.drive_m_s, vehicle.node.brake, vehicle.node.steer) == (0.0, True, 0.0)
    drive(vehicle, rate=0.1)
    node = vehicle.node
    assert (node.drive_m_s, node.brake) == (pytest.approx(0.6), False)
    dead = CARRIER.steer_valve.deadband_plus_pct / 100.0
    assert node.steer == pytest.approx(dead + (1.0 - dead) * 0.1 / CARRIER.steer_valve.full_speed_plus, abs=1e-3)
    node.speed_m_s, node.articulation_rad = 0.55, -0.2
    drive(vehicle, 2, speed=-0.4, rate=-0.1)
    stat = vehicle.last("VehStat")
    assert (stat["Gear"], stat["Brake"], stat["ParkBrake"], stat["Fault"]) == (Gear.REVERSE, 0, 0, 0)
    assert (stat["Speed"], stat["Articulation"]) == (pytest.approx(0.55), pytest.approx(-0.2))
    assert stat["EchoCounter"] == 4 and node.steer < 0.0


def test_without_command_the_vehicle_brakes_within_a_tenth_of_a_second_and_stays(vehicle):
    drive(vehicle, rate=0.2)
    vehicle.wait(70_000_000)
    assert vehicle.node.drive_m_s > 0.0
    vehicle.wait(2 * STEP_NS)
    assert (vehicle.node.drive_m_s, vehicle.node.brake, vehicle.node.steer) == (0.0, True, 0.0)
    drive(vehicle, 5)
    assert vehicle.node.brake and vehicle.last("VehStat")["Fault"] == VehicleFault.COMMAND_TIMEOUT
    drive(vehicle, 1, key=0)
    drive(vehicle, 1)
    assert not vehicle.node.brake and vehicle.node.fault is VehicleFault.NONE


def test_the_emergency_stop_brakes_and_needs_a_new_arming(vehicle):
    drive(vehicle)
    vehicle.pilot = False
    drive(vehicle, 2)
    assert vehicle.node.brake and vehicle.last("VehStat")["Fault"] == VehicleFault.SAFETY_STOP
    drive(vehicle, 1, key=0)
    assert vehicle.node.fault is VehicleFault.SAFETY_STOP
    vehicle.pilot = True
    drive(vehicle, 2)
    assert vehicle.node.brake
    drive(vehicle, 1, key=0)
    drive(vehicle, 1)
    assert not vehicle.node.brake


@pytest.mark.parametrize("wrong", [{"key": 0x5}, {"speed": None}, {"brake": None}, {"brake": 0.5}, {"rate": None}])
def test_a_wrong_key_a_missing_value_or_any_brake_stops(vehicle, wrong):
    drive(vehicle)
    drive(vehicle, 2, **wrong)
    assert vehicle.node.brake and vehicle.node.drive_m_s == 0.0
    assert vehicle.last("VehStat")["Gear"] == Gear.PARK


def test_speed_and_steering_stay_within_the_machine(vehicle):
    drive(vehicle, speed=9.0, rate=1.0)
    assert vehicle.node.drive_m_s == CARRIER.speed_limit_m_s
    limited = spool_for(CARRIER.steer_valve, CARRIER.articulation_rate_limit_rad_s)
    assert vehicle.node.steer == pytest.approx(limited)
    vehicle.node.articulation_rad = CARRIER.articulation_limit_rad
    drive(vehicle, 1, rate=0.2)
    assert vehicle.node.steer == 0.0
    drive(vehicle, 1, rate=-0.2)
    assert vehicle.node.steer < 0.0


# -- arms ------------------------------------------------------------------------------------------------------


def test_the_arms_follow_and_report(arms):
    arms.node.heights_mm, arms.node.roll_deg, arms.node.pitch_deg = (10.0, -20.0, 300.0, -300.0), 3.0, -50.0
    lift(arms, floats=(0, 1))
    assert arms.node.spools == pytest.approx([0.5, -0.5, 0.0005, 0.0])
    assert (arms.node.float_front, arms.node.float_rear) == (False, True)
    a, b = arms.last("ArmHeightA"), arms.last("ArmHeightB")
    assert [a[f"Arm{n}"] for n in range(1, 5)] == [10, -20, 300, -300]
    assert (a["State"], b["State"], b["FloatFront"], b["FloatRear"]) == (1, 1, 0, 1)
    assert (b["Roll"], b["Pitch"]) == (3.0, -40.0)  # beyond its range a sensor shows its limit


@pytest.mark.parametrize("silent", ["ArmCmdA", "ArmCmdB"])
def test_the_arms_hold_a_tenth_of_a_second_after_the_last_good_frame_of_either_kind(arms, silent):
    lift(arms, floats=(1, 0))
    kept = {"ArmCmdA": (0xA, 0.0, 0.0, 0.0, 0.0), "ArmCmdB": (0xA, 1, 0)}
    del kept[silent]
    for _ in range(3):
        for name, values in kept.items():
            arms.send(name, *values)
        arms.wait(T_NS)
    assert arms.node.state is ArmState.ACTIVE
    arms.wait(2 * STEP_NS + T_NS)
    assert arms.node.spools == [0.0] * 4 and not arms.node.float_front
    lift(arms, 3)
    assert arms.last("ArmHeightA")["State"] == ArmState.FAULT and arms.node.spools == [0.0] * 4
    lift(arms, 1, key=0)
    lift(arms, 2)
    assert arms.node.state is ArmState.ACTIVE


def test_floating_both_axles_is_refused(arms):
    lift(arms, floats=(1, 0))
    lift(arms, 1, floats=(1, 1))
    assert not arms.node.float_front and not arms.node.float_rear and arms.node.spools == [0.0] * 4
    lift(arms, 3, floats=(0, 1))
    assert arms.last("ArmHeightB")["State"] == ArmState.FAULT and arms.last("ArmHeightB")["FloatRear"] == 0
    lift(arms, 1, key=0)
    lift(arms, 2, floats=(0, 1))
    assert arms.node.float_rear and not arms.node.float_front


@pytest.mark.parametrize("enable", [None, 0, 0xB])
def test_without_the_guard_vehicle_and_arms_stop_within_a_tenth_of_a_second(vehicle, arms, enable):
    drive(vehicle)
    lift(arms)
    vehicle.guard = arms.guard = False
    for _ in range(6 if enable is None else 1):
        for bench in (vehicle, arms):
            if enable is not None:
                bench.send("GuardAlive", enable, 0, 15, 0)
        drive(vehicle, 1)
        lift(arms, 1)
    assert vehicle.node.brake and vehicle.node.fault is VehicleFault.GUARD_MISSING
    assert arms.node.spools == [0.0] * 4 and arms.node.state is ArmState.FAULT
    vehicle.guard = arms.guard = True
    drive(vehicle, 3)
    lift(arms, 3)
    assert vehicle.node.brake and arms.node.state is ArmState.FAULT, "until a frame disarms"
    drive(vehicle, 1, key=0)
    lift(arms, 1, key=0)
    drive(vehicle, 2)
    lift(arms, 2)
    assert not vehicle.node.brake and arms.node.state is ArmState.ACTIVE


def test_the_emergency_stop_holds_the_arms(arms):
    lift(arms)
    arms.pilot = False
    lift(arms, 1)
    assert arms.node.spools == [0.0] * 4 and arms.node.state is ArmState.FAULT


# -- engine and all frames -------------------------------------------------------------------------------------


class Running(EngineNode):
    """An engine that a bench can step."""

    def decide(self, now_ns: int) -> None:
        """Feels a load of 40 kW."""
        self.energy_j += 40e3 * STEP_NS * 1e-9


def test_the_engine_droops_under_load_and_reports_its_fault():
    bench = Bench(lambda out, _: Running(MACHINE, out))
    bench.node.speed_m_s, bench.node.brake = -0.5, False
    bench.wait(3_000_000_000)
    sent = [(split_id(k).pgn, d) for k, d in bench.out]
    count = {pgn: sum(p == pgn for p, _ in sent) for pgn in (61444, 65265, 65226)}
    assert count[61444] == pytest.approx(150, abs=1) and count[65265] in (30, 31) and count[65226] in (3, 4)
    eec1, ccvs, dm1 = (
        ORACLE.get_message_by_name(name).decode(next(d for p, d in reversed(sent) if p == pgn), decode_choices=False)
        for name, pgn in (("EEC1", 61444), ("CCVS", 65265), ("DM1", 65226))
    )
    assert 1425.0 < eec1["EngineSpeed"] < 1490.0 and 40 <= eec1["ActualTorque"] <= 50
    assert ccvs["WheelSpeed"] == pytest.approx(1.8, abs=0.01) and ccvs["BrakeSwitch"] == 0
    assert (dm1["AmberLamp"], dm1["SpnLow"], dm1["Fmi"]) == (0, 0, 0)
    bench.node.set_trouble(520_192, 3)
    bench.wait(1_000_000_000)
    _, data = next((k, d) for k, d in reversed(bench.out) if split_id(k).pgn == 65226)
    dm1 = ORACLE.get_message_by_name("DM1").decode(data, decode_choices=False)
    assert (dm1["AmberLamp"], dm1["SpnLow"] | dm1["SpnHigh"] << 16, dm1["Fmi"]) == (1, 520_192, 3)


def test_cantools_reads_what_the_nodes_send(vehicle, arms):
    drive(vehicle, 8, rate=-0.05)
    lift(arms, 8)
    checkers = {m.key: Checker(m.data_ids) for m in MACHINE.messages.values() if m.data_ids}
    seen = set()
    for key, data in itertools.chain(vehicle.out, arms.out):
        assert key & EXTENDED
        if split_id(key).pgn != CLAIM_PGN:
            message = ORACLE.get_message_by_frame_id(identifier(key), force_extended_id=True)
            mine = MACHINE.by_key[key]
            assert mine.decode(data) == tuple(message.decode(data, decode_choices=False)[s.name] for s in mine.signals)
            assert checkers[key].check(data) in (Status.OK, Status.INITIAL)
            seen.add(message.name)
    assert seen == {"VehStat", "ArmHeightA", "ArmHeightB"}
