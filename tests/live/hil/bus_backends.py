"""Ways to open participants on a bus, for tests of what every bus promises."""

from __future__ import annotations

import os
import socket
import time
from collections.abc import Callable

import pytest

from can_dbc.bus.base import Bus
from can_dbc.bus.batch import Batch
from can_dbc.bus.factory import kernel_has_can, open_bus
from can_dbc.frame import Frame
from hil.wire.core import WireCore
from hil.wire.inprocess import InProcessBus

TIMEOUT_S = 5.0
BITRATE = 1_000_000
Open = Callable[..., Bus]


class Backend:
    """A way to open participants on one bus, and to let time pass."""

    def __init__(self, name: str, address: str = "", core: WireCore | None = None) -> None:
        self.name = name
        self.address = address
        self.core = core
        self.opened: list[Bus] = []

    def open(self, **options: object) -> Bus:
        bus: Bus
        if self.core is not None:
            bus = InProcessBus(self.core, f"p{len(self.opened)}", **options)  # type: ignore[arg-type]
        else:
            bus = open_bus(self.address, **options)  # type: ignore[arg-type]
        self.opened.append(bus)
        return bus

    def settle(self) -> None:
        if self.core is not None:
            self.core.advance(self.core.now_ns + 1_000_000)
        else:
            time.sleep(0.0005)

    def receive(self, bus: Bus, count: int) -> list[Frame]:
        """Drains until `count` frames are there; fails when they do not come."""
        frames: list[Frame] = []
        deadline = time.monotonic() + TIMEOUT_S
        while len(frames) < count:
            assert time.monotonic() < deadline, f"{len(frames)} of {count} frames arrived"
            self.settle()
            bus.drain(frames)
        return frames

    def send(self, bus: Bus, key: int, data: bytes) -> None:
        """Sends, waiting for room in the queue."""
        deadline = time.monotonic() + TIMEOUT_S
        while not bus.send(key, data):
            assert time.monotonic() < deadline, "no room in the transmit queue"
            self.settle()


def kernel_interface() -> str:
    interface = os.environ.get("TIMBERHAND_TEST_CAN", "vcan0")
    if not kernel_has_can():
        pytest.skip("no AF_CAN in this kernel")
    if interface not in {name for _, name in socket.if_nameindex()}:
        pytest.skip(f"no interface {interface}")
    return interface


def counted_receives(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    calls: list[int] = []
    receive = Batch.receive

    def counting(batch: Batch, descriptor: int) -> int:
        calls.append(descriptor)
        return receive(batch, descriptor)

    monkeypatch.setattr(Batch, "receive", counting)
    return calls
