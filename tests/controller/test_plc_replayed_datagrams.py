"""Bridge and PLC over datagrams: recorded ones are refused on both sides, after any silence or restart."""

from __future__ import annotations

from itertools import count

import pytest

from can_dbc.plc.datagram import encode_reply
from can_dbc.plc.map import Command, Mode, Role, State
from controller.plc.handshake import Handshake
from machine.loading.profile_file import load_profile
from sim.plc.program import MOTION_ALLOWED, Inputs, Program

MS = 1_000_000
HOME = (0.0, 0.75, -1.6, 0.3, 0.0)
MOVE = Command(Mode.VALVES, True, (0.5, 0, 0, 0, 0, 0, 0))
US = ("127.0.0.1", 5)
PROFILE = load_profile("palms_471")
KEY = b"a key of sixteen"


class Rig:
    """A PLC's program and a bridge's handshake; an exchange every 10 ms, everything recorded."""

    def __init__(self, key: bytes | None = None) -> None:
        self._starts = count(1000, 1000)
        self._key = key
        self.now_ns = 1_000 * MS
        self.start_plc()
        self.start_bridge()
        self.commands: list[bytes] = []
        self.replies: list[bytes] = []

    def start_plc(self) -> None:
        numbers = count(next(self._starts))
        inputs = Inputs(HOME, (10.0,) * 8, 1.0, 0.0, int(MOTION_ALLOWED))
        self.plc = Program(PROFILE, Role.VALVES, lambda _: inputs, draw=lambda: next(numbers), key=self._key)

    def start_bridge(self) -> None:
        self.bridge = Handshake(key=self._key, first_sequence=next(self._starts))

    def exchange(self, command: Command) -> None:
        self.now_ns += 10 * MS
        self.plc.scan(self.now_ns)
        data = self.bridge.datagram(command, self.now_ns)
        self.commands.append(data)
        session = self.plc.arbiter.session
        header = self.plc.arbiter.datagram(US, data, self.now_ns)
        if header is None and session.number:
            header = session.reply_header(self.now_ns)
        if header is not None:
            self.replies.append(encode_reply(header, self.plc.feedback, self._key))
            self.bridge.accept_datagram(self.replies[-1], self.now_ns)

    def run(self, ms: int, command: Command) -> None:
        for _ in range(ms // 10):
            self.exchange(command)

    def silence(self, ms: int) -> None:
        for _ in range(ms):
            self.now_ns += MS
            self.plc.scan(self.now_ns)

    def replay(self) -> None:
        """Everything that was on the cable before, to both sides."""
        for data in self.commands:
            self.plc.arbiter.datagram(US, data, self.now_ns)
        for data in self.replies:
            assert not self.bridge.accept_datagram(data, self.now_ns)


def moving(key: bytes | None = None) -> Rig:
    rig = Rig(key)
    rig.run(100, Command())
    rig.run(500, MOVE)
    assert rig.plc.state is State.EXECUTE and rig.bridge.fresh(rig.now_ns)
    return rig


@pytest.mark.parametrize("key", [None, KEY])
@pytest.mark.parametrize("silence_ms", [51, 60, 5_000])
def test_nothing_recorded_counts_after_a_silence(silence_ms: int, key: bytes | None) -> None:
    rig = moving(key)
    rig.silence(silence_ms)
    assert not rig.bridge.fresh(rig.now_ns)
    accepted, answers = rig.plc.arbiter.accepted, rig.bridge.answers
    rig.replay()
    assert (rig.plc.arbiter.accepted, rig.bridge.answers) == (accepted, answers)
    assert rig.plc.arbiter.replayed == len(rig.commands) - 1, "all but the hello, which commands nothing"
    assert rig.bridge.replayed == len(rig.replies)
    rig.silence(20)
    assert (not rig.bridge.fresh(rig.now_ns) and not any(rig.plc.outputs[:5])) or silence_ms < 100


@pytest.mark.parametrize("side", ["bridge", "plc", "both"])
def test_nothing_recorded_counts_after_a_restart(side: str) -> None:
    rig = moving()
    if side != "plc":
        rig.start_bridge()
    if side != "bridge":
        rig.start_plc()
        rig.silence(20)
    accepted = rig.plc.arbiter.accepted
    rig.replay()
    assert rig.plc.arbiter.accepted == accepted
    assert rig.bridge.replayed == len(rig.replies)
    assert rig.bridge.feedback is None or side == "plc"


@pytest.mark.parametrize("side", ["bridge", "plc"])
def test_after_a_restart_the_two_find_each_other_again_and_begin_neutral(side: str) -> None:
    rig = moving()
    before = rig.bridge.sessions
    if side == "bridge":
        rig.start_bridge()
        before = 0
    else:
        rig.start_plc()
    rig.run(500, MOVE)
    assert rig.plc.arbiter.command == Command(), "a session never begins with an armed command"
    rig.run(400, Command())
    assert rig.bridge.fresh(rig.now_ns) and rig.bridge.sessions > before
    rig.run(50, Command(reset=True))
    rig.run(50, Command())
    rig.run(100, MOVE)
    assert rig.plc.state is State.EXECUTE


def test_a_short_silence_does_not_end_the_session() -> None:
    rig = moving()
    session = rig.plc.arbiter.session.number
    rig.silence(80)
    assert rig.plc.state is State.HOLD
    rig.run(30, MOVE)
    assert rig.plc.state is State.EXECUTE and rig.plc.arbiter.session.number == session
    assert rig.bridge.sessions == 1


def test_datagrams_that_a_queue_delays_by_60_ms_in_order_are_not_used() -> None:
    """Both directions: what they echo tells their age, whatever was the delay at the start."""
    rig = moving()
    on_the_way: list[tuple[int, bytes]] = []
    accepted = rig.plc.arbiter.accepted
    for _ in range(50):
        rig.now_ns += 10 * MS
        rig.plc.scan(rig.now_ns)
        on_the_way.append((rig.now_ns + 60 * MS, rig.bridge.datagram(MOVE, rig.now_ns)))
        while on_the_way and on_the_way[0][0] <= rig.now_ns:
            rig.plc.arbiter.datagram(US, on_the_way.pop(0)[1], rig.now_ns)
        session = rig.plc.arbiter.session
        rig.bridge.accept_datagram(encode_reply(session.reply_header(rig.now_ns), rig.plc.feedback), rig.now_ns)
    assert rig.plc.arbiter.accepted == accepted
    assert not any(rig.plc.outputs[:5]) and not rig.bridge.fresh(rig.now_ns)
