"""The bridge process: ``python -m controller.plc --profile P --bus crane0=wire:crane0 --modbus 127.0.0.1:1502``.

Emulates the machine's nodes on crane0 from the answers of a PLC on Ethernet, or of a machine of one's own
(``--machine``, `can_dbc.plc.machine`), and passes the supervised commands on.
One asyncio loop, one thread.  Prints ``ready`` on stdout when it is on the bus, and one JSON line on stderr at its
end.  It connects to loopback addresses only unless ``--allow-network`` is given; datagrams on a network need a key, or
``--no-key``, and Modbus has none.  Exit codes: 0 ended by SIGTERM, 2 usage, 3 configuration, 4 no bus or address at the
start, 130 SIGINT.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import json
import secrets
import signal
import socket
import sys
import time
from dataclasses import asdict
from pathlib import Path
from typing import Final

import msgspec

from can_dbc.bus.base import Bus
from can_dbc.bus.factory import default_address, open_bus
from can_dbc.dbc.codec import load
from can_dbc.frame import Frame
from can_dbc.messages.envelope import read_key
from can_dbc.messages.udp_address import address_argument
from can_dbc.plc.machine import MACHINES, Machine
from can_dbc.plc.map import MapError, WordOrder, check_identity
from can_dbc.plc.modbus import ModbusClient, RegisterRefused, is_loopback
from controller.config import load as load_settings
from controller.plc.bridge import EXCHANGE_NS, Bridge
from controller.plc.handshake import Handshake
from controller.process.bus_link import BusLink
from controller.process.realtime import prepare, stop_garbage_collection
from runtime.errors import ConfigError, LinkError
from runtime.memory import keep_memory
from runtime.notifier import Notifier
from runtime.plugins import load_plugin

# -- The links to the PLC or to a machine of one's own, each a coroutine beside the bridge: an exchange every 10 ms.
#
# A connection that fails is closed at once and tried again after a pause that grows to a second.  The bridge
# detects the loss by the age of the last answer, not by the connection.

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
        """Wait until the next period begins."""
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


STEP_S: Final = 0.005
PRIORITY: Final = 70
TX_QUEUE: Final = 64
"""Frames; this process emulates a dozen nodes."""


def parser() -> argparse.ArgumentParser:
    """Build the parser of the command line."""
    made = argparse.ArgumentParser(
        prog="python -m controller.plc",
        description="Connects crane0 to a machine PLC over Modbus/TCP or cyclic UDP.",
        epilog="example: python -m controller.plc --profile palms_plc.toml --bus crane0=socketcan:vcan0 "
        "--modbus 192.168.7.2:502 --allow-network",
    )
    made.add_argument("--profile", required=True, help="shipped profile name or TOML file with a [plc] table")
    made.add_argument("--bus", default="", metavar="crane0=ADDRESS", help="address of the crane bus")
    made.add_argument("--rate", type=int, default=0, metavar="HZ", help="the controller's, if not the profile's")
    link = made.add_mutually_exclusive_group(required=True)
    link.add_argument("--modbus", type=address_argument, metavar="HOST:PORT", help="the PLC's Modbus/TCP server")
    link.add_argument("--udp", type=address_argument, metavar="HOST:PORT", help="the PLC's port for cyclic datagrams")
    link.add_argument("--machine", metavar="NAME", help="a machine of another package, by its entry point")
    made.add_argument("--word-order", choices=("high", "low"), default="high", help="which half of 32 bits comes first")
    made.add_argument("--allow-network", action="store_true", help="the PLC may be on another host")
    made.add_argument("--key-file", type=Path, help="file with the key that authenticates the datagrams")
    made.add_argument("--no-key", action="store_true", help="send datagrams to another host without a key")
    made.add_argument("--no-realtime", action="store_true", help="do not request FIFO scheduling and locked memory")
    return made


class Process:
    """Bus and bridge in one loop; the link to the PLC is a task beside it."""

    def __init__(self, bridge: Bridge, bus: Bus) -> None:
        self._bridge, self._bus = bridge, bus
        self._link = BusLink(bus)
        self._notifier = Notifier(self.status_text)
        self._frames: list[Frame] = []

    def step(self) -> None:
        """Receive all waiting frames and send what is due."""
        frames = self._frames
        frames.clear()
        self._bus.drain(frames)
        self._link.send(self._bridge.step(time.monotonic_ns(), frames))

    def status_text(self) -> str:
        """Describe the state in one line."""
        shake, bus = self._bridge.handshake, self._bus
        answers = shake.problem or f"The PLC has answered {shake.answers} times."
        refused = f" {shake.replayed} old datagrams were refused." if shake.replayed else ""
        return f"{answers}{refused} The bus is {bus.stats.state.name}."

    async def run(self, link: Link) -> None:
        """Run until cancelled."""
        loop = asyncio.get_running_loop()
        listening = -1
        exchanging = asyncio.create_task(link.run())
        try:
            due = loop.time()
            while not exchanging.done():
                descriptor = self._bus.fileno()
                if descriptor != listening:  # a reopened bus has a new one
                    if listening >= 0:
                        loop.remove_reader(listening)
                    if descriptor >= 0:
                        loop.add_reader(descriptor, self.step)
                    listening = descriptor
                self.step()
                now_ns = time.monotonic_ns()
                self._link.watch(now_ns)
                self._notifier.tick_done(now_ns, True)
                due = max(due + STEP_S, loop.time())
                await asyncio.sleep(due - loop.time())
            exchanging.result()
        finally:
            exchanging.cancel()
            link.close()
            self._notifier.stopping()


def summary(bridge: Bridge) -> str:
    """Return the statistics of the exchange as one JSON line."""
    shake = bridge.handshake
    return json.dumps(
        {
            "sent": shake.sent,
            "answers": shake.answers,
            "refused": shake.refused,
            "dropped": shake.dropped,
            "replayed": shake.replayed,
            "sessions": shake.sessions,
            "refused_here": bridge.gate.refused,
            "round_trip": shake.round_trip.summary(),
            "problem": shake.problem,
            "feedback": None if shake.feedback is None else asdict(shake.feedback),
        },
        default=bytes.hex,
    )


async def _until_ended(process: Process, link: Link, ended: list[int]) -> None:
    loop, task = asyncio.get_running_loop(), asyncio.create_task(process.run(link))

    def end(number: int) -> None:
        ended.append(number)
        task.cancel()

    for number in (signal.SIGTERM, signal.SIGINT):
        loop.add_signal_handler(number, end, number)
    sys.stdout.write("ready\n")
    sys.stdout.flush()
    try:
        await task
    except asyncio.CancelledError:
        if not ended:
            raise


def _check_network(parser: argparse.ArgumentParser, options: argparse.Namespace, host: str) -> None:
    """End with a usage error unless a PLC on another host is wanted; warn of what is not authenticated."""
    if not options.allow_network:
        parser.error(f"{host} is on the network; use a network of its own for the PLC and give --allow-network")
    if options.modbus:
        sys.stderr.write(f"plc: warning: Modbus has no authentication; whoever reaches {host} can command the PLC\n")
    elif options.no_key:
        sys.stderr.write(f"plc: warning: whoever reaches {host} can send datagrams to it; --key-file prevents that\n")
    elif options.key_file is None:
        parser.error(f"{host} is on the network; give --key-file FILE with the PLC's key, or --no-key")


def main(arguments: list[str] | None = None) -> int:
    """Run the bridge; returns the exit code."""
    made = parser()
    options = made.parse_args(arguments)
    name, _, where = options.bus.partition("=")
    if options.bus and (name != "crane0" or not where):
        made.error(f"--bus {options.bus}: write crane0=ADDRESS, as in crane0=socketcan:can0")
    host, port = options.modbus or options.udp or ("", 0)
    if not options.udp and options.key_file is not None:
        made.error("--key-file: only datagrams are authenticated; give --udp, or no key")
    if host and not is_loopback(host):
        _check_network(made, options, host)
    keep_memory()
    ended: list[int] = []
    try:
        order = WordOrder.HIGH_FIRST if options.word_order == "high" else WordOrder.LOW_FIRST
        key = None if options.key_file is None else read_key(options.key_file)
        shake = Handshake(order, key=key, first_sequence=secrets.randbits(31))
        settings = load_settings(options.profile, options.rate)
        profile = msgspec.structs.replace(settings.profile, rate_hz=settings.rate_hz)
        bridge = Bridge(profile, load("crane"), shake)
        machine = load_plugin(MACHINES, options.machine) if options.machine else None
        with open_bus(where or default_address("crane0"), tx_queue=TX_QUEUE, participant="plc") as bus:
            if not options.no_realtime:
                for refusal in prepare(PRIORITY):
                    sys.stderr.write(f"plc: not granted: {refusal}\n")
            link: Link
            if machine is not None:
                link = MachineLink(bridge, machine)
            else:
                link = ModbusLink(bridge, host, port) if options.modbus else UdpLink(bridge, host, port)
            stop_garbage_collection()
            asyncio.run(_until_ended(Process(bridge, bus), link, ended))
        sys.stderr.write(f"plc: {summary(bridge)}\n")
    except ConfigError as error:
        sys.stderr.write(f"plc: {error}\n")
        return 3
    except (LinkError, OSError) as error:
        sys.stderr.write(f"plc: {error}\n")
        return 4
    return 130 if signal.SIGINT in ended else 0


if __name__ == "__main__":
    sys.exit(main())
