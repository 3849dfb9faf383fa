"""mach0: address claim, frames sent and their periods, received values and their age; no input raises."""

from dataclasses import replace

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from can_dbc.frame import EXTENDED, REMOTE
from can_dbc.protocols.e2e import Checker, Status
from can_dbc.protocols.nmea2000 import encode, frames, join_id
from controller.carrier.bus import CarrierBus, CarrierCommand
from controller.step import Controller
from machine.joints import ARTICULATION
from machine.status.modes import Mode
from machine.status.reasons import Reason
from runtime.errors import ConfigError
from tests.codes import coded
from tests.controller.bench import AORO, CODECS, DATABASE, GNSS, MACHINE, MS, Bench, T

CLAIM = MACHINE.message("AddressClaim")
CANNOT_CLAIM = CLAIM.key & ~0xFF | 254
COMMANDS = ("VehCmd", "ArmCmdA", "ArmCmdB")


def request(destination=255, pgn=60928):
    return join_id(6, 59904, 0x30, destination), pgn.to_bytes(3, "little")


def claims(bench):
    return [key for key, _ in bench.machine_sent if key & ~0xFF == CLAIM.key & ~0xFF]


def of(bench, name):
    return [data for key, data in bench.machine_sent if key == MACHINE.message(name).key]


# -- address ------------------------------------------------------------------------------------------------


def test_address_is_claimed_once_before_any_other_frame():
    bench = Bench(AORO)
    bench.run(40)
    assert bench.machine_sent[0][0] == CLAIM.key == 0x98EEFF27
    assert claims(bench) == [CLAIM.key]
    named = bench.machine_commands["AddressClaim"]
    assert named["IndustryGroup"] == 2 and named["ArbitraryAddress"] == 0


@pytest.mark.parametrize(
    ("asked", "answers"),
    [(request(), 1), (request(0x27), 1), (request(0x30), 0), (request(pgn=65226), 0), ((request()[0], b"\x00\xee"), 0)],
)
def test_request_for_the_claim_is_answered(asked, answers):
    bench = Bench(AORO)
    bench.run(2)
    bench.machine_sent.clear()
    bench.machine_extra += [asked] * 3
    bench.run(2)
    assert claims(bench) == [CLAIM.key] * answers, "at most one claim per tick, however many requests came"


def test_claim_of_lower_priority_is_answered_and_sending_continues():
    bench = Bench(AORO).armed()
    bench.machine_sent.clear()
    bench.machine_extra.append((CLAIM.key, b"\xff" * 8))
    bench.run(8)
    assert claims(bench) == [CLAIM.key] and bench.mode is Mode.ARMED
    assert len(of(bench, "VehCmd")) == 2


@pytest.mark.parametrize("theirs", ["higher", "same"])
def test_lost_address_stops_all_frames_until_a_reset(theirs):
    bench = Bench(AORO)
    bench.run(1)
    name = bytes(8) if theirs == "higher" else bench.machine_sent[0][1]
    bench.boot()
    bench.machine_sent.clear()
    bench.machine_extra.append((CLAIM.key, name))
    bench.run(40)
    assert [key for key, _ in bench.machine_sent] == [CANNOT_CLAIM]
    assert bench.controller.carrier_shutdown_frames() == []
    assert bench.mode is Mode.STANDBY and bench.reason == Reason.ADDRESS_LOST
    assert bench.press(1) is Mode.STANDBY and bench.controller.gate.refusal is Reason.ADDRESS_LOST
    bench.machine_sent.clear()
    bench.press(4)
    bench.run(8)
    assert bench.machine_sent[0][0] == CLAIM.key and len(of(bench, "VehCmd")) >= 2
    assert bench.press(1) is Mode.ARMED


