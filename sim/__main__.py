"""The live plant: ``python -m sim --profile aoro_fc8 --bus crane0=wire:crane0 --bus mach0=wire:mach0 [--port 4710]``.

Runs the plant against the monotonic clock with absolute deadlines and looks at its buses at every physics step: a SYNC
is answered within 2.5 ms with the state at its own stamp.  A host too slow for real time makes the plant's time stand
still for a moment (no burst); how often is counted and reported at the end.  ``--port`` answers JSON requests over UDP
on the loopback interface: ``{"op": "state" | "shapes" | "verdict" | "logs" | "poses" | "vehicle" | "press" | "release"
| "reset" | "scene" | "view" | "quit"}`` and ``{"op": "lever", "name": NAME, "value": "-1".."1"}``.

Exit codes: 0 stopped by SIGTERM, SIGINT or quit; 2 usage; 3 profile, truth or scene; 4 bus.
"""

from __future__ import annotations

import argparse
import contextlib
import gc
import signal
import socket
import sys
import time
from collections.abc import Mapping
from typing import Any

import msgspec

from can_dbc.bus import Bus, BusError, open_bus
from can_dbc.frame import Frame
from machine.load import ProfileError, load_profile
from machine.profile import Profile
from sim.plant import Plant
from sim.scene import KINDS
from sim.terrain import KINDS as TERRAINS
from sim.view import scene_of, view_of

TX_QUEUE = 256  # this process plays a dozen nodes
LAG_NS = 25_000_000
ANSWER_NS = 20_000_000


class LivePlant:
    """A Plant on the clock and on its buses, by name.  ``stop`` ends ``run``."""

    def __init__(self, plant: Plant, buses: Mapping[str, Bus], port: int | None) -> None:
        self._plant, self._buses = plant, dict(buses)
        self._running = True
        self._skipped_ns = self._started_ns = self._stalls = 0
        self._requests = None
        if port is not None:
            self._requests = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
            self._requests.setblocking(False)
            self._requests.bind(("127.0.0.1", port))

    def stop(self, *_: object) -> None:
        """End after the present step; usable as a signal handler."""
        self._running = False

    def run(self) -> None:
        """Until stopped."""
        frames: list[Frame] = []
        self._started_ns = time.monotonic_ns()
        answer_ns = 0
        while self._running:
            now_ns = time.monotonic_ns() - self._skipped_ns
            behind_ns = now_ns - self._plant.next_ns if self._plant.next_ns else 0
            if behind_ns > LAG_NS:
                self._skipped_ns += behind_ns
                self._stalls += 1
                now_ns -= behind_ns
            received = []
            for name, bus in self._buses.items():
                frames.clear()
                bus.drain(frames)
                received += [(name, f._replace(stamp_ns=f.stamp_ns - self._skipped_ns)) for f in frames]
            for name, key, data in self._plant.step(now_ns, received):
                self._buses[name].send(key, data)
            if self._requests is not None and now_ns >= answer_ns:
                self._answer(self._requests)
                answer_ns = now_ns + ANSWER_NS
            pause_ns = self._plant.next_ns - (time.monotonic_ns() - self._skipped_ns)
            if pause_ns > 0:
                time.sleep(pause_ns * 1e-9)

    def report(self) -> dict[str, float]:
        """How well real time was kept: share of time that was lost, and how often."""
        elapsed_ns = max(1, time.monotonic_ns() - self._started_ns)
        return {
            "time_s": elapsed_ns * 1e-9,
            "lost_share": self._skipped_ns / elapsed_ns,
            "stalls": self._stalls,
            "refused_frames": sum(bus.stats.refused for bus in self._buses.values()),
        }

    def _answer(self, requests: socket.socket) -> None:
        while True:
            try:
                datagram, sender = requests.recvfrom(4096)
            except BlockingIOError:
                return
            try:
                request = msgspec.json.decode(datagram, type=dict[str, str])
                reply = self._reply(request)
            except msgspec.DecodeError as error:
                reply = {"error": f"not a JSON object of strings: {error}"}
            except ValueError as error:
                reply = {"error": str(error)}
            requests.sendto(msgspec.json.encode(reply), sender)

    def _reply(self, request: dict[str, str]) -> Any:
        plant = self._plant
        match request.get("op", ""):
            case "state":
                return {
                    "joints": plant.joint_positions(),
                    "tong_rad": plant.tong_angle(),
                    "tip_m": plant.tip(),
                    "poses": plant.link_poses(),
                    "logs": plant.logs(),
                    "vehicle": plant.vehicle(),
                    "verdict": plant.judge(),
                    "host": self.report(),
                }
            case "logs":
                return plant.logs()
            case "verdict":
                return plant.judge()
            case "poses":
                return plant.link_poses()
            case "shapes":
                return plant.shapes()
            case "vehicle":
                return plant.vehicle()
            case "scene":
                return scene_of(plant)
            case "view":
                return view_of(plant)
            case "lever":
                plant.lever(request.get("name", ""), float(request.get("value", "")))
                return {"ok": True}
            case "press" | "release" | "reset":
                getattr(plant.estop, request["op"])()
                return {"ok": True}
            case "quit":
                self.stop()
                return {"ok": True}
            case op:
                return {"error": f"unknown op {op!r}"}


