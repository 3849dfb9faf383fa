"""The emulated nodes on virtual time: SYNC, SDO, NMT, watchdogs, E-stop, and every frame valid by the DBC."""

from __future__ import annotations

import hashlib
import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from can_dbc.dbc.codec import load
from can_dbc.frame import Frame
from can_dbc.protocols.canopen import (
    NmtCommand,
    download_request,
    nmt_frame,
    parse_emergency,
    parse_response,
    sync_frame,
    upload_request,
)
from can_dbc.protocols.e2e import Checker, Sender, Status
from machine.loading.profile_file import load_profile
from machine.sensing import position_from_counts
from sim.nodes.valve import ExitCode, ValveState
from sim.plant import Plant

PROFILE = load_profile("palms_471")
CRANE = load("crane")
T_NS = 5_000_000
START_NS = 1_000_000_000_000


class Bench:
    """A plant and a minimal bus master; ``cycle`` is one control period."""

    def __init__(self, seed: int = 0) -> None:
        self.plant = Plant(PROFILE, seed)
        self.now_ns = START_NS
        names = ("ValveCmdA", "ValveCmdB", "GuardStat", "GuardPilot")
        self._senders = {n: Sender(CRANE.message(n).data_ids) for n in names}
        self.sent: list[tuple[int, bytes]] = []
        self.exchange([])

    def exchange(self, frames: list[tuple[int, bytes]], advance_ns: int = 0) -> list[tuple[int, bytes]]:
        self.now_ns += advance_ns
        received = [("crane0", Frame(self.now_ns - advance_ns, k, d)) for k, d in frames]
        out = [(k, d) for bus, k, d in self.plant.step(self.now_ns, received) if bus == "crane0"]
        self.sent += out
        return out

    def message(self, name: str, *values: float) -> tuple[int, bytes]:
        codec = CRANE.message(name)
        return codec.key, self._senders[name].protect(codec.encode(0, 0, *values))

    def cycle(
        self, n: int = 1, spools=(0.0,) * 4, arm=0xA, guard=0xA, grapple=(0.0, 0), commands=True, sync=True, pilot=0xA
    ):
        out = []
        for _ in range(n):
            frames = [self.message("GuardStat", guard, 0, 15, 0, 0, 0)] if guard is not None else []
            frames += [self.message("GuardPilot", pilot, 0, 0)] if pilot is not None else []
            if commands:
                frames.append(self.message("ValveCmdA", 2, *spools))
                frames.append(self.message("ValveCmdB", arm, 0.0, grapple[0], 0.0, grapple[1], 1, 100.0))
            if sync:
                frames.append(sync_frame(1))
            out += self.exchange(frames, T_NS)
        return out

    def last(self, name: str) -> dict:
        codec = CRANE.message(name)
        data = next(d for k, d in reversed(self.sent) if k == codec.key)
        return codec.named(codec.receive(data))

    def start_encoders(self) -> None:
        self.exchange([nmt_frame(NmtCommand.START)])


@pytest.fixture
def bench():
    b = Bench()
    yield b
    b.plant.close()


def test_all_nodes_boot_and_send_heartbeats(bench):
    nodes = {1, 2, 3, 4, 5, 6, 0x10, 0x20, 0x21, 0x22}
    assert {k - 0x700 for k, d in bench.sent if k > 0x700 and d == b"\x00"} == nodes
    bench.sent.clear()
    bench.cycle(60)
    for node in nodes:
        beats = [d for k, d in bench.sent if k == 0x700 + node]
        assert 2 <= len(beats) <= 4 and set(beats) == {b"\x7f" if node in range(2, 7) else b"\x05"}


def test_encoders_answer_sync_only_when_operational(bench):
    assert not [k for k, _ in bench.cycle(3) if 0x182 <= k <= 0x186]
    bench.start_encoders()
    out = bench.exchange([sync_frame(1)])
    assert [k for k, _ in out] == [0x182, 0x183, 0x184, 0x185, 0x186]
    true = bench.plant.joint_positions()
    for (key, data), (name, spec), q in zip(out, PROFILE.joints.items(), true, strict=True):
        codec = CRANE.find(key)
        assert codec is not None and codec.name == spec.encoder.message
        measured = position_from_counts(spec.encoder, codec.receive(data)[0])
        assert measured == pytest.approx(q, abs=2.5e-3), name
    bench.exchange([nmt_frame(NmtCommand.STOP, 3)])
    assert 0x183 not in [k for k, _ in bench.exchange([sync_frame(2)])]


