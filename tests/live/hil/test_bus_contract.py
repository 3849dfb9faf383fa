"""The contract of every bus backend.

TIMBERHAND_TEST_CAN names the SocketCAN interface (default vcan0).
"""

from __future__ import annotations

import time

from can_dbc.bus.base import BusState
from can_dbc.frame import EXTENDED, REMOTE, Frame
from tests.live.hil.bus_backends import Backend


def test_frames_arrive_in_order_with_payload_and_stamp(backend: Backend) -> None:
    a, b = backend.open(), backend.open()
    before_ns = time.monotonic_ns()
    sent = [(0x100 + i, bytes(range(i % 9))) for i in range(40)]
    for key, data in sent:
        backend.send(a, key, data)
    frames = backend.receive(b, len(sent))
    assert [(frame.key, frame.data) for frame in frames] == sent
    stamps = [frame.stamp_ns for frame in frames]
    assert stamps == sorted(stamps)
    if backend.core is None:
        assert before_ns - 1_000_000 <= stamps[0] and stamps[-1] <= time.monotonic_ns()
    assert a.stats.sent == b.stats.received == len(sent)
    assert a.stats.state is b.stats.state is BusState.ACTIVE


def test_extended_standard_and_remote_frames_are_distinguished(backend: Backend) -> None:
    a, b = backend.open(), backend.open()
    sent = [
        (0x123, b"s"),
        (0x123 | EXTENDED, b"x"),
        (0x1FFF_FFFF | EXTENDED, b""),
        (0x123 | REMOTE, bytes(3)),
    ]
    for key, data in sent:
        backend.send(a, key, data)
    assert [(frame.key, frame.data) for frame in backend.receive(b, 4)] == sent


def test_own_frames_do_not_come_back(backend: Backend) -> None:
    a, b = backend.open(), backend.open()
    backend.send(a, 0x100, b"own")
    backend.receive(b, 1)
    backend.send(b, 0x200, b"other")
    assert [frame.key for frame in backend.receive(a, 1)] == [0x200]


def test_own_frames_come_back_on_request(backend: Backend) -> None:
    a = backend.open(receive_own=True)
    backend.open()
    backend.send(a, 0x100, b"own")
    assert [(frame.key, frame.data) for frame in backend.receive(a, 1)] == [(0x100, b"own")]


def test_filters_accept_exact_keys(backend: Backend) -> None:
    a, b = backend.open(), backend.open(filters=[0x100, 0x200 | EXTENDED])
    for key in (0x101, 0x100 | EXTENDED, 0x100 | REMOTE, 0x200, 0x200 | EXTENDED, 0x100):
        backend.send(a, key, b"")
    assert [frame.key for frame in backend.receive(b, 2)] == [0x200 | EXTENDED, 0x100]


def test_filters_accept_pairs_of_key_and_mask(backend: Backend) -> None:
    """A message matched by PGN, from any sender and with any priority; the kind of a frame always counts."""
    a, b = backend.open(), backend.open(filters=[(0x18FF2000 | EXTENDED, 0x03FF_FF00), 0x100])
    wanted = [0x0CFF_2030 | EXTENDED, 0x18FF_20AA | EXTENDED, 0x100]
    others = [0x0CFF_2130 | EXTENDED, 0x0CFF_2030 | EXTENDED | REMOTE, 0x700, 0x000, 0x101, 0x100 | EXTENDED]
    for key in [*others, *wanted]:
        backend.send(a, key, b"")
    assert [frame.key for frame in backend.receive(b, len(wanted))] == wanted


def test_forty_masks_are_as_good_as_one(backend: Backend) -> None:
    a, b = backend.open(), backend.open(filters=[(i << 8 | EXTENDED, 0x03FF_FF00) for i in range(40)])
    for i in (41, 40, 39, 0):
        backend.send(a, i << 8 | 0x55 | EXTENDED, b"")
    assert [frame.key for frame in backend.receive(b, 2)] == [39 << 8 | 0x55 | EXTENDED, 0x55 | EXTENDED]


