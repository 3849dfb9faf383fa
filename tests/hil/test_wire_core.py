"""The pure bus: arbitration, time, queues, error states, restart, and frame lengths against a slow computation."""

from __future__ import annotations

from collections import deque

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from can_dbc.bus.base import ERR_ACK, ERR_BUSOFF, ERR_CRTL, ERR_RESTARTED, BusState
from can_dbc.frame import ERROR, EXTENDED, REMOTE, Frame
from hil.wire.core import Node, WireCore, frame_bits, priority
from hil.wire.faults import Fault, Kind
from hil.wire.inprocess import InProcessBus
from runtime.errors import InputRefused
from tests.codes import coded

BIT_NS = 1000
MS = 1_000_000

KEYS = st.integers(0, 0x7FF) | st.integers(0, 0x1FFF_FFFF).map(lambda i: i | EXTENDED)
TRAFFIC = st.lists(
    st.tuples(st.integers(0, 2_000_000), st.integers(0, 3), KEYS, st.binary(max_size=8)), max_size=60
).map(lambda rows: sorted(rows, key=lambda row: row[0]))


def frame_ns(key: int, data: bytes) -> int:
    """Time from start of frame to end of frame at 1 Mbit/s."""
    return (frame_bits(key, data) + 10) * BIT_NS


def core_with(count: int, **options: int) -> tuple[WireCore, list[Node]]:
    core = WireCore(1_000_000, "test", **options)
    return core, [core.attach(f"n{i}", queue_limit=100) for i in range(count)]


@given(TRAFFIC)
@settings(max_examples=150)
def test_the_frame_of_highest_priority_wins_the_idle_bus(rows: list[tuple[int, int, int, bytes]]) -> None:
    """Replays what the bus did and checks every decision against all queues as they stood then."""
    core, nodes = core_with(4)
    finished: list[tuple[Node, Frame]] = []
    for at_ns, who, key, data in rows:
        finished += core.advance(at_ns)
        assert core.submit(nodes[who], key, data)
    finished += core.advance(1_000 * MS)
    assert len(finished) == len(rows)
    queues = [deque(row for row in rows if row[1] == who) for who in range(4)]
    free_ns = used_ns = 0
    for sender, frame in finished:
        start_ns = frame.stamp_ns - frame_ns(frame.key, frame.data)
        heads = [queue[0] for queue in queues if queue]
        assert start_ns == max(free_ns, min(head[0] for head in heads))
        waiting = [priority(head[2]) for head in heads if head[0] <= start_ns]
        assert priority(frame.key) == min(waiting)
        row = queues[nodes.index(sender)].popleft()
        assert row[2:] == (frame.key, frame.data)
        free_ns = frame.stamp_ns + 3 * BIT_NS
        used_ns += free_ns - start_ns
    assert core.busy_ns == used_ns


@given(TRAFFIC, st.lists(st.integers(1, 500_000), max_size=30))
@settings(max_examples=60)
def test_the_result_does_not_depend_on_the_time_steps(
    rows: list[tuple[int, int, int, bytes]], steps: list[int]
) -> None:
    def run(extra: list[int]) -> list[tuple[str, Frame]]:
        core, nodes = core_with(4)
        finished: list[tuple[Node, Frame]] = []
        now_ns = 0
        for at_ns, who, key, data in rows:
            while extra and now_ns + extra[0] < at_ns:
                now_ns += extra.pop(0)
                finished += core.advance(now_ns)
            now_ns = at_ns
            finished += core.advance(at_ns)
            core.submit(nodes[who], key, data)
        finished += core.advance(1_000 * MS)
        return [(node.name, frame) for node, frame in finished]

    assert run(list(steps)) == run([])