def test_sdo_reads_the_profiles_values_and_refuses_unknown_objects(bench):
    for spec in PROFILE.joints.values():
        node = spec.encoder.node
        ((key, data),) = bench.exchange([upload_request(node, 0x1000, 0)])
        assert parse_response(key, data).unsigned == spec.encoder.device_type
        ((key, data),) = bench.exchange([upload_request(node, 0x6002, 0)])
        assert parse_response(key, data).unsigned == spec.encoder.total_counts
    ((key, data),) = bench.exchange([upload_request(5, 0x6005, 1)])
    assert parse_response(key, data).unsigned == 5000
    ((key, data),) = bench.exchange([upload_request(2, 0x7777, 0)])
    assert parse_response(key, data).abort == 0x06020000


def test_tpdo_mapping_and_validity_follow_sdo_writes(bench):
    bench.start_encoders()
    bench.exchange([download_request(2, 0x1800, 1, (0x8000_0182).to_bytes(4, "little"))])
    assert 0x182 not in [k for k, _ in bench.exchange([sync_frame(1)])]
    bench.exchange([download_request(2, 0x1A00, 0, b"\x01"), download_request(2, 0x1800, 1, b"\x82\x01\0\0")])
    assert {len(d) for k, d in bench.exchange([sync_frame(2)]) if k == 0x182} == {4}
    bench.exchange([download_request(2, 0x1017, 0, b"\0\0")])
    bench.sent.clear()
    bench.cycle(50)
    assert 0x702 not in [k for k, _ in bench.sent]


def test_an_nmt_reset_boots_again_without_the_configuration(bench):
    bench.start_encoders()
    bench.exchange([download_request(2, 0x1A00, 0, b"\x01")])
    out = bench.exchange([nmt_frame(NmtCommand.RESET_NODE)], T_NS)
    booted = {k - 0x700 for k, d in out if k > 0x700 and d == b"\x00"}
    assert booted == {1, 2, 3, 4, 5, 6, 0x10, 0x20, 0x21, 0x22}
    assert 0x182 not in [k for k, _ in bench.exchange([sync_frame(1)])]
    bench.start_encoders()
    assert {len(d) for k, d in bench.exchange([sync_frame(2)]) if k == 0x182} == {8}


def test_an_encoder_alarm_sends_an_emergency_and_clears_it(bench):
    bench.start_encoders()
    bench.plant.encoders["lift"].set_alarm(1)
    out = bench.exchange([sync_frame(1)])
    emergency = next(e for k, d in out if (e := parse_emergency(k, d)))
    assert (emergency.node, emergency.code, emergency.register) == (3, 0x5000, 1)
    assert bench.last("EncLift")["Alarms"] == 1
    bench.plant.encoders["lift"].set_alarm(0)
    cleared = [parse_emergency(k, d) for k, d in bench.exchange([])]
    assert [e.code for e in cleared if e] == [0]


def test_the_other_nodes_answer_identity_and_refuse_the_rest(bench):
    for node in (1, 0x10, 0x20, 0x21, 0x22):
        for request, value, abort in (
            (upload_request(node, 0x1017, 0), 100, 0),
            (upload_request(node, 0x1018, 2), node, 0),
            (upload_request(node, 0x6004, 0), 0, 0x0602_0000),
            (download_request(node, 0x1017, 0, b"\0\0"), 0, 0x0601_0002),
        ):
            ((key, data),) = bench.exchange([request])
            answer = parse_response(key, data)
            assert (answer.node, answer.abort) == (node, abort) and (abort or answer.unsigned == value)


def test_a_node_reports_its_own_fault_and_its_end_once(bench):
    bench.plant.valve.set_emergency(0x5030)
    bench.plant.valve.set_emergency(0x5030)
    (emergency,) = [e for k, d in bench.exchange([]) if (e := parse_emergency(k, d))]
    assert (emergency.node, emergency.code, emergency.register) == (0x10, 0x5030, 1)
    ((key, data),) = bench.exchange([upload_request(0x10, 0x1001, 0)])
    assert parse_response(key, data).unsigned == 1
    bench.plant.valve.set_emergency(0)
    cleared = [parse_emergency(k, d) for k, d in bench.exchange([])]
    assert [e.code for e in cleared if e] == [0]


