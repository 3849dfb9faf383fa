"""The live plant behind a PLC: ``python -m sim.plc --profile P --modbus 127.0.0.1:1502 --udp 127.0.0.1:1503``.

Like ``python -m sim``, but without CAN: the emulated PLC reads the sensors and drives the valves; clients command it
over Modbus/TCP or cyclic UDP, in the role that the profile's [plc] defines.  ``--port`` answers the same JSON requests,
and ``--camera`` serves camera pictures, which have a network of their own on such a machine.
It prints ``ready`` with the ports in use on stdout.  Loopback only unless ``--allow-network`` is given; datagrams from
a network need a key, or ``--no-key``, and Modbus has none.  Exit codes: 0 stopped, 2 usage, 3 profile or truth, 4 an
address that cannot be used.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import gc
import signal
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import cast

import msgspec

from can_dbc.messages.envelope import read_key
from can_dbc.messages.udp_address import address_argument, udp_address
from can_dbc.plc import map as plc
from can_dbc.plc.datagram import Header, encode_reply
from can_dbc.plc.map import Feedback, Role, WordOrder
from can_dbc.plc.modbus import ModbusServer, RegisterRefused, is_loopback
from machine.loading.profile_file import load_profile
from runtime.errors import LinkError
from sim.errors import PlantError
from sim.plc.plant import PlcPlant
from sim.plc.program import Program
from sim.process.live_plant import LivePlant

# -- The emulated PLC on its two ports: Modbus/TCP registers and the cyclic datagram.  Decides nothing.
#
# Both run in the asyncio loop of the process; clients are told apart by connection, and by address for datagrams.

Address = tuple[str, int]


class PlcRegisters:
    """The registers of a PLC for a Modbus server; ``clock_ns`` is the PLC's time."""

    def __init__(self, program: Program, clock_ns: Callable[[], int] = time.monotonic_ns) -> None:
        self._program, self._clock_ns = program, clock_ns

    def read(self, address: int, count: int) -> list[int]:
        """Read a part of the status or of the command block; both read alike as holding and as input registers."""
        for begin, length in ((plc.STATUS_AT, plc.STATUS_COUNT), (plc.COMMAND_AT, plc.COMMAND_COUNT)):
            if begin <= address and address + count <= begin + length:
                block = self._program.status() if begin == plc.STATUS_AT else self._program.arbiter.command_block()
                return block[address - begin : address - begin + count]
        raise RegisterRefused(RegisterRefused.ADDRESS)

    def write(self, client: int, address: int, values: Sequence[int]) -> None:
        """Pass on a write by this connection."""
        self._program.arbiter.write(client, address, values, self._clock_ns())

    def commands(self, client: int) -> bool:
        """Tell whether this connection commands."""
        return self._program.arbiter.commander(self._clock_ns()) == client

    def closed(self, client: int) -> None:
        """Report that the connection has ended; the commander may return on a new one."""
        self._program.arbiter.disconnected(client)


class Datagrams(asyncio.DatagramProtocol):
    """The UDP side: commands in, an answer at once to every hello, and one reply per PLC cycle in an open session."""

    def __init__(self, program: Program, clock_ns: Callable[[], int] = time.monotonic_ns) -> None:
        self._program, self._clock_ns = program, clock_ns
        self._transport: asyncio.DatagramTransport | None = None
        self._beat = 0
        self.port = 0

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = cast(asyncio.DatagramTransport, transport)
        self.port = transport.get_extra_info("sockname")[1]

    def datagram_received(self, data: bytes, addr: Address) -> None:
        offer = self._program.arbiter.datagram(addr, data, self._clock_ns())
        if offer is not None:
            self._reply(offer, self._program.feedback, addr)

    def cycle(self) -> None:
        """Send the reply of a PLC cycle that has not been sent yet."""
        feedback, session = self._program.feedback, self._program.arbiter.session
        if not session.number or feedback.heartbeat == self._beat:
            return
        self._beat = feedback.heartbeat
        self._reply(session.reply_header(self._clock_ns()), feedback, cast(Address, session.client))

    def _reply(self, header: Header, feedback: Feedback, to: Address) -> None:
        if self._transport is not None:
            with contextlib.suppress(OSError):
                self._transport.sendto(encode_reply(header, feedback, self._program.arbiter.key), to)

    def close(self) -> None:
        if self._transport is not None:
            self._transport.close()


async def listen(program: Program, address: Address, clock_ns: Callable[[], int]) -> Datagrams:
    """Open the UDP side on an address.

    Raises:
        LinkError: the address cannot be used.
    """
    protocol = Datagrams(program, clock_ns)
    try:
        await asyncio.get_running_loop().create_datagram_endpoint(lambda: protocol, local_addr=address)
    except OSError as error:
        raise LinkError("plc-link.listen", f"cannot listen on {address[0]}:{address[1]}: {error.strerror}") from error
    return protocol


async def serve(program: Program, address: Address, clock_ns: Callable[[], int]) -> ModbusServer:
    """Open the Modbus side on an address.

    Raises:
        LinkError: the address cannot be used.
    """
    server = ModbusServer(PlcRegisters(program, clock_ns), *address)
    await server.start()
    return server


