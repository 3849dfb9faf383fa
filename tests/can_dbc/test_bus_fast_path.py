"""The receive code of SocketCAN on an AF_UNIX pair that carries the same struct can_frame: runs on every kernel."""

from __future__ import annotations

import errno
import os
import socket
import struct
from collections.abc import Iterator

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from can_dbc.bus.base import ERR_BUSOFF, ERR_RESTARTED, BusStats, Filter
from can_dbc.bus.batch import Batch, enlarge_receive_buffer
from can_dbc.bus.frame_socket import CAN_FRAME, FrameSocket
from can_dbc.bus.receive_clock import DRIFT_PPM, HardwareClock, ReceiveClock
from can_dbc.frame import ERROR, EXTENDED, EXTENDED_MASK, REMOTE, STANDARD_MASK, Frame
from can_dbc.messages.tick_record import BusReading, TickRecord, decode, encode

LIMIT = 1024
SO_TIMESTAMPNS, SO_TIMESTAMPING, SO_RXQ_OVFL = 35, 37, 40


class Pair:
    """A fast path and its far end."""

    def __init__(self) -> None:
        near, self.far = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
        self.link = FrameSocket(near)
        self.stats = BusStats()

    def put(self, key: int, data: bytes) -> None:
        self.far.send(CAN_FRAME.pack(key, len(data), data))

    def take(self, limit: int = LIMIT) -> list[Frame]:
        frames: list[Frame] = []
        self.link.receive(frames, limit, self.stats.note_error)
        return frames


@pytest.fixture
def pair() -> Iterator[Pair]:
    pair = Pair()
    yield pair
    pair.link.close()
    pair.far.close()


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """The number of datagrams of each system call."""
    counts: list[int] = []
    receive = Batch.receive

    def counting(batch: Batch, descriptor: int) -> int:
        counts.append(receive(batch, descriptor))
        return counts[-1]

    monkeypatch.setattr(Batch, "receive", counting)
    return counts


def test_a_drain_is_one_system_call(pair: Pair, calls: list[int]) -> None:
    for count in (0, 1, 9):
        for _ in range(count):
            pair.put(0x181, bytes(8))
        calls.clear()
        assert len(pair.take()) == count and calls == [count]


def test_more_than_a_batch_arrives_in_several_calls(pair: Pair, calls: list[int]) -> None:
    pair.link._batch = Batch(CAN_FRAME.size, pair.link._batch.ancillary, count=4)
    for key in range(9):
        pair.put(key, b"")
    assert [frame.key for frame in pair.take()] == list(range(9)) and calls == [4, 4, 1]
    for key in range(9):
        pair.put(key, b"")
    assert [frame.key for frame in pair.take(limit=8)] == list(range(8))
    assert [frame.key for frame in pair.take()] == [8]


def test_error_frames_are_not_returned_and_a_recovery_removes_older_frames(pair: Pair) -> None:
    pair.put(0x100, b"")
    pair.put(ERROR | ERR_BUSOFF, bytes(8))
    assert [frame.key for frame in pair.take()] == [0x100]
    pair.put(0x101, b"")
    pair.put(ERROR | ERR_RESTARTED, bytes(8))
    pair.put(0x102, b"")
    kept = [Frame(1, 0x99, b"")]
    pair.link.receive(kept, LIMIT, pair.stats.note_error)
    assert [frame.key for frame in kept] == [0x99, 0x102]
    assert (pair.stats.error_frames, pair.stats.recoveries) == (2, 1)


def test_a_closed_far_end_is_an_error(pair: Pair) -> None:
    pair.link.close()
    with pytest.raises(OSError, check=lambda error: error.errno == errno.EBADF):
        pair.take()


def test_frames_are_sent_up_to_the_first_that_finds_no_room(pair: Pair) -> None:
    """An unread socket holds a few frames and then fails with EAGAIN, as a full queue with ENOBUFS."""
    pair.link.sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 1)
    pair.far.setblocking(False)
    wanted = [(i, bytes([i])) for i in range(200)]
    taken = pair.link.send(wanted)
    assert 0 < taken < 200
    with pytest.raises(BlockingIOError):
        pair.link.send(wanted[taken:])
    got = [CAN_FRAME.unpack(pair.far.recv(100)) for _ in range(taken)]
    assert [(key, data[:length]) for key, length, data in got] == wanted[:taken]
    with pytest.raises(BlockingIOError):
        pair.far.recv(100)