def test_every_frame_is_valid_by_the_dbc_and_its_end_to_end_protection(bench):
    bench.start_encoders()
    bench.sent.clear()
    bench.cycle(40, spools=(40.0, -40.0, 30.0, 30.0))
    checkers = {m.key: Checker(m.data_ids) for m in CRANE.messages.values() if m.data_ids}
    counts: dict[str, int] = {}
    for key, data in bench.sent:
        codec = CRANE.find(key)
        assert codec is not None, hex(key)
        codec.receive(data)
        if key in checkers:
            assert checkers[key].check(data) in (Status.OK, Status.INITIAL)
        counts[codec.name] = counts.get(codec.name, 0) + 1
    for name, cycles in {"ValveFbA": 40, "ValveFbB": 40, "PressA": 40, "PressB": 40, "EncExt": 40}.items():
        assert counts[name] == cycles
    for name, cycles in {"EstopStat": 20, "GrappleStat": 10, "PlcStatus": 10, "PressC": 10}.items():
        assert counts[name] == cycles


def test_the_valve_follows_fresh_armed_commands_and_echoes_them(bench):
    q = bench.plant.joint_positions()
    bench.cycle(100, spools=(50.0, 0.0, 0.0, 0.0))
    assert bench.last("ValveFbA")["State"] == ValveState.ACTIVE
    assert bench.last("ValveFbA")["SpoolSlew"] == pytest.approx(50.0, abs=1.0)
    before = bench.last("ValveFbB")["EchoCounter"]
    bench.cycle(1)
    assert bench.last("ValveFbB")["EchoCounter"] == (before + 1) % 16
    assert bench.plant.joint_positions()[0] > q[0] + 0.02


@pytest.mark.parametrize(
    ("loss", "exit_code"),
    [
        ({"commands": False}, ExitCode.COMMAND_TIMEOUT),
        ({"guard": None}, ExitCode.GUARD_MISSING),
        ({"guard": 0}, ExitCode.GUARD_MISSING),
        ({"sync": False}, ExitCode.COMMAND_TIMEOUT),
    ],
)
def test_the_valve_goes_neutral_without_commands_and_needs_a_new_arming(bench, loss, exit_code):
    moving = {"spools": (60.0, 0.0, 0.0, 0.0)}
    bench.cycle(100, **moving)
    lost = moving | loss
    bench.cycle(11, **lost)
    assert bench.plant.valve.valve_state is not ValveState.ACTIVE
    bench.cycle(20, **lost)
    assert bench.last("ValveFbB")["ExitCode"] == exit_code
    assert bench.plant.valve.outputs_pct == [0.0] * 6
    bench.cycle(40, **lost)
    expected = ValveState.PILOT_OFF if loss.get("commands") is False else ValveState.FAULT
    assert bench.last("ValveFbA")["State"] == expected
    bench.cycle(20, **moving)
    assert bench.last("ValveFbA")["State"] == ValveState.FAULT and bench.plant.valve.outputs_pct[0] == 0.0
    bench.cycle(2, arm=0)
    assert bench.last("ValveFbA")["State"] == ValveState.NEUTRAL
    bench.cycle(20, **moving)
    assert bench.last("ValveFbA")["State"] == ValveState.ACTIVE


@pytest.mark.parametrize("pilot", [None, 0, 0xB])
def test_the_guard_switches_the_pilot_supply(bench, pilot):
    """By its own frame: without it, or when it says anything but on, the valves have no pilot pressure."""
    moving = {"spools": (60.0, 0.0, 0.0, 0.0)}
    bench.cycle(60, **moving)
    assert bench.last("EstopStat")["PilotSupply"] == 1
    bench.cycle(11 if pilot is None else 1, pilot=pilot, **moving)
    assert not bench.plant.estop.pilot_on and bench.plant.valve.outputs_pct == [0.0] * 6
    bench.cycle(2, pilot=pilot, **moving)
    stat = bench.last("EstopStat")
    assert (stat["ChannelA"], stat["PilotSupply"], stat["PilotPress"]) == (1, 0, 0.0)
    assert bench.last("ValveFbA")["State"] == ValveState.PILOT_OFF
    bench.cycle(2, arm=0)
    bench.cycle(10, **moving)
    assert bench.last("ValveFbA")["State"] == ValveState.ACTIVE, "it comes back with the frame"


def test_the_ramp_to_neutral_takes_sixty_milliseconds(bench):
    bench.cycle(60, spools=(60.0, 0.0, 0.0, 0.0))
    seen = []
    for _ in range(40):
        bench.cycle(1, commands=False)
        seen.append(bench.plant.valve.outputs_pct[0])
    assert seen == sorted(seen, reverse=True)
    assert seen[8] == 60.0 and 0.0 < seen[20] < 40.0 and seen[24] == 0.0