# -- frames sent --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("mode", ["boot", "armed", "active"])
def test_carrier_brake_is_on_in_every_mode(mode):
    bench = getattr(Bench(AORO), mode)()
    bench.machine_sent.clear()
    bench.run(200)
    for name, count in (*((n, 50) for n in COMMANDS), ("CtrlAlive", 10)):
        sent = of(bench, name)
        assert len(sent) == count, name
        checker = Checker(MACHINE.message(name).data_ids)
        assert [checker.check(data) for data in sent][2:] == [Status.OK] * (count - 2), name
    drive, arms_a, arms_b = (bench.machine_commands[n] for n in COMMANDS)
    assert drive["Speed"] == drive["ArticRate"] == drive["ArmKey"] == 0 and drive["Brake"] == 100
    assert [arms_a[s] for s in ("ArmKey", "Arm1", "Arm2", "Arm3", "Arm4")] == [0] * 5
    assert [arms_b[s] for s in ("ArmKey", "FloatFront", "FloatRear")] == [0] * 3
    assert bench.machine_commands["CtrlAlive"]["Mode"] == bench.mode


def test_carrier_command_reaches_the_frames():
    bus, sent = CarrierBus((MACHINE, GNSS)), []
    bus.command = CarrierCommand(True, -0.1, 0.639, 0.0, (10.0, -20.0, 30.0, -40.0), float_rear=True)
    bus.encode(Mode.ACTIVE, Reason.NONE, False, 10**9, sent)
    drive, arms_a, arms_b = (MACHINE.message(n) for n in COMMANDS)
    frames = dict(sent)
    assert drive.decode(frames[drive.key])[2:] == (0xA, -0.1, 0.639, 0.0)
    assert arms_a.decode(frames[arms_a.key])[2:] == (0xA, 10.0, -20.0, 30.0, -40.0)
    assert arms_b.decode(frames[arms_b.key])[2:] == (0xA, 0, 1)


def test_shutdown_frames_are_neutral_and_give_the_reason():
    bench = Bench(AORO).armed()
    bench.controller.outputs.machine_frames[:] = bench.controller.carrier_shutdown_frames()
    bench.machine_commands.clear()
    bench._apply_carrier_frames(bench.controller.outputs)
    assert bench.machine_commands["VehCmd"]["Brake"] == 100 and bench.machine_commands["ArmCmdA"]["ArmKey"] == 0
    assert bench.machine_commands["CtrlAlive"]["Reason"] == Reason.CONTROLLER_ENDED


def test_machine_on_a_fixed_base_sends_nothing_on_mach0():
    bench = Bench().armed()
    bench.machine_extra.append((CLAIM.key, bytes(8)))
    bench.run(40)
    assert not bench.machine_sent and bench.controller.carrier_bus is None
    assert bench.controller.carrier_shutdown_frames() == [] and bench.mode is Mode.ARMED


# -- frames received ---------------------------------------------------------------------------------------


def test_every_input_of_both_buses_is_fresh_with_its_age():
    bench = Bench(AORO)
    seen = dict.fromkeys((name for name, _ in bench.controller.inputs_in_use), 0)
    ages = set()
    for _ in range(440):
        bench.tick()
        for name, slot in bench.controller.inputs_in_use:
            if slot.fresh:
                seen[name] += 1
                ages.add(bench.now_ns - slot.stamp_ns)
    assert {slot.codec.name for _, slot in bench.controller.inputs_in_use} == set(seen)
    assert len(seen) == 9 + 5 + 9 and min(seen.values()) >= 1
    assert seen["PositionRapidUpdate"] == 22 and seen["GnssPositionData"] == 3
    assert seen["VehStat"] == 109, "the first frame only begins to qualify"
    assert ages == {T - MS}


def put(bench, name, source=0x1C, priority=None, **fields):
    codec = CODECS[name]
    sent = frames(codec, encode(codec, **fields), source)
    if priority is not None:
        sent = [(key & ~(7 << 26) | priority << 26, data) for key, data in sent]
    bench.machine_extra += sent
    bench.tick()


