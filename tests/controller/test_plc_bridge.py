"""The PLC bridge in virtual time: emulated nodes on crane0, passed commands and losses; and the joint references."""

from __future__ import annotations

import asyncio
import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import pytest

from can_dbc.dbc.codec import MessageCodec, load
from can_dbc.frame import Frame, RawFrame
from can_dbc.plc import map as plc
from can_dbc.plc.datagram import Header, encode_reply
from can_dbc.plc.map import Command, Fault, Feedback, Grapple, Mode, Role, State, WordOrder
from can_dbc.protocols.canopen import parse_heartbeat
from can_dbc.protocols.e2e import Checker, Sender, Status
from controller.crane.outputs import CraneWriter
from controller.crane.startup import Startup
from controller.plc import __main__ as process
from controller.plc.__main__ import summary
from controller.plc.bridge import Bridge, role_of
from controller.plc.handshake import Handshake
from controller.plc.valve_gate import fault_bits
from hil.plc import write_plc_profile
from machine.loading.profile_file import load_profile
from machine.profile import Plc, Profile
from machine.status.modes import Mode as ControllerMode
from runtime.errors import ConfigError
from tests.codes import coded

MS = 1_000_000
DATABASE = load("crane")
HOME = (0.1, 0.7, -1.6, 0.3, 0.2, 0.0, 0.0)
ARMED, MOVES = 0xA, 2


def profile(role: str | None) -> Profile:
    return msgspec.structs.replace(load_profile("palms_471"), plc=Plc(role) if role else None)  # type: ignore[arg-type]


def values_of(codec: MessageCodec, data: bytes) -> dict[str, Any]:
    return dict(zip((s.name for s in codec.signals), codec.receive(data), strict=True))


