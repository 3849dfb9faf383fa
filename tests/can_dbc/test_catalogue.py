"""The shipped DBC and EDS files: the frame catalogue, layouts, Data IDs, lint, and canopen round trips."""

from __future__ import annotations

import re
from itertools import chain
from pathlib import Path

import canopen
import pytest

from can_dbc.dbc import check, codec
from can_dbc.frame import EXTENDED

CRANE, MACHINE, GNSS = (codec.load(name) for name in codec.SHIPPED)
# name, identifier, length, cycle ms, timeout ms, signals with their start bits; E2E is Crc:0 Counter:8
CATALOGUE = """
Nmt         0x000 2  0   0  Command:0 Node:8
Sync        0x080 1  5  15  Counter:0
EstopStat   0x181 8 10  30  E2E ChannelA:12 ChannelB:14 Source:16 ResetReq:24 PilotSupply:26 Person:28 Lever:30
                            PilotPress:32 EventSeq:44 ModeSwitch:52
EncSlew     0x182 8  5  15  Position:0 TimeStamp:32 Alarms:48
EncLift     0x183 8  5  15  Position:0 TimeStamp:32 Alarms:48
EncTilt     0x184 8  5  15  Position:0 TimeStamp:32 Alarms:48
EncExt      0x185 8  5  15  Position:0 Speed:32 SystemReg:48 Flags:56
EncRot      0x186 8  5  15  Position:0 TimeStamp:32 Alarms:48
EncArtic    0x187 8  5  15  Position:0 TimeStamp:32 Alarms:48
ValveFbA    0x190 8  5  15  E2E State:12 SpoolSlew:16 SpoolLift:28 SpoolTilt:40 SpoolExt:52
ValveFbB    0x290 8  5  15  E2E FaultAxis:12 SpoolRot:16 SpoolGrapple:28 SpoolAux:40 ExitCode:52 EchoCounter:58
                            Limit:62
PressA      0x1A0 8  5 100  E2E Status:12 LiftA:16 LiftB:28 TiltA:40 TiltB:52
PressB      0x1A1 8  5 100  E2E Status:12 ExtA:16 ExtB:28 SlewA:40 SlewB:52
PressC      0x1A2 8 20 100  E2E Status:12 Pump:16 Tank:28 GrappleA:40 GrappleB:52
GrappleImu  0x1A3 8 10  50  E2E Status:12 LeanRadial:16 LeanTangential:28 RateRadial:40 RateTangential:52
GuardStat   0x1FD 8 10  50  E2E Enable:12 Verdict:16 FaultAxis:24 SeenCounter:28 EventCount:32 ProfileCheck:40
GuardPilot  0x2FD 8 10  50  E2E Supply:12 Verdict:16 EventCount:32
ValveCmdA   0x210 8  5  50  E2E Mode:12 Slew:16 Lift:28 Tilt:40 Ext:52
ValveCmdB   0x310 8  5  50  E2E ArmKey:12 Rot:16 Grapple:28 Aux:40 GrappleMode:52 PumpReq:54 MaxFlow:56
GrappleStat 0x390 8 20 100  E2E State:12 Opening:16 ClampPress:28 Load:40 RotAngle:52
PlcStatus   0x490 8 20 100  E2E Mode:12 WatchdogCounter:16 LongestCycle:24 FaultBits:40
PlcOut      0x491 8 10  50  E2E Slew:12 Lift:22 Tilt:32 Ext:42 Rot:52
CtrlStatus  0x4FE 8 20 100  E2E Mode:12 SafeState:16 Reason:20 StaleMask:28 LoopLate:44 BusErr:52
JointRefA   0x1FE 8  5  50  E2E Slew:12 SlewRate:27 Lift:38 LiftRate:53
JointRefB   0x2FE 8  5  50  E2E Tilt:12 TiltRate:27 Ext:38 ExtRate:53
JointRefC   0x3FE 8  5  50  E2E Rot:12 RotRate:32
"""
MACHINE_IDS = {
    "ArmHeightA": 0x0CFF2030,
    "ArmHeightB": 0x0CFF2130,
    "VehStat": 0x0CFF2203,
    "VehCmd": 0x0CFF2327,
    "ArmCmdA": 0x0CFF2827,
    "ArmCmdB": 0x0CFF2927,
    "GuardAlive": 0x0CFF2A28,
    "CtrlAlive": 0x18FF2F27,
    "EEC1": 0x0CF00400,
    "CCVS": 0x18FEF100,
    "DM1": 0x18FECA00,
    "AddressClaim": 0x18EEFF27,
    "Request": 0x18EAFF27,
}