class LivePlc(LivePlant):
    """A plant and its PLC in real time; the network is served between the physics' steps.

    ``cameras``: TCP port of the cameras' pictures, whose noise follows ``seed``.
    """

    def __init__(
        self,
        plant: PlcPlant,
        port: int | None,
        loop: asyncio.AbstractEventLoop,
        seed: int = 0,
        cameras: int | None = None,
    ) -> None:
        super().__init__(plant, {}, port, seed, cameras)
        self._loop = loop
        self._program = plant.plc
        self._now_ns = 0
        self.modbus: ModbusServer | None = None
        self.datagrams: Datagrams | None = None

    def clock_ns(self) -> int:
        """Return the plant's time."""
        return self._now_ns

    def open(self, modbus: Address | None, udp: Address | None) -> dict[str, int]:
        """Listen; returns the ports in use.

        Raises:
            LinkError: an address cannot be used.
        """
        ports = {}
        if modbus is not None:
            self.modbus = self._loop.run_until_complete(serve(self._program, modbus, self.clock_ns))
            ports["modbus"] = self.modbus.port
        if udp is not None:
            self.datagrams = self._loop.run_until_complete(listen(self._program, udp, self.clock_ns))
            ports["udp"] = self.datagrams.port
        return ports

    def _on_step(self, now_ns: int) -> None:
        self._now_ns = now_ns
        if self.datagrams is not None:
            self.datagrams.cycle()
        self._loop.run_until_complete(asyncio.sleep(0))
        super()._on_step(now_ns)

    def _wait(self, pause_s: float) -> None:
        self._loop.run_until_complete(asyncio.sleep(pause_s))

    def report(self) -> dict[str, float]:
        """Report the counts of the network, too."""
        arbiter = self._program.arbiter
        counts = {
            "accepted": arbiter.accepted,
            "refused": arbiter.refused,
            "dropped": arbiter.dropped,
            "replayed": arbiter.replayed,
        }
        return super().report() | counts | (asdict(self.modbus.counts) if self.modbus else {})

    def close(self) -> None:
        """Stop listening."""
        for server in (self.modbus, self.datagrams):
            if server is not None:
                server.close()
        self._loop.run_until_complete(asyncio.sleep(0))


def _listening(text: str) -> Address:
    host, _, port = text.rpartition(":")
    return (udp_address(f"{host}:1")[0], 0) if port == "0" and host else address_argument(text)


def main(arguments: list[str] | None = None) -> int:
    """Command line; returns the exit code."""
    parser = argparse.ArgumentParser(prog="python -m sim.plc", description="The live plant behind an emulated PLC.")
    parser.add_argument("--profile", required=True, help="shipped profile name or TOML file with a [plc] table")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--truth", default="nominal", help="nominal, sampled, wide_valves or a TOML file")
    parser.add_argument("--logs", type=int, default=1)
    parser.add_argument("--modbus", type=_listening, metavar="HOST:PORT", help="Modbus/TCP; port 0 takes a free one")
    parser.add_argument("--udp", type=_listening, metavar="HOST:PORT", help="cyclic datagrams; port 0 takes a free one")
    parser.add_argument("--word-order", choices=("high", "low"), default="high", help="first half of 32 bits")
    parser.add_argument("--allow-network", action="store_true", help="listen on an address that others can reach")
    parser.add_argument("--key-file", type=Path, help="file with the key that authenticates the datagrams")
    parser.add_argument("--no-key", action="store_true", help="accept datagrams of other hosts without a key")
    parser.add_argument("--camera", type=int, help="TCP port on the loopback interface for camera pictures")
    parser.add_argument("--port", type=int, help="UDP port on the loopback interface for JSON requests")
    options = parser.parse_args(arguments)
    if options.modbus is None and options.udp is None:
        parser.error("give --modbus HOST:PORT, --udp HOST:PORT or both")
    for address in (options.modbus, options.udp):
        if address and not options.allow_network and not is_loopback(address[0]):
            parser.error(f"{address[0]} can be reached by others; give --allow-network if they may command the PLC")
    if options.udp and not (is_loopback(options.udp[0]) or options.key_file or options.no_key):
        parser.error(f"{options.udp[0]} can be reached by others; give --key-file FILE, or --no-key")
    loop = asyncio.new_event_loop()
    try:
        profile = load_profile(options.profile)
        if profile.plc is None:
            raise PlantError(
                "plc.not-configured", f"{profile.name} has no PLC; add a [plc] table with a role to the profile"
            )
        role = Role.REFERENCES if profile.plc.role == "references" else Role.VALVES
        order = WordOrder.HIGH_FIRST if options.word_order == "high" else WordOrder.LOW_FIRST
        key = None if options.key_file is None else read_key(options.key_file)
        plant = PlcPlant(profile, options.seed, options.truth, options.logs, role=role, order=order, key=key)
        live = LivePlc(plant, options.port, loop, options.seed, options.camera)
        ports = live.open(options.modbus, options.udp)
        signal.signal(signal.SIGTERM, live.stop)
        signal.signal(signal.SIGINT, live.stop)
        gc.collect()
        gc.freeze()
        sys.stdout.write(msgspec.json.encode({"ready": ports}).decode() + "\n")
        sys.stdout.flush()
        live.run()
        live.close()
        sys.stderr.write(f"plc: {msgspec.json.encode(live.report()).decode()}\n")
    except ValueError as error:
        sys.stderr.write(f"plc: {error}\n")
        return 3
    except (LinkError, OSError) as error:
        sys.stderr.write(f"plc: {error}\n")
        return 4
    finally:
        loop.close()
    return 0


if __name__ == "__main__":
    sys.exit(main())