def test_a_frame_arrives_at_its_last_bit() -> None:
    core, (a, b) = core_with(2)
    core.advance(5 * MS)
    core.submit(a, 0x123, b"12345678")
    end_ns = 5 * MS + frame_ns(0x123, b"12345678")
    assert core.advance(end_ns - 1) == [] and b.rx == []
    assert core.next_ns() == end_ns
    core.advance(end_ns)
    assert b.take() == [Frame(end_ns, 0x123, b"12345678")] and b.rx == [] and a.rx == []
    assert core.next_ns() is None


def test_time_cannot_go_back() -> None:
    core, _ = core_with(1)
    core.advance(10)
    with pytest.raises(InputRefused, check=coded("wire.time-reversed")):
        core.advance(9)


@pytest.mark.parametrize("bitrate", [0, -1, 3])
def test_a_bit_is_a_whole_number_of_ns(bitrate: int) -> None:
    with pytest.raises(InputRefused, check=coded("wire.bitrate")):
        WireCore(bitrate)


def test_a_full_transmit_queue_refuses() -> None:
    core = WireCore(1_000_000)
    a = core.attach("a")
    core.attach("b")
    assert [core.submit(a, 0x100, b"") for _ in range(11)] == [True] * 10 + [False]
    assert a.refused == 1
    core.advance(1 * MS)
    assert core.submit(a, 0x100, b"")


def test_a_full_receive_queue_drops_and_counts() -> None:
    core = WireCore(1_000_000)
    a = core.attach("a", queue_limit=100)
    slow, quick = core.attach("slow", rx_limit=3), core.attach("quick")
    for i in range(8):
        core.submit(a, i, b"")
    core.advance(10 * MS)
    assert [frame.key for frame in slow.take()] == [0, 1, 2] and slow.dropped == 5
    assert len(quick.take()) == 8 and quick.dropped == 0


def test_a_lone_sender_becomes_passive_and_never_bus_off() -> None:
    """ISO 11898-1: without an acknowledge TEC rises by 8 up to 128 and then stays."""
    core, (a,) = core_with(1)
    core.submit(a, 0x100, b"")
    core.advance(1_000 * MS)
    assert (a.tec, a.state) == (128, BusState.PASSIVE)
    errors = a.take()
    assert len(errors) == 16 and all(frame.key & (ERROR | ERR_ACK) == ERROR | ERR_ACK for frame in errors)
    changed = [i for i, frame in enumerate(errors) if frame.key & ERR_CRTL]
    assert changed == [11, 15]  # 12 x 8 = 96 warns, 16 x 8 = 128 is passive
    assert core.next_ns() is None

    b = core.attach("b")
    core.advance(1_002 * MS)
    assert [frame.key for frame in b.take()] == [0x100]
    assert (a.tec, a.state) == (127, BusState.WARNING)


def test_good_frames_lower_the_error_counters() -> None:
    core, (a, b) = core_with(2)
    core.inject(Fault(Kind.ERROR, end_ns=1 * MS))
    core.submit(a, 0x100, b"")
    core.advance(3 * MS)
    tec, rec = a.tec, b.rec
    assert tec > rec > 0
    assert a.rx[0].data[2:4] == b"\x80\x08" and b.rx[0].data[2:4] == b"\x00\x08"  # transmitter, CRC
    for _ in range(tec):
        core.submit(a, 0x100, b"")
        core.advance(core.now_ns + MS)
    assert (a.tec, b.rec, a.state) == (0, 0, BusState.ACTIVE)