def control_data(stamp_ns: int, hardware_ns: int | None = None, dropped: int | None = None) -> bytes:
    """What the kernel writes beside a frame (struct cmsghdr: length, level, kind)."""
    second = 1_000_000_000
    text = struct.pack("@Niiqq", 32, 1, SO_TIMESTAMPNS, *divmod(stamp_ns, second))
    if hardware_ns is not None:
        text += struct.pack("@Niiqqqqqq", 64, 1, SO_TIMESTAMPING, 0, 0, 0, 0, *divmod(hardware_ns, second))
    if dropped is not None:
        text += struct.pack("@NiiI4x", 20, 1, SO_RXQ_OVFL, dropped)
    return text


def deliver(pair: Pair, monkeypatch: pytest.MonkeyPatch, controls: list[bytes]) -> list[Frame]:
    """A drain that finds frames with this control data."""

    def receive(batch: Batch, _: int) -> int:
        batch.control[:] = bytes(len(batch.control))
        for i, text in enumerate(controls):
            batch.control[i * batch.ancillary : i * batch.ancillary + len(text)] = text
            CAN_FRAME.pack_into(batch.data, i * batch.size, i, 0, b"")
        return len(controls)

    monkeypatch.setattr(Batch, "receive", receive)
    return pair.take()


@pytest.mark.parametrize("wall_ns", [0, 1, 2**62, -(2**62)])
def test_a_senseless_stamp_makes_a_frame_as_old_as_it_can_be_and_never_negative(
    pair: Pair, monkeypatch: pytest.MonkeyPatch, wall_ns: int
) -> None:
    opened_ns = pair.link._clock.since_ns
    (frame,) = deliver(pair, monkeypatch, [control_data(wall_ns)])
    assert frame.stamp_ns == opened_ns
    record = TickRecord(1, 0, 0, 0, BusReading(), BusReading(), [frame], [], [], [], [], b"")
    assert list(decode(encode(record)).frames_in) == [frame]