def test_an_own_identifier_from_another_node_is_received(backend: Backend) -> None:
    """Own frames do not come back, so one with an own identifier is foreign: a fault that the loop must detect."""
    a, b = backend.open(filters=[0x210]), backend.open()
    backend.send(a, 0x210, b"mine")
    backend.receive(b, 1)
    backend.send(b, 0x210, b"not mine")
    assert [(frame.key, frame.data) for frame in backend.receive(a, 1)] == [(0x210, b"not mine")]


def test_the_frames_of_a_tick_go_together_in_order(backend: Backend) -> None:
    a, b = backend.open(), backend.open()
    frames = [(0x300, b"first"), (0x200, b""), (0x400 | EXTENDED, bytes(8)), (0x100, b"last")]
    assert a.send_all(frames) == 4
    assert [(frame.key, frame.data) for frame in backend.receive(b, 4)] == frames
    assert a.send_all([]) == 0
    assert (a.stats.sent, a.stats.refused) == (4, 0)


def test_frames_after_one_that_was_not_accepted_are_refused(backend: Backend) -> None:
    a, b = backend.open(), backend.open()
    assert a.send_all([(0x100, b""), (0x101, bytes(9)), (0x102, b"")]) == 1
    assert (a.stats.sent, a.stats.refused) == (1, 2)
    backend.send(a, 0x103, b"")
    assert [frame.key for frame in backend.receive(b, 2)] == [0x100, 0x103]


def test_a_flush_discards_waiting_frames(backend: Backend) -> None:
    a, b, c = backend.open(), backend.open(), backend.open()
    for i in range(5):
        backend.send(a, 0x100 + i, b"old")
    backend.receive(c, 5)
    b.flush()
    backend.send(a, 0x200, b"new")
    assert [(frame.key, frame.data) for frame in backend.receive(b, 1)] == [(0x200, b"new")]
    assert b.stats.received == 1 and b.stats.state is BusState.ACTIVE


def test_a_working_bus_is_not_reopened(backend: Backend) -> None:
    a, b, c = backend.open(), backend.open(), backend.open()
    backend.send(a, 0x100, b"")
    backend.receive(c, 1)
    assert b.reopen() and a.reopen()
    assert [frame.key for frame in backend.receive(b, 1)] == [0x100]
    assert a.stats.recoveries == b.stats.recoveries == 0


def test_an_empty_filter_receives_nothing(backend: Backend) -> None:
    a, b, c = backend.open(), backend.open(filters=[]), backend.open()
    backend.send(a, 0x100, b"")
    backend.receive(c, 1)
    assert b.drain([]) == 0


def test_a_silent_bus_drains_at_once(backend: Backend) -> None:
    bus = backend.open()
    frames: list[Frame] = []
    assert bus.drain(frames) == 0 and frames == []
    assert bus.stats.received == 0


def test_more_than_eight_bytes_are_refused(backend: Backend) -> None:
    a, b = backend.open(), backend.open()
    assert not a.send(0x100, bytes(9))
    assert a.stats.refused == 1
    backend.send(a, 0x101, b"")
    assert [frame.key for frame in backend.receive(b, 1)] == [0x101]


def test_frames_sent_just_before_closing_still_arrive(backend: Backend) -> None:
    b = backend.open()
    with backend.open() as a:
        for i in range(5):
            backend.send(a, 0x100 + i, b"bye")
    assert [frame.key for frame in backend.receive(b, 5)] == [0x100 + i for i in range(5)]


def test_a_closed_bus_refuses(backend: Backend) -> None:
    with backend.open() as bus:
        pass
    bus.close()
    assert bus.stats.state is BusState.DOWN
    assert not bus.send(0x100, b"")
    assert bus.drain([]) == 0
    bus.flush()
    assert not bus.reopen()
    assert bus.stats.state is BusState.DOWN and bus.stats.recoveries == 0