def _address(text: str) -> tuple[str, str]:
    name, equals, address = text.partition("=")
    if not equals or not name or not address:
        raise argparse.ArgumentTypeError(f"'{text}' is not NAME=ADDRESS, as in crane0=wire:crane0")
    return name, address


def _check_buses(profile: Profile, given: Mapping[str, str]) -> None:
    """ProfileError unless exactly the machine's buses are given."""
    wanted = [b for b in (profile.crane_bus, profile.machine_bus) if b]
    for name in given:
        if name not in wanted:
            raise ProfileError(f"{profile.name} has no bus {name}, only {' and '.join(wanted)}; change --bus")
    for name in wanted:
        if name not in given:
            raise ProfileError(f"{profile.name} is on {' and '.join(wanted)}; give --bus {name}=ADDRESS too")


def main(arguments: list[str] | None = None) -> int:
    """Command line; returns the exit code."""
    parser = argparse.ArgumentParser(prog="python -m sim", description="The live plant of a machine on its CAN buses.")
    parser.add_argument("--profile", default="palms_471", help="shipped profile name or TOML file")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--truth", default="nominal", help="nominal, sampled or a TOML file")
    parser.add_argument("--logs", type=int, default=1)
    parser.add_argument("--scene", default="random", help=f"how the logs lie: random, {', '.join(KINDS)}")
    parser.add_argument("--terrain", default="flat", choices=TERRAINS, help="what the machine stands on")
    parser.add_argument("--bus", type=_address, action="append", required=True, metavar="NAME=ADDRESS")
    parser.add_argument("--port", type=int, help="UDP port on the loopback interface for requests")
    options = parser.parse_args(arguments)
    addresses = dict(options.bus)
    try:
        profile = load_profile(options.profile)
        _check_buses(profile, addresses)
        plant = Plant(profile, options.seed, options.truth, options.logs, scene=options.scene, terrain=options.terrain)
        with contextlib.ExitStack() as stack:
            buses = {
                name: stack.enter_context(open_bus(address, tx_queue=TX_QUEUE, participant="plant"))
                for name, address in addresses.items()
            }
            live = LivePlant(plant, buses, options.port)
            signal.signal(signal.SIGTERM, live.stop)
            signal.signal(signal.SIGINT, live.stop)
            gc.collect()
            gc.freeze()
            sys.stdout.write("ready\n")
            sys.stdout.flush()
            live.run()
            sys.stderr.write(f"plant: {msgspec.json.encode(live.report()).decode()}\n")
    except (ProfileError, ValueError) as error:
        sys.stderr.write(f"plant: {error}\n")
        return 3
    except (BusError, OSError) as error:
        sys.stderr.write(f"plant: {error}\n")
        return 4
    return 0


if __name__ == "__main__":
    sys.exit(main())