@given(
    st.lists(st.tuples(st.integers(0, 20_000_000), st.integers(0, 6), st.integers(-(10**15), 10**15)), max_size=40),
    st.integers(0, 10**15),
)
def test_a_receive_time_lies_between_the_last_empty_queue_and_now(
    drains: list[tuple[int, int, int]], epoch_ns: int
) -> None:
    """Whatever the wall clock does; and where it does nothing, the time is the true one."""
    now_ns = 10**9
    clock, wall_offset_ns, drained_ns = ReceiveClock(now_ns), epoch_ns, [now_ns, now_ns]
    for gap_ns, frames, step_ns in drains:
        stamps = [(now_ns + gap_ns * k // 7, wall_offset_ns) for k in range(frames)]
        wall_offset_ns += step_ns
        now_ns += gap_ns
        clock.begin(now_ns, now_ns + wall_offset_ns)
        for true_ns, offset_ns in stamps:
            wall_ns = true_ns + offset_ns
            stamp_ns = wall_ns + clock.offset_ns
            if not clock.since_ns <= stamp_ns <= clock.now_ns:
                stamp_ns = clock.doubtful_ns(wall_ns)
            assert drained_ns[-2] <= stamp_ns <= now_ns
            assert step_ns or stamp_ns == true_ns
        clock.emptied()
        drained_ns.append(now_ns)


@given(
    st.lists(st.tuples(st.integers(0, 50_000_000), st.integers(0, 5_000_000)), min_size=1, max_size=200),
    st.integers(-DRIFT_PPM // 2, DRIFT_PPM // 2),
    st.integers(-(10**18), 10**18),
)
@example([(0, 0), (1, 0)], -1, 0)
@example([(4_999, 0)] * 200, -DRIFT_PPM // 2, 0)
def test_hardware_stamps_are_never_early_and_never_later_than_the_interrupt(
    frames: list[tuple[int, int]], drift_ppm: int, epoch_ns: int
) -> None:
    """Whatever the latencies: a stamp lies between the true time and the interrupt, and the order stays.

    The adapter counts whole nanoseconds, so the true time is known to it to one.
    """
    clock, true_ns, last_ns = HardwareClock(), 10**18, 0
    least_ns = frames[0][1]
    for gap_ns, latency_ns in frames:
        true_ns += gap_ns
        hardware_ns = epoch_ns + 2 * 10**18 + true_ns + true_ns % 10**15 * drift_ppm // 1_000_000
        software_ns = max(true_ns + latency_ns, last_ns)
        least_ns = min(least_ns + gap_ns * 2 * DRIFT_PPM // 1_000_000 + 2, software_ns - true_ns)
        stamp_ns = clock.stamp_ns(hardware_ns, software_ns)
        assert true_ns - 1 <= stamp_ns <= software_ns
        assert stamp_ns >= last_ns
        assert stamp_ns - true_ns <= least_ns or stamp_ns == last_ns
        last_ns = stamp_ns


@pytest.mark.parametrize("jump_ns", [-(10**12), -(10**9), 10**9, 10**12])
def test_a_restarted_clock_of_an_adapter_is_followed(jump_ns: int) -> None:
    clock = HardwareClock()
    for i in range(3):
        clock.stamp_ns(10**13 + i * 10**6, 10**18 + i * 10**6)
    for i in range(3, 6):
        assert clock.stamp_ns(10**13 + jump_ns + i * 10**6, 10**18 + i * 10**6) == 10**18 + i * 10**6


KEYS = st.builds(
    lambda i, kind: i | kind, st.integers(0, EXTENDED_MASK), st.sampled_from([EXTENDED, EXTENDED | REMOTE])
)
SHORT = st.builds(lambda i, kind: i | kind, st.integers(0, STANDARD_MASK), st.sampled_from([0, REMOTE]))


@given(st.lists(st.one_of(SHORT, KEYS, st.tuples(KEYS, st.integers(0, EXTENDED_MASK)))), st.one_of(SHORT, KEYS))
def test_a_filter_matches_like_the_kernel(wanted: list[int | tuple[int, int]], key: int) -> None:
    """A frame passes when ``received & mask == filter & mask`` for one pair (linux/can/raw.h); kinds always count."""
    wanted_one = Filter(wanted)
    assert (key in wanted_one) == any(key & mask == pair_key & mask for pair_key, mask in wanted_one.pairs)
    by_hand = False
    for item in wanted:
        other, mask = item if isinstance(item, tuple) else (item, EXTENDED_MASK)
        by_hand |= not (key ^ other) & (mask | EXTENDED | REMOTE)
    assert (key in wanted_one) == by_hand
    assert set(Filter(wanted_one.pairs).pairs) == set(wanted_one.pairs)  # as it travels to the wire


def test_an_invalid_filter_is_refused() -> None:
    for wrong in (["x"], [(1, 2, 3)], [None]):
        with pytest.raises((TypeError, ValueError)):
            Filter(wrong)  # type: ignore[arg-type]


# -- many datagrams in one system call, with the same result as one call each

Sockets = tuple[socket.socket, socket.socket]


@pytest.fixture
def sockets() -> Iterator[Sockets]:
    sender, receiver = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
    with sender, receiver:
        yield sender, receiver


def taken(batch: Batch, count: int) -> list[bytes]:
    lengths = list(batch.lengths())
    assert len(lengths) == count
    return [bytes(batch.data[i * batch.size : i * batch.size + length]) for i, length in enumerate(lengths)]


def test_receives_all_waiting_datagrams_in_order_and_never_blocks(sockets: Sockets) -> None:
    sender, receiver = sockets
    batch = Batch(size=16, count=4)
    assert batch.receive(receiver.fileno()) == 0
    wanted = [bytes([i]) * (i + 1) for i in range(6)]
    for data in wanted:
        sender.send(data)
    assert batch.receive(receiver.fileno()) == 4
    first = taken(batch, 4)
    assert batch.receive(receiver.fileno()) == 2
    assert first + taken(batch, 2) == wanted
    assert batch.receive(receiver.fileno()) == 0


def test_a_longer_datagram_is_truncated_and_the_next_is_complete(sockets: Sockets) -> None:
    sender, receiver = sockets
    batch = Batch(size=8)
    sender.send(b"0123456789")
    sender.send(b"abc")
    assert batch.receive(receiver.fileno()) == 2
    assert taken(batch, 2) == [b"01234567", b"abc"]


def test_control_data_is_received_and_its_size_reset_each_time(sockets: Sockets) -> None:
    sender, receiver = sockets
    receiver.setsockopt(socket.SOL_SOCKET, 16, 1)  # SO_PASSCRED: every datagram carries its sender
    batch = Batch(size=8, ancillary=socket.CMSG_SPACE(12))
    for _ in range(3):
        sender.send(b"x")
        assert batch.receive(receiver.fileno()) == 1
        assert int.from_bytes(batch.control[16:20], "little") == os.getpid()
    receiver.setsockopt(socket.SOL_SOCKET, 16, 0)
    sender.send(b"x")
    assert batch.receive(receiver.fileno()) == 1
    assert not any(batch.control)  # nothing is left of a former datagram's


def test_an_enlarged_buffer_holds_more() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        enlarge_receive_buffer(sock, 64 * 1024)
        assert sock.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF) >= 64 * 1024
