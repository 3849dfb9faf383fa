"""Many datagrams in one system call, with the same result as one call each."""

from __future__ import annotations

import errno
import os
import socket
from collections.abc import Iterator

import pytest

from can_dbc.bus.batch import Batch, enlarge_receive_buffer

Pair = tuple[socket.socket, socket.socket]


@pytest.fixture
def pair() -> Iterator[Pair]:
    sender, receiver = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
    with sender, receiver:
        yield sender, receiver


def taken(batch: Batch, count: int) -> list[bytes]:
    lengths = list(batch.lengths())
    assert len(lengths) == count
    return [bytes(batch.data[i * batch.size : i * batch.size + length]) for i, length in enumerate(lengths)]


def test_receives_all_waiting_datagrams_in_order_and_never_blocks(pair: Pair) -> None:
    sender, receiver = pair
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


def test_a_longer_datagram_is_truncated_and_the_next_is_complete(pair: Pair) -> None:
    sender, receiver = pair
    batch = Batch(size=8)
    sender.send(b"0123456789")
    sender.send(b"abc")
    assert batch.receive(receiver.fileno()) == 2
    assert taken(batch, 2) == [b"01234567", b"abc"]


def test_control_data_is_received_and_its_size_reset_each_time(pair: Pair) -> None:
    sender, receiver = pair
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


def test_a_closed_socket_is_an_error(pair: Pair) -> None:
    _, receiver = pair
    number = receiver.fileno()
    receiver.close()
    with pytest.raises(OSError, check=lambda error: error.errno == errno.EBADF):
        Batch(size=8).receive(number)


def test_an_enlarged_buffer_holds_more() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        enlarge_receive_buffer(sock, 64 * 1024)
        assert sock.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF) >= 64 * 1024