def test_a_wrong_arm_key_moves_nothing(bench):
    q = bench.plant.joint_positions()
    bench.cycle(60, spools=(80.0, 0.0, 0.0, 0.0), arm=0x5)
    assert bench.last("ValveFbA")["State"] == ValveState.NEUTRAL
    assert bench.plant.joint_positions()[0] == pytest.approx(q[0], abs=1e-3)


def test_the_emergency_stop_cuts_the_pilot_and_waits_for_reset(bench):
    moving = {"spools": (60.0, 0.0, 0.0, 0.0)}
    bench.cycle(60, **moving)
    bench.plant.estop.press()
    bench.cycle(2, **moving)
    stat = bench.last("EstopStat")
    assert (stat["ChannelA"], stat["ChannelB"], stat["PilotSupply"], stat["PilotPress"]) == (0, 0, 0, 0.0)
    assert bench.last("ValveFbA")["State"] == ValveState.PILOT_OFF
    assert bench.plant.valve.outputs_pct == [0.0] * 6
    bench.plant.estop.reset()
    assert not bench.plant.estop.pilot_on
    bench.plant.estop.release()
    bench.cycle(10, **moving)
    assert bench.last("ValveFbA")["State"] == ValveState.PILOT_OFF
    bench.cycle(60, arm=0)
    events = bench.last("EstopStat")["EventSeq"]
    bench.plant.estop.reset()
    bench.cycle(2, arm=0)
    assert bench.last("EstopStat")["ResetReq"] == 1 and bench.last("EstopStat")["PilotSupply"] == 1
    bench.cycle(60, arm=0)
    assert bench.last("EstopStat")["ResetReq"] == 0 and bench.last("EstopStat")["EventSeq"] != events
    bench.cycle(10, **moving)
    assert bench.last("ValveFbA")["State"] == ValveState.ACTIVE


def test_a_lost_command_never_opens_the_grapple(bench):
    bench.cycle(900, grapple=(-100.0, 2))
    assert bench.last("GrappleStat")["Opening"] < 1.0 and bench.last("GrappleStat")["ClampPress"] > 150.0
    bench.cycle(20, grapple=(100.0, 1))
    opening = bench.plant.world.opening
    bench.cycle(30, commands=False)
    assert bench.plant.valve.outputs_pct[5] == 0.0
    settled = bench.plant.world.opening
    bench.cycle(100, commands=False)
    assert bench.plant.world.opening == pytest.approx(settled, abs=5e-3) and settled < opening + 0.15


@settings(max_examples=40, deadline=None)
@given(st.lists(st.tuples(st.sampled_from([0, 0x80, 0x602, 0x605, 0x210, 0x1FD]), st.binary(max_size=8)), max_size=8))
def test_foreign_and_broken_frames_break_nothing(frames):
    shared.exchange(frames, T_NS)
    ((key, data),) = [(k, d) for k, d in shared.exchange([upload_request(6, 0x1000, 0)]) if k == 0x586]
    assert parse_response(key, data).unsigned == PROFILE.joints["rot"].encoder.device_type


shared = Bench()


def digest(seed: int) -> str:
    b = Bench(seed)
    b.start_encoders()
    b.cycle(150, spools=(40.0, -50.0, 60.0, 30.0), grapple=(-100.0, 2))
    h = hashlib.sha256(repr((b.sent, b.plant.logs(), b.plant.world.q)).encode())
    b.plant.close()
    return h.hexdigest()


def test_only_equal_seeds_give_equal_node_bytes():
    assert digest(3) == digest(3) != digest(4)


def test_frames_are_delivered_at_their_own_time(bench):
    bench.start_encoders()
    t = START_NS + 20_000_000
    for offset in (0, 7_500_000):
        assert bench.plant.next_ns == START_NS + 2_500_000 or offset
        received = [("crane0", Frame(START_NS + 5_000_000 + offset, *sync_frame(1)))]
        out = bench.plant.step(START_NS + 10_000_000 + offset, received)
        stamps = [int.from_bytes(d[4:6], "little") for _, k, d in out if k == 0x182]
        assert stamps == [(START_NS + 5_000_000 + offset) // 1000 & 0xFFFF]
    assert bench.plant.step(t, [("mach0", Frame(t, *sync_frame(1)))]) is not None
    assert math.isfinite(sum(bench.plant.tip()))
