"""An emulated PLC on real sockets for tests: server and program in a thread of their own, so that clients may block."""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import Coroutine
from typing import Any, Self

from can_dbc.plc.map import Command, Mode, Role, State, WordOrder, command_registers
from machine.loading.profile_file import load_profile
from sim.plc.__main__ import Datagrams, listen, serve
from sim.plc.program import MOTION_ALLOWED, Inputs, Program

HOME = (0.0, 0.75, -1.6, 0.3, 0.0)
MOVE = Command(Mode.VALVES, True, (0.5, 0, 0, 0, 0, 0, 0))
LOOPBACK = "127.0.0.1"


class ServedPlc:
    """``port`` is the Modbus port, ``udp_port`` the other; the program's time is the host's."""

    def __init__(self, order: WordOrder = WordOrder.HIGH_FIRST, key: bytes | None = None) -> None:
        self.inputs = Inputs(HOME, (10.0,) * 8, 0.5, 30.0, int(MOTION_ALLOWED))
        self.program = Program(load_profile("palms_471"), Role.VALVES, lambda _: self.inputs, order, key=key)
        self.loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self.loop.run_forever)

    def __enter__(self) -> Self:
        self._thread.start()
        self.server = self.run(serve(self.program, (LOOPBACK, 0), time.monotonic_ns))
        self.datagrams: Datagrams = self.run(listen(self.program, (LOOPBACK, 0), time.monotonic_ns))
        self.port, self.udp_port = self.server.port, self.datagrams.port
        self._scanning = asyncio.run_coroutine_threadsafe(self._scan(), self.loop)
        while self.program.state is State.INIT:
            time.sleep(0.005)
        return self

    def __exit__(self, *_: object) -> None:
        self._scanning.cancel()
        self.run(self._close())
        self.loop.call_soon_threadsafe(self.loop.stop)
        self._thread.join()
        self.loop.close()

    def run(self, work: Coroutine[Any, Any, Any]) -> Any:
        """A coroutine in the server's loop."""
        return asyncio.run_coroutine_threadsafe(work, self.loop).result(30.0)

    @property
    def connections(self) -> int:
        """How many connections are open now."""
        return len(self.server._connections)

    async def _scan(self) -> None:
        while True:
            self.program.scan(time.monotonic_ns())
            self.datagrams.cycle()
            await asyncio.sleep(0.002)

    async def _close(self) -> None:
        self.server.close()
        self.datagrams.close()
        for _ in range(5):
            await asyncio.sleep(0)


def block(sequence: int, command: Command = MOVE, order: WordOrder = WordOrder.HIGH_FIRST) -> list[int]:
    """A command block whose heartbeat is its number."""
    return command_registers(command, sequence, sequence & 0xFFFF, order)