def test_pgns_are_received_from_any_source_with_any_priority():
    bench = Bench(AORO)
    machine = bench.controller.carrier_bus.inputs
    bench.dropped |= {*GNSS.messages, "CCVS", "DM1"}
    put(bench, "VesselHeading", source=0x55, priority=1, Heading=0.5)
    assert machine.heading.get("Heading") == 0.5 and machine.heading.get("Variation") is None
    put(bench, "GnssPositionData", source=0x77, priority=6, Latitude=63.5, Method=4, Hdop=0.7)
    assert machine.fix.get("Latitude") == 63.5 and machine.fix.get("Method") == 4
    assert machine.fix.get("Altitude") is None
    assert not machine.unknown


def test_only_messages_that_have_a_reader_are_received():
    received = {state.codec.name for state in Bench(AORO).controller.carrier_bus.inputs.messages}
    assert not received & {"CCVS", "DM1", "Attitude", "SystemTime"}


def test_fast_packet_may_be_longer_and_a_short_or_broken_one_is_refused():
    bench = Bench(AORO)
    machine = bench.controller.carrier_bus.inputs
    bench.dropped |= set(GNSS.messages)
    codec = GNSS.message("GnssPositionData")
    payload = encode(codec, Latitude=1.0)
    for sent, taken in ((payload + b"\x01\x02\x03\x04", True), (payload[:40], False)):
        machine.fix.forget()
        bench.machine_extra += frames(codec, sent, 0x1C)
        bench.tick()
        assert (machine.fix.get("Latitude") == 1.0) is taken
    refused = machine.fix.refused
    bench.machine_extra.append((codec.key, b"\x00"))
    bench.tick()
    assert machine.fix.refused == refused + 1


@pytest.mark.parametrize(
    ("name", "timeout_ms"),
    [("PositionRapidUpdate", 500), ("VesselHeading", 300), ("GnssPositionData", 3000), ("EEC1", 100), ("VehStat", 90)],
)
def test_every_value_has_its_own_time_out(name, timeout_ms):
    bench = Bench(AORO)
    bench.run(21)
    slot = dict(bench.controller.inputs_in_use)[name]
    assert slot.values is not None
    bench.dropped.add(name)
    while slot.values is not None:
        bench.tick()
    # The age is judged at ticks, and a frame is 4 ms old in its first one.
    assert timeout_ms * MS < bench.now_ns - slot.stamp_ns <= timeout_ms * MS + T


def test_articulation_encoder_is_set_up_and_needed_like_the_others():
    bench = Bench(AORO).boot()
    assert bench.encoders[7].state == 5 and bench.encoders[7].objects[0x1800, 1] == 0x187
    bench.press(1)
    bench.dropped.add("EncArtic")
    assert bench.run(4) is Mode.FAULT and bench.reason == Reason.ENCODER_LOST
    assert bench.controller.supervisor.detail == ARTICULATION
    assert bench.controller.stale_mask == 1 << 7


def test_wrong_articulation_node_is_a_configuration_error():
    carrier = AORO.profile.carrier
    encoder = msgspec.structs.replace(carrier.articulation_encoder, node=8)
    profile = msgspec.structs.replace(
        AORO.profile, carrier=msgspec.structs.replace(carrier, articulation_encoder=encoder)
    )
    with pytest.raises(ConfigError, check=coded("config.encoder-node")):
        Controller(replace(AORO, profile=profile), DATABASE)


KEYS = [m.key for m in (*MACHINE.messages.values(), *GNSS.messages.values())]
extended = st.integers(0, 0x1FFF_FFFF).map(lambda i: i | EXTENDED)
any_key = st.one_of(st.sampled_from(KEYS), extended, st.sampled_from([REMOTE | KEYS[0], 0x123]))
hostile = st.lists(st.lists(st.tuples(any_key, st.binary(max_size=8)), max_size=12), max_size=12)


@given(hostile)
@settings(max_examples=40, deadline=None)
def test_nothing_on_mach0_raises_or_moves_the_carrier(script):
    bench = Bench(AORO)
    bench.run(3)
    for extra in script:
        bench.machine_extra = list(extra)
        bench.tick()
        assert len(bench.controller.outputs.machine_frames) <= 5
    for name in COMMANDS:
        assert bench.machine_commands[name]["ArmKey"] == 0
    assert bench.machine_commands["VehCmd"]["Brake"] == 100
