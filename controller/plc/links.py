"""The links to the PLC or to a machine of one's own, each a coroutine beside the bridge: an exchange every 10 ms.

A connection that fails is closed at once and tried again after a pause that grows to a second.  The bridge detects the
loss by the age of the last answer, not by the connection.
"""

from __future__ import annotations

import asyncio
import contextlib
import socket
import time
from typing import Final

from can_dbc.plc.machine import Machine
from can_dbc.plc.map import MapError, check_identity
from can_dbc.plc.modbus import ModbusClient, RegisterRefused
from controller.plc.bridge import EXCHANGE_NS, Bridge
from runtime.errors import LinkError

TIMEOUT_S: Final = 0.1
"""A later answer does not count; the connection is closed, so that it cannot arrive at all."""
PAUSE_S, MAX_PAUSE_S = 0.05, 1.0
_PERIOD_S: Final = EXCHANGE_NS * 1e-9
_DATAGRAM_BYTES: Final = 2048
_MAX_DATAGRAMS: Final = 16


class ExchangeTimer:
    """Absolute deadlines; a late exchange skips periods and never catches up in a burst."""

    def __init__(self) -> None:
        self._due = asyncio.get_running_loop().time()

    async def wait(self) -> None:
        """Until the next period begins."""
        now = asyncio.get_running_loop().time()
        self._due = max(self._due + _PERIOD_S, now)
        await asyncio.sleep(self._due - now)


class ModbusLink:
    """Modbus/TCP: FC 23, 32 registers out and 48 in."""

    def __init__(self, bridge: Bridge, host: str, port: int) -> None:
        self._bridge, self._client = bridge, ModbusClient(host, port, TIMEOUT_S)

    async def run(self) -> None:
        """Run until cancelled."""
        pause = PAUSE_S
        while True:
            try:
                await self._client.connect()
                check_identity(await self._client.status(), self._bridge.handshake.order)
                self._bridge.handshake.connected()
                pause = PAUSE_S
                await self._exchange_cyclic()
            except LinkError as error:
                self._bridge.handshake.exchange_failed(str(error))
            except (MapError, RegisterRefused) as error:
                self._bridge.handshake.exchange_failed(str(error))
                self._client.close()
            await asyncio.sleep(pause)
            pause = min(2.0 * pause, MAX_PAUSE_S)

    async def _exchange_cyclic(self) -> None:
        """Exchange until the connection fails (LinkError).  A refused command is counted, and the next one is sent."""
        shake, timer = self._bridge.handshake, ExchangeTimer()
        while True:
            now_ns = time.monotonic_ns()
            block = shake.registers(self._bridge.command(now_ns), now_ns)
            try:
                answer = await self._client.exchange(block)
            except RegisterRefused as refused:
                shake.command_refused(refused.code)
                answer = await self._client.status()
            shake.accept_registers(answer, time.monotonic_ns())
            await timer.wait()

    def close(self) -> None:
        """Close the connection."""
        self._client.close()


class MachineLink:
    """A machine in this process (`can_dbc.plc.machine`)."""

    def __init__(self, bridge: Bridge, machine: Machine) -> None:
        self._bridge, self._machine = bridge, machine

    async def run(self) -> None:
        """Run until cancelled; an error of the machine that is no OSError ends the bridge."""
        shake, pause = self._bridge.handshake, PAUSE_S
        while True:
            try:
                self._machine.connect()
                shake.connected()
                pause, timer = PAUSE_S, ExchangeTimer()
                while True:
                    now_ns = time.monotonic_ns()
                    shake.exchange(self._machine, self._bridge.command(now_ns), now_ns)
                    await timer.wait()
            except OSError as error:
                shake.exchange_failed(f"The machine cannot be reached: {error}")
                self.close()
            await asyncio.sleep(pause)
            pause = min(2.0 * pause, MAX_PAUSE_S)

    def close(self) -> None:
        """Disconnect."""
        self._machine.disconnect()


class UdpLink:
    """Cyclic datagrams, 100 Hz each way, from a socket that is bound to this PLC's address."""

    def __init__(self, bridge: Bridge, host: str, port: int) -> None:
        self._bridge = bridge
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        self._socket.connect((host, port))

    async def run(self) -> None:
        """Run until cancelled."""
        loop, shake, timer = asyncio.get_running_loop(), self._bridge.handshake, ExchangeTimer()
        loop.add_reader(self._socket.fileno(), self._receive)
        while True:
            now_ns = time.monotonic_ns()
            data = shake.datagram(self._bridge.command(now_ns), now_ns)
            try:
                self._socket.send(data)
            except OSError as error:  # no receiver, or the interface is gone; the answers grow old
                shake.exchange_failed(f"The PLC cannot be reached: {error.strerror}")
            await timer.wait()

    def _receive(self) -> None:
        for _ in range(_MAX_DATAGRAMS):
            try:
                data = self._socket.recv(_DATAGRAM_BYTES)
            except OSError:  # nothing waits, or an earlier datagram met a closed port
                return
            self._bridge.handshake.accept_datagram(data, time.monotonic_ns())

    def close(self) -> None:
        """Close the socket."""
        with contextlib.suppress(RuntimeError):
            asyncio.get_running_loop().remove_reader(self._socket.fileno())
        self._socket.close()


Link = ModbusLink | UdpLink | MachineLink