def test_bus_off_flushes_refuses_and_restarts() -> None:
    core, (a, b) = core_with(2, restart_ns=100 * MS)
    core.inject(Fault(Kind.ERROR, end_ns=20 * MS, node="n0"))
    core.submit(a, 0x100, b"old")
    core.submit(a, 0x101, b"old")
    core.advance(20 * MS)
    assert a.state is BusState.OFF and not core.submit(a, 0x102, b"")
    assert (len(a.queue), a.done) == (0, 2)
    assert b.state is BusState.ACTIVE  # 32 errors at one each stay below the warning limit
    off = a.take()
    assert off[-1].key & ERR_BUSOFF and len(off) == 32
    core.submit(b, 0x200, b"")
    core.advance(60 * MS)
    assert a.rx == []  # off means off: it hears nothing
    core.advance(off[-1].stamp_ns + 100 * MS)
    assert a.state is BusState.ACTIVE and a.tec == 0
    assert [frame.key & ERR_RESTARTED for frame in a.take()] == [ERR_RESTARTED]
    restarted_ns = core.now_ns
    core.submit(a, 0x103, b"new")
    b.take()
    core.advance(restarted_ns + 10 * MS)
    frames = [frame for frame in b.take() if not frame.key & ERROR]
    assert [frame.data for frame in frames] == [b"new"]
    assert frames[0].stamp_ns == restarted_ns + 128 * 11 * BIT_NS + frame_ns(0x103, b"new")


def test_without_automatic_restart_a_node_stays_bus_off_until_restarted() -> None:
    core, (a, _) = core_with(2, restart_ns=0)
    core.inject(Fault(Kind.ERROR, end_ns=20 * MS))
    core.submit(a, 0x100, b"")
    core.advance(10_000 * MS)
    assert a.state is BusState.OFF
    core.restart(a)
    assert a.state is BusState.ACTIVE and core.submit(a, 0x100, b"")


def test_a_passive_sender_pauses_before_its_next_frame() -> None:
    core, (a, _) = core_with(2)
    a.tec = 200
    core.submit(a, 0x100, b"")
    core.submit(a, 0x100, b"")
    (_, first), (_, second) = core.advance(10 * MS)
    assert second.stamp_ns - first.stamp_ns == frame_ns(0x100, b"") + (3 + 8) * BIT_NS


def test_a_detached_node_loses_its_pending_frames() -> None:
    core, (a, b) = core_with(2)
    c = core.attach("c")
    core.submit(a, 0x100, b"")
    core.submit(c, 0x200, b"")
    core.advance(10_000)
    core.detach(a)  # in the middle of its frame
    core.advance(10 * MS)
    assert [frame.key for frame in b.take()] == [0x200]


