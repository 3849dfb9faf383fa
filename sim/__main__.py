"""The live plant: ``python -m sim --profile aoro_fc8 --bus crane0=wire:crane0 --bus mach0=wire:mach0 [--port 4710]
[--camera 4711] [--site FILE]``.

Runs the plant against the monotonic clock (`sim.live`).  ``--port`` answers JSON requests over UDP
on the loopback interface: ``{"op": "state" | "shapes" | "verdict" | "logs" | "poses" | "vehicle" | "survey" | "press"
| "release" | "reset" | "scene" | "view" | "quit"}`` and ``{"op": "lever", "name": NAME, "value": "-1".."1"}``.
With ``--site`` the logs of a mission lie about (`sim.site_file`), "logs" gives those that a camera could see, and where
one was taken a new one is laid for the next lap.  ``--camera`` serves the pictures of its cameras over TCP on that
interface (``can_dbc.rgbd``), drawn when asked for.

Exit codes: 0 stopped by SIGTERM, SIGINT or quit; 2 usage; 3 profile, truth or scene; 4 bus.
"""

from __future__ import annotations

import argparse
import contextlib
import gc
import signal
import socket
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import msgspec

from can_dbc.bus import Bus, BusError, open_bus
from machine.load import ProfileError, load_profile
from machine.profile import Profile
from sim.detector import detect, detect_near
from sim.live import TX_QUEUE, LiveMachine
from sim.plant import Plant
from sim.scene import KINDS
from sim.site import Layer
from sim.site_file import Site, load_site
from sim.survey import TotalStation, grapple_yaw
from sim.terrain import KINDS as TERRAINS
from sim.view import scene_of, view_of

ANSWER_NS = 20_000_000
LAY_NS = 1_000_000_000


class LivePlant(LiveMachine):
    """A plant that also answers requests on a UDP port."""

    def __init__(
        self,
        plant: Plant,
        buses: Mapping[str, Bus],
        port: int | None,
        seed: int = 0,
        cameras: int | None = None,
        site: Site | None = None,
    ) -> None:
        super().__init__(plant, buses)
        self._plant = plant
        self._station = TotalStation(seed)
        self._answer_ns = self._lay_ns = 0
        self._layer = None if site is None else Layer(plant, site.places, site.rounds)
        self._requests = None
        if port is not None:
            self._requests = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
            self._requests.setblocking(False)
            self._requests.bind(("127.0.0.1", port))
        self.cameras = None
        if cameras is not None:
            from sim.camera.rig import CameraRig
            from sim.camera.server import CameraServer

            self.cameras = CameraServer(CameraRig(plant.world, plant.profile, plant.world.truth, seed), cameras)

    def _stepped(self, now_ns: int) -> None:
        if self.cameras is not None:
            self.cameras.serve(now_ns)
        if self._requests is not None and now_ns >= self._answer_ns:
            self._answer(self._requests)
            self._answer_ns = now_ns + ANSWER_NS
        if self._layer is not None and now_ns >= self._lay_ns:
            self._layer.step()
            self._lay_ns = now_ns + LAY_NS

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
                return detect(plant) if self._layer is None else detect_near(plant)
            case "verdict":
                return plant.judge()
            case "poses":
                return plant.link_poses()
            case "shapes":
                return plant.shapes()
            case "vehicle":
                return plant.vehicle()
            case "survey":
                station = self._station
                return {"pin_m": station.read(plant.tip()), "yaw_rad": station.read_yaw(grapple_yaw(plant))}
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


def _plant(profile: Profile, site: Site | None, options: argparse.Namespace) -> Plant:
    """What the command line asks for; raises ValueError."""
    seed, truth = options.seed, options.truth
    if site is not None:
        return site.plant(profile, truth, seed)
    return Plant(profile, seed, truth, options.logs, scene=options.scene, terrain=options.terrain)


def main(arguments: list[str] | None = None) -> int:
    """Command line; returns the exit code."""
    parser = argparse.ArgumentParser(prog="python -m sim", description="The live plant of a machine on its CAN buses.")
    parser.add_argument("--profile", default="palms_471", help="shipped profile name or TOML file")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--truth", default="nominal", help="nominal, sampled or a TOML file")
    parser.add_argument("--logs", type=int, default=1)
    parser.add_argument("--scene", default="random", help=f"how the logs lie: random, {', '.join(KINDS)}")
    parser.add_argument("--site", type=Path, help="file of a mission's site, instead of --logs and --scene")
    parser.add_argument("--terrain", default="flat", choices=TERRAINS, help="what the machine stands on")
    parser.add_argument("--bus", type=_address, action="append", required=True, metavar="NAME=ADDRESS")
    parser.add_argument("--port", type=int, help="UDP port on the loopback interface for requests")
    parser.add_argument("--camera", type=int, help="TCP port on the loopback interface for pictures of the cameras")
    options = parser.parse_args(arguments)
    addresses = dict(options.bus)
    try:
        profile = load_profile(options.profile)
        _check_buses(profile, addresses)
        site = None if options.site is None else load_site(options.site)
        plant = _plant(profile, site, options)
        with contextlib.ExitStack() as stack:
            buses = {
                name: stack.enter_context(open_bus(address, tx_queue=TX_QUEUE, participant="plant"))
                for name, address in addresses.items()
            }
            live = LivePlant(plant, buses, options.port, options.seed, options.camera, site)
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
