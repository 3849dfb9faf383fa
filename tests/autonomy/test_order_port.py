"""The planning process with its order port and its watchers, and a job of ours in it."""

from __future__ import annotations

import json
import socket
import time
from collections.abc import Iterator
from typing import Any

import pytest

from autonomy.__main__ import Process, arguments
from can_dbc.mission_datagrams import MissionOrder, MissionReport, Order, decode_mission, encode_order
from tests.can_dbc.mission_told import TOLD

HASH, KEY = 77, b"key"


class Jobless:
    """Refuses an order to pause and does all others."""

    idle = done = False
    failure = None

    def __init__(self) -> None:
        self.ordered: list[Order] = []

    def step(self, *_: object) -> list[bytes]:
        return []

    def news(self) -> Iterator[Any]:
        return iter(())

    def obey(self, order: MissionOrder) -> str:
        self.ordered.append(order.order)
        return "not now" if order.order is Order.PAUSE else ""

    def report(self, now_ns: int) -> MissionReport:
        return TOLD


@pytest.fixture
def watcher() -> Iterator[socket.socket]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as s:
        s.bind(("127.0.0.1", 0))
        s.settimeout(5)
        yield s


@pytest.fixture
def process(watcher) -> Iterator[tuple[Process, Jobless]]:
    there = "127.0.0.1:9"
    told = f"127.0.0.1:{watcher.getsockname()[1]}"
    options = arguments(["--controller", there, "--scene", there, "--report-port", "0", "--order-port", "0",
                         "--tell", told, "--tell", there])  # fmt: skip
    job = Jobless()
    made = Process(job, HASH, options, KEY)  # type: ignore[arg-type]
    yield made, job
    made.close()


def give(process: Process, order: Order, key: bytes | None = KEY, late_ns: int = 0) -> None:
    now_ns = time.monotonic_ns()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
        out.sendto(encode_order(MissionOrder(1, HASH, now_ns - late_ns, order), key), process._ordered.getsockname())
    process.turn(time.monotonic_ns())


def said(capsys) -> list[dict[str, Any]]:
    return [m for m in map(json.loads, capsys.readouterr().out.splitlines()) if m["event"] == "order"]


def test_an_order_is_done_and_said(process, capsys) -> None:
    give(process[0], Order.ABORT)
    give(process[0], Order.PAUSE)
    assert process[1].ordered == [Order.ABORT, Order.PAUSE]
    assert [(m.get("order"), m.get("refused")) for m in said(capsys)] == [("ABORT", None), ("PAUSE", "not now")]


def test_an_old_order_and_an_unsigned_one_are_not_done(process, capsys) -> None:
    give(process[0], Order.ABORT, late_ns=2_000_000_000)
    give(process[0], Order.ABORT, key=None)
    assert process[1].ordered == []
    first, second = said(capsys)
    assert "order" not in first and "2.0 s old" in first["refused"] and "refused" in second["refused"]


def test_it_is_told_twice_a_second_and_at_once_after_an_order(process, watcher) -> None:
    begin_ns = time.monotonic_ns()
    for k in range(100):  # two seconds
        process[0].turn(begin_ns + k * 20_000_000)
    watcher.setblocking(False)
    reports = []
    while True:
        try:
            reports.append(decode_mission(watcher.recv(65536), KEY))
        except BlockingIOError:
            break
    assert [report for *_, report in reports] == [TOLD] * 4 and reports[0][:2] == (HASH, begin_ns)
    give(process[0], Order.AUTO)
    assert watcher.recv(65536)


def test_orders_come_from_this_machine_only(process) -> None:
    assert process[0]._ordered.getsockname()[0] == "127.0.0.1"