def test_a_retired_node_sends_its_queue_unless_nobody_acknowledges() -> None:
    core, (a, b) = core_with(2)
    for key in (0x100, 0x101):
        core.submit(a, key, b"")
    core.submit(b, 0x200, b"")
    core.retire(a)
    core.advance(MS // 4)
    assert [frame.key for frame in b.take()][:2] == [0x100, 0x101] and a.rx == [] and core.nodes == [b]
    assert 0 < b.tec < 128  # alone now: nobody acknowledges
    core.retire(b)
    core.advance(5 * MS)
    assert core.nodes == []


def test_the_in_process_bus_follows_the_state_of_its_node() -> None:
    core = WireCore(1_000_000)
    a = InProcessBus(core, "a", tx_queue=1)
    assert a.send(0x100, b"") and not a.send(0x100, b"")
    core.advance(100 * MS)
    assert a.drain([]) == 0
    assert (a.stats.state, a.stats.tx_errors, a.stats.error_frames) == (BusState.PASSIVE, 128, 16)
    with InProcessBus(core, "b") as b:
        frames: list[Frame] = []
        core.advance(101 * MS)
        assert b.drain(frames) == b.stats.received == 1
    assert len(core.nodes) == 1 and a.fileno() == -1


def test_the_in_process_bus_drops_frames_from_before_a_recovery() -> None:
    core = WireCore(1_000_000, restart_ns=10 * MS)
    a, b = InProcessBus(core, "a"), InProcessBus(core, "b")
    b.send(0x100, b"old")
    core.advance(1 * MS)
    core.inject(Fault(Kind.ERROR, start_ns=core.now_ns, node="a"))
    a.send(0x200, b"never")
    core.advance(8 * MS)
    assert a.node.state is BusState.OFF
    core.heal()
    core.advance(30 * MS)
    b.send(0x101, b"new")
    core.advance(31 * MS)
    frames: list[Frame] = []
    a.drain(frames)
    assert [frame.key for frame in frames] == [0x101]
    assert (a.stats.state, a.stats.recoveries, a.stats.received) == (BusState.ACTIVE, 1, 1)


def test_discarding_keeps_the_frame_on_the_bus_and_counts_the_others() -> None:
    core, (a, b) = core_with(2)
    for i in range(5):
        core.submit(a, 0x100 + i, b"")
    core.advance(core.now_ns + 20_000)  # the first one is under way
    a.discard()
    assert a.done == 4 and len(a.queue) == 1
    core.advance(core.now_ns + MS)
    assert [frame.key for frame in b.take()] == [0x100] and a.done == 5
    core.submit(a, 0x200, b"")
    a.discard()  # not begun yet
    core.advance(core.now_ns + MS)
    assert b.take() == [] and a.done == 6


# -- frame lengths and the order of arbitration ------------------------------------------------------------------------

STANDARD = st.integers(0, 0x7FF)
PAYLOADS = st.binary(max_size=8) | st.sampled_from([b"\0", b"\xff"]).flatmap(
    lambda byte: st.integers(0, 8).map(lambda n: byte * n)
)


def bits_of(value: int, count: int) -> str:
    return format(value, f"0{count}b") if count else ""


def arbitration_field(key: int) -> str:
    """Identifier, RTR or SRR, IDE and what follows up to RTR, as on the bus."""
    remote = "1" if key & REMOTE else "0"
    if key & EXTENDED:
        identifier = bits_of(key & 0x1FFF_FFFF, 29)
        return identifier[:11] + "11" + identifier[11:] + remote
    return bits_of(key & 0x7FF, 11) + remote + "0"


def slow_length(key: int, data: bytes) -> int:
    reserved = "00" if key & EXTENDED else "0"
    payload = "" if key & REMOTE else "".join(bits_of(byte, 8) for byte in data)
    bits = "0" + arbitration_field(key) + reserved + bits_of(len(data), 4) + payload
    crc = 0
    for bit in bits:  # the algorithm as the standard prints it
        crc_next = int(bit) ^ (crc >> 14)
        crc = (crc << 1) & 0x7FFF
        if crc_next:
            crc ^= 0x4599
    stuffed = ""
    for bit in bits + bits_of(crc, 15):
        stuffed += bit
        if stuffed[-5:] in ("00000", "11111"):
            stuffed += "1" if bit == "0" else "0"
    return len(stuffed)


@given(KEYS, PAYLOADS, st.sampled_from([0, REMOTE]))
def test_length_equals_the_bit_by_bit_computation(key: int, data: bytes, remote: int) -> None:
    assert frame_bits(key | remote, data) == slow_length(key | remote, data)


@given(KEYS, PAYLOADS)
def test_length_is_within_the_bounds_of_davis_and_others(key: int, data: bytes) -> None:
    bare = (54 if key & EXTENDED else 34) + 8 * len(data)
    assert bare <= frame_bits(key, data) <= bare + (bare - 1) // 4


def test_all_zeros_are_stuffed_after_every_fifth_bit() -> None:
    """The CRC of zeros is zero, so identifier 0 with no data is a run of 34 dominant bits."""
    assert frame_bits(0, b"") == 34 + 34 // 5


@given(KEYS, KEYS)
def test_priority_has_the_order_of_the_arbitration_bits(left: int, right: int) -> None:
    """The first differing bit decides, dominant (0) wins: the order of the strings."""
    one, other = arbitration_field(left).ljust(32, "0"), arbitration_field(right).ljust(32, "0")
    assert (priority(left) < priority(right)) == (one < other)


@given(STANDARD, st.integers(0, 0x3FFFF))
def test_a_standard_frame_wins_over_an_extended_one_of_the_same_base(base: int, low: int) -> None:
    assert priority(base | REMOTE) < priority(base << 18 | low | EXTENDED)
    assert priority(base) < priority(base | REMOTE)