class Rig:
    """Controller and guard as frames on one side, the PLC as feedback on the other; 5 ms per step."""

    def __init__(self, role: str = "valves") -> None:
        self.bridge = Bridge(profile(role), DATABASE)
        self.feedback = Feedback(state=State.HOLD, fault_axis=15, position=HOME, opening=0.5)
        self.now_ns = 1_000 * MS
        self.answers = True
        self.acknowledges = True
        self.sent: list[RawFrame] = []
        self.command = Command()
        self.mode = ControllerMode.ACTIVE
        self._senders: dict[str, Sender] = {}
        self.channel_b = 1
        self.estop_alive = self.samples = True
        for _ in range(2):
            for frame in self.control(arm=0, mode=0):  # the controller has been there before
                self.bridge.gate.receive(frame, self.now_ns)

    def frame(self, name: str, **values: Any) -> Frame:
        """A good protected frame; what is not given is 0."""
        codec = DATABASE.message(name)
        sender = self._senders.setdefault(name, Sender(codec.data_ids or bytes(16)))
        data = codec.encode(*(values.get(s.name, 0) for s in codec.signals))
        return Frame(self.now_ns, codec.key, sender.protect(data))

    def control(self, arm: int = ARMED, mode: int = MOVES, enable: int = ARMED, **values: Any) -> list[Frame]:
        """Frames of controller and guard in a tick."""
        a = {k: v for k, v in values.items() if k in ("Slew", "Lift", "Tilt", "Ext")}
        b = {k: v for k, v in values.items() if k in ("Rot", "Grapple", "GrappleMode")}
        return [
            Frame(self.now_ns, 0x080, b"\x01"),
            self.frame("ValveCmdA", Mode=mode, **a),
            self.frame("ValveCmdB", ArmKey=arm, **b),
            self.frame("GuardStat", Enable=enable),
            self.frame("CtrlStatus", Mode=self.mode, SafeState=values.get("SafeState", 0)),
        ]

    def step(self, frames: list[Frame] | None = None) -> list[RawFrame]:
        """5 ms; every second one exchanges with the PLC."""
        bridge = self.bridge
        self.now_ns += 5 * MS
        out = bridge.step(self.now_ns, frames or [])
        if self.now_ns % (10 * MS) == 0:
            self.command = bridge.command(self.now_ns)
            block = bridge.handshake.registers(self.command, self.now_ns)
            if self.answers:
                accepted = block[1] if self.acknowledges else self.feedback.accepted
                beat = (self.feedback.heartbeat + 1) & 0xFFFF
                self.feedback = replace(self.feedback, heartbeat=beat, accepted=accepted)
                if self.samples:
                    self.feedback = replace(self.feedback, sampled_us=self.now_ns // 1000 & 0xFFFF)
                if self.estop_alive:
                    values = {"ChannelA": 1, "ChannelB": self.channel_b, "PilotSupply": 1}
                    self.feedback = replace(self.feedback, estop_frame=self.frame("EstopStat", **values).data)
                status = plc.status_registers(self.feedback, 300, WordOrder.HIGH_FIRST)
                assert bridge.handshake.accept_registers(status, self.now_ns)
        self.sent = out
        return out

    def run(self, ms: int, **values: Any) -> None:
        """Repeat the same frames of the controller."""
        for _ in range(ms // 5):
            self.step(self.control(**values))

    def decoded(self, name: str) -> dict[str, Any] | None:
        """The newest frame of that name in the last step, decoded."""
        codec = DATABASE.message(name)
        found = [data for key, data in self.sent if key == codec.key]
        return values_of(codec, found[-1]) if found else None


def passing() -> Rig:
    """The PLC drives the slew."""
    rig = Rig()
    rig.run(100, Slew=50.0)
    assert rig.command.mode is Mode.VALVES
    return rig


def await_frame(rig: Rig, name: str, **values: Any) -> dict[str, Any]:
    for _ in range(10):
        rig.step(rig.control(**values))
        if found := rig.decoded(name):
            return found
    raise AssertionError(f"no {name}")


def test_bridge_is_silent_until_the_plc_has_initialised() -> None:
    rig = Rig()
    rig.answers = False
    rig.run(300)
    assert not rig.sent
    rig.answers, rig.feedback = True, replace(rig.feedback, state=State.INIT)
    rig.run(100)
    assert not rig.sent


def start_encoders(rig: Rig) -> None:
    """Set them up as the controller does."""
    startup, ours = Startup(profile("valves")), list[Frame]()
    for _ in range(400):
        for key, data in rig.step(ours):
            startup.receive(key, data)
        asked: list[RawFrame] = []
        startup.step(rig.now_ns, asked)
        ours = [Frame(rig.now_ns, key, data) for key, data in asked]
    assert startup.complete, startup.problem()


def test_start_up_configures_the_emulated_encoders() -> None:
    rig = Rig()
    start_encoders(rig)
    rig.step([Frame(rig.now_ns, 0x080, b"\x01")])
    slew, ext = rig.decoded("EncSlew"), rig.decoded("EncExt")
    assert slew is not None and slew["Position"] == 8192 + round(0.1 / 3.834951969714103e-4)
    assert ext is not None and ext["Position"] == round(0.3 / 5e-6)
    rig.step()
    assert rig.decoded("EncSlew") is None, "only SYNC makes an encoder answer"


def test_bridge_is_silent_50_ms_after_the_last_answer_and_nodes_boot_later() -> None:
    rig = Rig()
    rig.run(300)
    rig.answers = False
    rig.run(50)
    rig.run(10)
    assert not rig.sent
    rig.answers = True
    rig.run(20)
    assert rig.sent and not any(parse_heartbeat(k, d) for k, d in rig.sent if d == b"\x00"), "a short gap is no boot"
    rig.answers = False
    rig.run(400)
    rig.answers = True
    boots = []
    for _ in range(4):
        rig.step()
        boots += [beat[0] for k, d in rig.sent if (beat := parse_heartbeat(k, d)) and beat[1] == 0]
    assert sorted(boots) == [1, 2, 3, 4, 5, 6, 0x10, 0x20, 0x21, 0x22]


def test_frozen_heartbeat_of_the_plc_silences_the_bridge() -> None:
    rig = Rig()
    rig.run(100)
    rig.answers = False
    shake = rig.bridge.handshake
    for _ in range(20):
        rig.step(rig.control())
        shake.accept_registers(plc.status_registers(rig.feedback, 300, WordOrder.HIGH_FIRST), rig.now_ns)
    assert not rig.sent


def test_armed_commands_of_role_valves_pass_as_shares() -> None:
    rig = Rig()
    rig.run(100, Slew=50.0, Lift=-25.05, Rot=100.0, Grapple=-100.0, GrappleMode=2)
    command = rig.command
    assert (command.mode, command.armed) == (Mode.VALVES, True)
    assert (command.grapple, command.grapple_pct) == (Grapple.CLOSE, 100)
    assert command.reference == pytest.approx((0.5, -0.2505, 0.0, 0.0, 1.0, 0.0, 0.0))
    assert command.rate == (0.0,) * 7 and command.max_speed_pct == 100
    assert rig.bridge.gate.exit == 0
    rig.run(30, Slew=50.0, SafeState=1)
    assert rig.command.max_speed_pct == 50


@pytest.mark.parametrize(
    ("spoiled", "exit_code"),
    [({"arm": 0}, 8), ({"enable": 0}, 4), ({"mode": 3}, 6), *(({n: None}, 6) for n in ("Slew", "Rot", "Grapple"))],
    ids=str,
)
def test_without_arm_key_enable_known_mode_or_a_value_it_is_neutral_until_a_disarm(
    spoiled: dict[str, int | None], exit_code: int
) -> None:
    rig = passing()
    rig.run(20, **{"Slew": 50.0} | spoiled)
    assert rig.command == Command()
    assert rig.bridge.gate.exit == exit_code
    rig.run(20, Slew=50.0)
    assert rig.bridge.gate.locked is ("arm" not in spoiled)
    assert (rig.command == Command()) is rig.bridge.gate.locked


@pytest.mark.parametrize(("fault", "bits"), [(0, 0), (3, 4), (16, 0x8000), (17, 0x8000), (65535, 0x8000)])
def test_every_fault_number_of_the_plc_is_a_fault_bit(fault: int, bits: int) -> None:
    assert fault_bits(Feedback(fault=fault)) == bits


@pytest.mark.parametrize("lost", ["ValveCmdA", "ValveCmdB", "GuardStat"])
def test_loss_while_armed_is_neutral_until_a_disarm(lost: str) -> None:
    rig, key = passing(), DATABASE.message(lost).key
    began_ns = rig.now_ns
    while rig.command.mode is Mode.VALVES:
        rig.step([f for f in rig.control(Slew=50.0) if f.key != key])
    assert rig.now_ns - began_ns <= 60 * MS
    rig.run(200, Slew=50.0)
    assert rig.command == Command() and rig.bridge.gate.locked
    assert await_frame(rig, "ValveFbA", Slew=50.0)["State"] == 4
    rig.run(20, arm=0, mode=0)
    rig.run(20, Slew=50.0)
    assert rig.command.mode is Mode.VALVES


def test_sync_lost_is_neutral() -> None:
    rig = passing()
    for _ in range(5):
        rig.step(rig.control(Slew=50.0)[1:])
    assert rig.command == Command()


NAMES = ("Slew", "Lift", "Tilt", "Ext", "Rot")
REFERENCES = ("JointRefA", "JointRefB", "JointRefC")


def referring(rig: Rig, values: dict[str, float | None], ms: int, **control: Any) -> None:
    for _ in range(ms // 5):
        frames = rig.control(**control)
        frames += [
            rig.frame(n, **{k: v for k, v in values.items() if k in DATABASE.message(n).index}) for n in REFERENCES
        ]
        rig.step(frames)


def test_role_references_passes_references_and_ignores_spools() -> None:
    rig = Rig("references")
    values = {"Slew": 0.5, "SlewRate": 0.1, "Lift": 0.7, "Tilt": -1.6, "Ext": 0.5, "ExtRate": -0.05, "Rot": 1.5}
    referring(rig, values, 100, Slew=77.0, GrappleMode=3)
    command = rig.command
    assert (command.mode, command.grapple) == (Mode.REFERENCES, Grapple.HOLD)
    assert command.reference == pytest.approx((0.5, 0.7, -1.6, 0.5, 1.5, 0, 0), abs=1e-4)
    assert command.rate == pytest.approx((0.1, 0, 0, -0.05, 0, 0, 0), abs=5e-4)
    referring(rig, dict.fromkeys([*NAMES, *(f"{n}Rate" for n in NAMES)]), 20)
    assert (rig.command.mode, rig.command.armed) == (Mode.NEUTRAL, True), "not available: nothing may move"
    rig.run(100)
    assert rig.command == Command() and rig.bridge.gate.exit == 5, "the references are stale"


@pytest.mark.parametrize("values", [{"Lift": 1.4}, {"Slew": 0.0, "LiftRate": 0.2}, {"Ext": 0.0}])
def test_reference_outside_the_machine_is_refused_and_never_clamped(values: dict[str, float]) -> None:
    rig = Rig("references")
    inside = {"Lift": 0.7, "Tilt": -1.6, "Ext": 0.5}
    referring(rig, inside, 100)
    assert rig.command.mode is Mode.REFERENCES
    referring(rig, inside | values, 20)
    assert rig.command == Command() and rig.bridge.gate.refused == 1
    assert rig.bridge.gate.exit == 6
    referring(rig, inside, 50)
    assert rig.command == Command(), "until a disarm"


def test_echo_changes_only_while_the_plc_accepts_commands() -> None:
    rig = Rig()
    rig.run(200)
    first = await_frame(rig, "ValveFbB")["EchoCounter"]
    assert await_frame(rig, "ValveFbB")["EchoCounter"] == (first + 1) % 16
    rig.acknowledges = False
    rig.run(100)
    assert len({await_frame(rig, "ValveFbB")["EchoCounter"] for _ in range(5)}) == 1


def test_plc_values_are_on_the_bus_and_others_not_available() -> None:
    rig = Rig()
    rig.feedback = replace(
        rig.feedback,
        state=State.EXECUTE,
        pressure_bar=(1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0),
        load_kg=80,
        longest_cycle_us=11_000,
        fault=Fault.ILLEGAL_VALUE,
        fault_axis=2,
    )
    rig.channel_b = 0
    rig.run(100)
    valve_a, valve_b = await_frame(rig, "ValveFbA"), await_frame(rig, "ValveFbB")
    assert valve_a["State"] == 1 and valve_a["SpoolSlew"] is None and valve_b["FaultAxis"] == 2
    estop, status = await_frame(rig, "EstopStat"), await_frame(rig, "PlcStatus")
    assert (estop["ChannelA"], estop["ChannelB"], estop["PilotSupply"]) == (1, 0, 1)
    assert (status["Mode"], status["LongestCycle"], status["FaultBits"]) == (2, 11_000, 1)
    assert [await_frame(rig, "PressA")[n] for n in ("LiftA", "LiftB", "TiltA", "TiltB")] == [1.0, 2.0, 3.0, 4.0]
    press = await_frame(rig, "PressB")
    assert (press["ExtA"], press["ExtB"], press["SlewA"]) == (5.0, 6.0, None)
    grapple = await_frame(rig, "GrappleStat")
    assert (grapple["Opening"], grapple["ClampPress"], grapple["Load"]) == (50.0, 7.0, 80)


def test_reset_needs_an_operators_reset_and_never_an_armed_controller() -> None:
    rig = passing()
    rig.feedback = replace(rig.feedback, state=State.SAFE, fault=Fault.WATCHDOG)
    asked = []
    for mode, arm in ((ControllerMode.ACTIVE, ARMED), (ControllerMode.FAULT, 0), (ControllerMode.STOP, 0)):
        rig.mode = mode
        rig.run(300, arm=arm)
        asked.append(rig.command.reset)
    assert asked == [False, False, False]
    rig.mode = ControllerMode.STANDBY
    edges, before = 0, False
    for _ in range(120):
        rig.step(rig.control(arm=0, mode=0))
        edges += rig.command.reset and not before
        before = rig.command.reset
        assert not (rig.command.reset and rig.command.armed)
    assert edges == 2, "a pulse of 200 ms, again after as long"


def frames_of(rig: Rig, name: str, ms: int, sync: bool = True) -> list[bytes]:
    """All frames of that name that the bridge sends in ``ms``."""
    key, found = DATABASE.message(name).key, []
    for _ in range(ms // 5):
        frames = rig.control()
        found += [data for k, data in rig.step(frames if sync else frames[1:]) if k == key]
    return found


def test_the_emergency_stop_is_the_safety_modules_own_frame_and_is_sent_once() -> None:
    rig = Rig()
    rig.run(100)
    checker, codec = Checker(DATABASE.message("EstopStat").data_ids or b""), DATABASE.message("EstopStat")
    seen = []
    for _ in range(40):
        before = rig.feedback.estop_frame
        for key, data in rig.step(rig.control()):
            if key == codec.key:
                assert data == before
                seen.append(checker.check(data))
    assert len(seen) == 20 and set(seen[1:]) <= {Status.OK, Status.INITIAL}


def test_a_sample_is_sent_once_with_the_plcs_time() -> None:
    rig = Rig()
    start_encoders(rig)
    key, codec = DATABASE.message("EncSlew").key, DATABASE.message("EncSlew")
    stamps = []
    for _ in range(40):
        sampled_us = rig.feedback.sampled_us
        for k, data in rig.step(rig.control()):
            if k == key:
                assert codec.receive(data)[codec.index["TimeStamp"]] == sampled_us
                stamps.append(sampled_us)
    assert len(stamps) == len(set(stamps)) == 20, "one in 10 ms, although SYNC asks every 5 ms"
    rig.feedback = replace(rig.feedback, position=tuple(p + 0.05 for p in HOME))
    rig.run(10)
    positions = [codec.receive(data)[codec.index["Position"]] for data in frames_of(rig, "EncSlew", 50)]
    assert len(set(positions)) == 1, "nothing between two samples"


@pytest.mark.parametrize(
    ("name", "alive"), [("EstopStat", "estop_alive"), ("EncSlew", "samples"), ("EncExt", "samples")]
)
def test_what_falls_silent_behind_the_plc_is_silent_on_the_bus(name: str, alive: str) -> None:
    """The PLC's cycle runs on with the last it has seen; the linear encoder has no time stamp of its own."""
    rig = Rig()
    start_encoders(rig)
    assert frames_of(rig, name, 50)
    setattr(rig, alive, False)
    rig.run(10)
    assert not frames_of(rig, name, 300)
    assert frames_of(rig, "PressA", 50), "the rest goes on"


@pytest.mark.parametrize("sample_ms", [1.0, 10.0])
def test_a_plc_that_samples_faster_than_it_answers_passes_commands_on(sample_ms: float) -> None:
    rig = Rig()
    rig.bridge = Bridge(msgspec.structs.replace(profile("valves"), plc=Plc("valves", sample_ms)), DATABASE)
    rig.run(50, arm=0, mode=0)
    rig.run(100, Slew=50.0)
    assert rig.command.mode is Mode.VALVES
    rig.samples = False
    rig.run(30, Slew=50.0)
    assert rig.command.mode is Mode.VALVES
    rig.run(20, Slew=50.0)
    assert rig.command == Command() and rig.bridge.gate.exit == 9


def test_pressures_are_sent_once_per_cycle_of_the_plc() -> None:
    rig = Rig()
    rig.run(100)
    assert len(frames_of(rig, "PressA", 100)) == 10
    rig.answers = False
    rig.run(5)
    assert not frames_of(rig, "PressA", 35) and rig.sent, "it still answers, with nothing new"


def test_an_answer_that_took_longer_than_50_ms_is_not_used() -> None:
    shake = Handshake()
    status = plc.status_registers(Feedback(state=State.HOLD, heartbeat=1), 300, WordOrder.HIGH_FIRST)
    shake.registers(Command(), 100 * MS)
    assert not shake.accept_registers(status, 151 * MS) and shake.dropped == 1
    assert shake.accept_registers(status, 149 * MS)


@pytest.mark.parametrize("what", ["bridge", "conversation with the PLC"])
def test_a_new_beginning_under_an_armed_controller_waits_for_a_disarm(what: str) -> None:
    """A bridge that is started again does not go on where another one ended."""
    rig = passing()
    if what == "bridge":
        rig.bridge = Bridge(profile("valves"), DATABASE)
    else:
        rig.bridge.handshake.connected()
    rig.run(300, Slew=50.0)
    assert rig.command == Command() and rig.bridge.gate.locked
    rig.run(20, arm=0, mode=0)
    rig.run(20, Slew=50.0)
    assert rig.command.mode is Mode.VALVES


def test_commands_that_come_60_ms_late_in_order_are_not_passed_on() -> None:
    rig = passing()
    travelling: list[tuple[int, list[Frame]]] = []
    delay_ns = 0
    for n in range(200):
        delay_ns = min(60 * MS, n * MS)
        sync, *commands = rig.control(Slew=50.0)
        travelling.append((rig.now_ns + delay_ns, commands))
        arrived = [sync]
        while travelling and travelling[0][0] <= rig.now_ns:
            arrived += travelling.pop(0)[1]
        rig.step([Frame(rig.now_ns, *frame[1:]) for frame in arrived])
        assert delay_ns > 40 * MS or n < 2 or rig.command.mode is Mode.VALVES
    assert rig.command == Command() and rig.bridge.gate.exit == 5


def test_corrupt_commands_do_not_end_the_lock() -> None:
    rig = passing()
    rig.run(20, Slew=50.0, enable=0)
    assert rig.bridge.gate.locked
    key = DATABASE.message("ValveCmdB").key
    for _ in range(6):
        rig.step([f if f.key != key else Frame(f.stamp_ns, key, bytes(8)) for f in rig.control(Slew=50.0)])
    assert rig.bridge.gate.locked


def test_handshake_measures_the_round_trip_by_the_echo() -> None:
    shake = Handshake()
    for n in range(1, 11):
        shake.datagram(Command(), n * 10 * MS)
    reply = Feedback(state=State.HOLD)
    assert shake.accept_datagram(encode_reply(Header(7, 1, 0, 8), reply), 104 * MS)
    assert (shake.round_trip.count, shake.round_trip.longest_ns) == (1, 24 * MS)
    assert shake.acknowledged(154 * MS) and not shake.acknowledged(155 * MS)
    assert not shake.accept_datagram(encode_reply(Header(7, 1, 0, 9), reply), 105 * MS), "old"
    assert not shake.accept_datagram(encode_reply(Header(7, 2, 0, 9), reply)[:-1], 106 * MS), "cut"
    assert not shake.accept_datagram(encode_reply(Header(7, 3, 0, 99), reply), 107 * MS), "never sent"
    assert not shake.accept_datagram(encode_reply(Header(7, 3, 0, 5), reply), 107 * MS), "to a command of 57 ms ago"
    assert shake.accept_datagram(encode_reply(Header(7, 3, 0, 9), reply), 107 * MS)
    assert (shake.round_trip.count, shake.dropped, shake.replayed) == (2, 1, 3)


def test_only_an_answer_to_a_hello_begins_a_session() -> None:
    """A late reply of the session before would bring it back."""
    shake, reply = Handshake(), Feedback(state=State.HOLD)
    shake.datagram(Command(), 10 * MS)
    assert shake.accept_datagram(encode_reply(Header(7, 1, 0, 1), reply), 20 * MS)
    for n in range(2, 33):
        shake.datagram(Command(), n * 10 * MS)
    shake.datagram(Command(), 330 * MS)  # the session is over
    assert not shake.accept_datagram(encode_reply(Header(7, 2, 0, 32), reply), 331 * MS)
    assert not shake.accept_datagram(encode_reply(Header(0, 3, 0, 33), reply), 332 * MS), "no session is offered"
    assert shake.accept_datagram(encode_reply(Header(8, 4, 0, 33), reply), 333 * MS)
    assert (shake.sessions, shake.replayed) == (2, 2)


def test_plc_of_another_word_order_is_refused() -> None:
    shake = Handshake(WordOrder.HIGH_FIRST)
    status = plc.status_registers(Feedback(state=State.HOLD), 300, WordOrder.LOW_FIRST)
    assert not shake.accept_registers(status, 0)
    assert shake.feedback is None and "LOW_FIRST" in shake.problem


def test_machine_without_a_plc_or_with_a_carrier_is_refused() -> None:
    with pytest.raises(ConfigError, check=coded("config.no-plc")):
        role_of(load_profile("palms_471"))
    with pytest.raises(ConfigError, check=coded("config.plc-carrier")):
        role_of(msgspec.structs.replace(load_profile("aoro_fc8"), plc=Plc("valves")))
    assert role_of(profile("references")) is Role.REFERENCES


def test_the_summary_of_an_exchange_is_json_with_the_emergency_stop_frame_as_hex() -> None:
    rig = Rig()
    rig.run(100)
    told = json.loads(summary(rig.bridge))
    assert told["answers"] > 0 and told["feedback"]["estop_frame"] == rig.feedback.estop_frame.hex()


# -- a machine in this process -----------------------------------------------------------------------------------------


class Flaky:
    """Refuses its first connection, is lost at its third sample, and ends the test at its fifth."""

    def __init__(self) -> None:
        self.calls: list[str] = []

    def _note(self, call: str) -> int:
        self.calls.append(call)
        return self.calls.count(call)

    def connect(self) -> None:
        if self._note("connect") == 1:
            raise ConnectionRefusedError("nobody listens")

    def act(self, command: Command) -> None:
        self._note("act")

    def observe(self) -> Feedback:
        count = self._note("observe")
        if count == 3:
            raise TimeoutError("no answer")
        if count == 5:
            raise asyncio.CancelledError
        return Feedback(heartbeat=count, state=State.HOLD)

    def disconnect(self) -> None:
        self._note("disconnect")


def test_a_machine_is_connected_again_after_every_loss(monkeypatch: pytest.MonkeyPatch) -> None:
    async def at_once(_: float) -> None:
        pass

    monkeypatch.setattr(process.asyncio, "sleep", at_once)
    bridge, machine = Bridge(profile("valves"), DATABASE), Flaky()
    with pytest.raises(asyncio.CancelledError):
        asyncio.run(process.MachineLink(bridge, machine).run())
    lost = ["connect", "disconnect"], ["connect", "act", "observe", "act", "observe", "act", "observe", "disconnect"]
    assert machine.calls == [*lost[0], *lost[1], "connect", "act", "observe", "act", "observe"]
    shake = bridge.handshake
    assert (shake.sessions, shake.sent, shake.answers, shake.dropped) == (2, 5, 3, 2)
    assert shake.feedback is not None and shake.feedback.accepted == 4, "the number of the command that it has executed"


def test_a_machine_that_is_not_installed_ends_the_bridge_before_it_opens_a_bus(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(process, "keep_memory", lambda: None)
    monkeypatch.setattr(process, "open_bus", lambda *_, **__: pytest.fail("a bus was opened"))
    path = write_plc_profile("palms_471", "valves", tmp_path)
    assert process.main(["--profile", str(path), "--machine", "nobody"]) == 3
    with pytest.raises(SystemExit, match="2"):
        process.main(["--profile", str(path), "--machine", "nobody", "--key-file", str(path)])


def test_rate_is_the_controllers_and_within_its_range(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A bridge for 200 Hz takes every command of 100 Hz as late after nine of them."""
    rates: list[int] = []

    def made(profile: Profile, *_: object) -> Bridge:
        rates.append(profile.rate_hz)
        raise ConfigError("config.test", "enough")

    monkeypatch.setattr(process, "keep_memory", lambda: None)
    monkeypatch.setattr(process, "Bridge", made)
    path = str(write_plc_profile("palms_471", "valves", tmp_path))
    for rate in ([], ["--rate", "100"], ["--rate", "40"]):
        assert process.main(["--profile", path, "--modbus", "127.0.0.1:1502", *rate]) == 3
    assert rates == [200, 100] and "40 Hz is not possible" in capsys.readouterr().err


# -- the joint references, only for a PLC that closes the joint loops, and only within the frames' range

HERE, SPEEDS = (0.1, 0.7, -1.6, 0.5, 3.0), (0.35, -0.15, 0.28, 0.25, -1.0)


def referred(
    position: tuple[float, ...] = HERE, speeds: tuple[float, ...] = SPEEDS, moving: bool = True
) -> dict[str, Any]:
    """The joint references that a PLC of that role is sent."""
    frames, found = list[RawFrame](), dict[str, Any]()
    CraneWriter(DATABASE, profile("references")).references(position, speeds, moving, frames)
    for (key, data), name in zip(frames, REFERENCES, strict=True):
        codec = DATABASE.message(name)
        assert key == codec.key
        found |= values_of(codec, data)
    return found


@pytest.mark.parametrize("role", [None, "valves"])
def test_only_a_plc_with_role_references_gets_them(role: str | None) -> None:
    frames: list[RawFrame] = []
    CraneWriter(DATABASE, profile(role)).references(HERE, SPEEDS, True, frames)
    assert not frames


def test_references_carry_position_and_commanded_velocity() -> None:
    found = referred()
    for name, position, speed in zip(NAMES, HERE, SPEEDS, strict=True):
        assert found[name] == pytest.approx(position, abs=1.01e-4)
        assert found[f"{name}Rate"] == pytest.approx(speed, abs=5.01e-4)


def test_references_at_rest_unknown_or_out_of_range_are_not_available() -> None:
    at_rest = referred(moving=False)
    assert at_rest["Slew"] is at_rest["RotRate"] is None
    found = referred((math.nan, 0.7, 1e9, 0.5, -math.inf), (0.0, 2.0, 0.0, 0.1, 0.0))
    assert [found[n] for n in ("Slew", "Lift", "Tilt", "Rot")] == [None] * 4
    assert found["Ext"] == pytest.approx(0.5, abs=1e-4) and found["ExtRate"] == pytest.approx(0.1, abs=1e-3)


def test_joint_range_beyond_the_frames_is_refused_at_start() -> None:
    wide = profile("references")
    slew = msgspec.structs.replace(wide.joints["slew"], upper=3.5)
    with pytest.raises(ConfigError, check=coded("config.reference-range")):
        CraneWriter(DATABASE, msgspec.structs.replace(wide, joints=wide.joints | {"slew": slew}))