ROWS = re.sub(r"\n +", " ", CATALOGUE).split("\n")[1:-1]


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row.split()[0])
def test_crane_catalogue(row: str) -> None:
    name, identifier, length, cycle_ms, timeout_ms, *places = row.replace("E2E", "Crc:0 Counter:8").split()
    signals = {signal: int(bit) for signal, bit in (place.split(":") for place in places)}
    message = CRANE.messages[name]
    assert (message.key, message.length) == (int(identifier, 16), int(length))
    assert (message.cycle_time_ns, message.timeout_ns) == (int(cycle_ms) * 1_000_000, int(timeout_ms) * 1_000_000)
    assert {s.name: s.shift for s in message.signals} == signals
    assert (message.data_ids is not None) == ("Crc" in signals)
    assert CRANE.by_key[message.key] is message


def test_heartbeats_of_all_fourteen_nodes() -> None:
    beats = {m.key - 0x700: m for m in CRANE.messages.values() if m.name.startswith("Heartbeat")}
    assert sorted(beats) == [1, 2, 3, 4, 5, 6, 7, 0x10, 0x20, 0x21, 0x22, 0x23, 0x7D, 0x7E]
    assert {m.timeout_ns for node, m in beats.items() if node != 0x7E} == {250_000_000}
    assert beats[0x7E].timeout_ns == 150_000_000
    assert len(CRANE.messages) == len(ROWS) + 14


def test_machine_catalogue() -> None:
    assert {m.name: m.key for m in MACHINE.messages.values()} == {n: i | EXTENDED for n, i in MACHINE_IDS.items()}
    own = [m for m in MACHINE.messages.values() if m.name not in ("EEC1", "CCVS", "DM1", "AddressClaim", "Request")]
    assert all(m.data_ids and not m.by_pgn and m.signals[0].name == "Crc" for m in own)
    assert MACHINE.messages["EEC1"].by_pgn and GNSS.messages["VesselHeading"].by_pgn


def physical(signal) -> tuple:
    return signal.scale, signal.minimum, signal.maximum, signal.unit, signal.policy


def test_swing_arms_are_commanded_as_spools_and_reported_as_heights() -> None:
    arms = [f"Arm{n}" for n in range(1, 5)]
    header = ["Crc", "Counter"]
    layouts = {
        "ArmCmdA": [*header, "ArmKey", *arms],
        "ArmCmdB": [*header, "ArmKey", "FloatFront", "FloatRear"],
        "ArmHeightA": [*header, "State", *arms],
        "ArmHeightB": [*header, "State", "FloatFront", "FloatRear", "Roll", "Pitch"],
    }
    for name, signals in layouts.items():
        message = MACHINE.messages[name]
        assert [s.name for s in message.signals] == signals
        assert message.cycle_time_ns == 20_000_000
        # A receiver must be neutral 100 ms after the last command; it looks every few milliseconds.
        assert message.timeout_ns == (90_000_000 if name.startswith("ArmCmd") else 100_000_000)
    spool, height = MACHINE.messages["ArmCmdA"].signals[3], MACHINE.messages["ArmHeightA"].signals[3]
    assert physical(spool) == (0.05, -100, 100, "%", codec.Policy.REFUSE)
    assert (height.scale, height.offset, height.unit, height.policy) == (1, -2048, "mm", codec.Policy.SATURATE)
    assert MACHINE.messages["ArmCmdB"].signals[3].bits == 2


def test_physical_units() -> None:
    a = CRANE.messages["ValveCmdA"].signals[3]
    assert physical(a) == (0.05, -100, 100, "%", codec.Policy.REFUSE)
    p = CRANE.messages["PressA"].signals[3]
    assert physical(p) == (0.1, 0, 400, "bar", codec.Policy.SATURATE)
    assert CRANE.messages["ValveCmdB"].signals[2].choices[0xA] == "Armed"
    assert CRANE.messages["GuardStat"].signals[2].choices[0xA] == "Enabled"


def test_data_ids_distinguish_messages() -> None:
    lists = [m.data_ids for m in chain(CRANE.messages.values(), MACHINE.messages.values()) if m.data_ids]
    assert len(lists) == 26
    for counter in range(16):
        assert len({ids[counter] for ids in lists}) == len(lists)


@pytest.mark.parametrize("name", codec.SHIPPED)
def test_shipped_files_have_no_lint(name: str) -> None:
    report = check.check(name, 1, 1)
    assert report.warnings == ()
    for message in codec.parse(Path(report.path)).messages:
        assert message.comment and message.senders, message.name
        assert all(s.comment for s in message.signals), message.name


LINT_CASES = [
    (' SG_ X : 0|8@1+ (1,0) [0|0] "" A\n SG_ Y : 7|8@1+ (1,0) [0|0] "" A\n', {"overlap"}),
    (' SG_ X : 7|8@0+ (1,0) [0|0] "" A\n SG_ Y : 0|8@1+ (1,0) [0|0] "" A\n', {"overlap"}),
    (' SG_ X : 60|8@1+ (1,0) [0|0] "" A\n', {"length"}),
    (' SG_ X : 0|8@1+ (1,0) [0|256] "" A\n', {"range"}),
    (' SG_ X : 0|8@1- (1,0) [-129|0] "" A\n', {"range"}),
    (' SG_ X : 0|8@1+ (0.5,0) [0|100] "" A\n', {"unit"}),
    (' SG_ X : 0|8@1+ (0.5,0) [0|100] "m" A\n', set()),
    (
        ' SG_ M M : 0|8@1+ (1,0) [0|0] "" A\n SG_ X m0 : 8|8@1+ (1,0) [0|0] "" A\n'
        ' SG_ Y m1 : 8|8@1+ (1,0) [0|0] "" A\n',
        set(),
    ),
    (
        ' SG_ M M : 0|8@1+ (1,0) [0|0] "" A\n SG_ X m0 : 8|8@1+ (1,0) [0|0] "" A\n'
        ' SG_ Y m0 : 9|8@1+ (1,0) [0|0] "" A\n',
        {"overlap"},
    ),
]


@pytest.mark.parametrize(("signals", "rules"), LINT_CASES)
def test_lint(tmp_path: Path, signals: str, rules: set[str]) -> None:
    path = tmp_path / "f.dbc"
    path.write_text(f'VERSION ""\nNS_ :\nBS_:\nBU_: A\nBO_ 1 M: 8 A\n{signals}')
    report = check.check(str(path), 20, 1)
    assert {f.rule for f in report.warnings} == rules | {"cycle-time"}
    assert bool(report.error) == bool(rules & {"overlap", "length"})


# -- EDS -------------------------------------------------------------------------------------------------------

ENCODERS = [
    # file, device type, TPDO1 mapping, position is signed, speed bits
    ("encoder_rotary.eds", 0x00020196, [(0x6004, 0, 32), (0x2120, 0, 16), (0x6503, 0, 16)], False, 32),
    (
        "encoder_linear.eds",
        0x00080196,
        [(0x6004, 0, 32), (0x6030, 1, 16), (0x5122, 1, 8), (0x5122, 2, 8)],
        True,
        16,
    ),
]
OBJECTS = (
    "1000 1001 1005 1008 1010 1014 1016 1017 1018 1019 1029 1800 1801 1A00 1A01 "
    "6000 6002 6003 6004 6030 6200 6500 6501 6502 6503 6504 6505 6506 6507 6509 650A 650B"
)


@pytest.mark.parametrize(("file", "device_type", "mapping", "signed", "speed_bits"), ENCODERS)
def test_encoder_eds_over_sdo(
    file: str, device_type: int, mapping: list[tuple[int, int, int]], signed: bool, speed_bits: int
) -> None:
    path = str(Path(codec.__file__).parents[1] / file)
    device, master = canopen.Network(), canopen.Network()
    device.connect(interface="virtual", channel=file)
    master.connect(interface="virtual", channel=file)
    try:
        local = device.create_node(5, path)
        remote = master.add_node(5, path)
        assert remote.object_dictionary.device_information.vendor_number == 0
        assert [i for i in OBJECTS.split() if int(i, 16) not in remote.object_dictionary] == []
        assert remote.sdo[0x1000].raw == device_type
        assert remote.sdo[0x1018][1].raw == 0
        assert remote.sdo[0x1014].raw == 0x85
        value = -1234 if signed else 3_000_000_000
        remote.sdo[0x6003].raw = value
        assert local.sdo[0x6003].raw == value
        local.sdo[0x6004].raw = value
        assert remote.sdo[0x6004].raw == value
        assert len(remote.sdo.upload(0x6030, 1)) * 8 == speed_bits
        remote.tpdo.read()
        tpdo = remote.tpdo[1]
        assert (tpdo.cob_id, tpdo.enabled, tpdo.trans_type) == (0x185, True, 1)
        assert [(v.index, v.subindex, v.length) for v in tpdo.map] == mapping
        assert not remote.tpdo[2].enabled
        with pytest.raises(canopen.SdoAbortedError):
            remote.sdo.download(0x6004, 0, b"\0\0\0\0")
    finally:
        device.disconnect()
        master.disconnect()
