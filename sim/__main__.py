"""The live plant: ``python -m sim --profile aoro_fc8 --bus crane0=wire:crane0 --bus mach0=wire:mach0 [--port 4710]
[--camera 4711] [--site FILE]``.

Runs the plant in real time (`sim.process.live`).  ``--port`` answers JSON requests over UDP on the loopback
interface: ``{"op": "state" | "shapes" | "verdict" | "logs" | "poses" | "vehicle" | "survey" | "press" | "release" |
"reset" | "scene" | "view" | "quit"}``, ``{"op": "fault", "name": NAME, "part": PART, "size": "1", "for_s": "0.5"}`` and
``{"op": "lever", "name": NAME, "value": "-1".."1"}``.  ``--site`` places
the logs of a mission (`sim.site.site_file`): "logs" then returns those in the cameras' view, and a collected log is
replaced for the next lap.  ``--camera`` serves camera pictures over TCP on the loopback interface
(``can_dbc.messages.rgbd``), rendered on request.

Exit codes: 0 stopped by SIGTERM, SIGINT or quit; 2 usage; 3 profile, truth or scene; 4 bus.
"""

from __future__ import annotations

import argparse
import contextlib
import gc
import signal
import sys
from collections.abc import Mapping
from pathlib import Path

import msgspec

from can_dbc.bus.factory import open_bus
from machine.loading.profile_file import load_profile
from machine.profile import Profile
from runtime.errors import LinkError
from sim.errors import PlantError
from sim.ground.terrain import KINDS as TERRAINS
from sim.individual import beside
from sim.plant import Plant
from sim.process.live import TX_QUEUE_FRAMES
from sim.process.live_plant import LivePlant
from sim.scenes.arrangements import KINDS
from sim.site.site_file import Site, load_site


def _address(text: str) -> tuple[str, str]:
    name, equals, address = text.partition("=")
    if not equals or not name or not address:
        raise argparse.ArgumentTypeError(f"'{text}' is not NAME=ADDRESS, as in crane0=wire:crane0")
    return name, address


def _check_buses(profile: Profile, given: Mapping[str, str]) -> None:
    """Check that all buses of the machine are given, and no other.

    Raises:
        PlantError: the given buses are not exactly those of the machine.
    """
    required_buses = [b for b in (profile.crane_bus, profile.machine_bus) if b]
    for name in given:
        if name not in required_buses:
            raise PlantError(
                "plant.unknown-bus",
                f"{profile.name} has no bus {name}, only {' and '.join(required_buses)}; change --bus",
            )
    for name in required_buses:
        if name not in given:
            raise PlantError(
                "plant.missing-bus", f"{profile.name} needs {' and '.join(required_buses)}; add --bus {name}=ADDRESS"
            )


def _plant(profile: Profile, site: Site | None, options: argparse.Namespace) -> Plant:
    """Make the plant that the command line describes.

    Raises:
        PlantError: the truth, scene or site cannot be used.
    """
    seed, truth = options.seed, options.truth
    if site is not None:
        return site.plant(profile, truth, seed)
    return Plant(profile, seed, truth, options.logs, scene=options.scene, terrain=options.terrain)


def main(arguments: list[str] | None = None) -> int:
    """Command line; returns the exit code."""
    parser = argparse.ArgumentParser(prog="python -m sim", description="The live plant of a machine on its CAN buses.")
    parser.add_argument("--profile", default="palms_471", help="shipped profile name or TOML file")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--truth", default="nominal", help="nominal, sampled, wide_valves, FILE, or as in sampled:FILE")
    parser.add_argument("--logs", type=int, default=1)
    parser.add_argument("--scene", default="random", help=f"arrangement of the logs: random, {', '.join(KINDS)}")
    parser.add_argument("--site", type=Path, help="site file of a mission, instead of --logs and --scene")
    parser.add_argument("--terrain", default="flat", choices=TERRAINS, help="ground under the machine")
    parser.add_argument("--bus", type=_address, action="append", required=True, metavar="NAME=ADDRESS")
    parser.add_argument("--port", type=int, help="UDP port on the loopback interface for requests")
    parser.add_argument("--camera", type=int, help="TCP port on the loopback interface for camera pictures")
    options = parser.parse_args(arguments)
    addresses = dict(options.bus)
    try:
        profile = load_profile(options.profile)
        _check_buses(profile, addresses)
        site = None if options.site is None else load_site(options.site)
        options.truth = beside(options.profile, profile.name, options.truth)
        plant = _plant(profile, site, options)
        with contextlib.ExitStack() as stack:
            buses = {
                name: stack.enter_context(open_bus(address, tx_queue=TX_QUEUE_FRAMES, participant="plant"))
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
    except ValueError as error:
        sys.stderr.write(f"plant: {error}\n")
        return 3
    except (LinkError, OSError) as error:
        sys.stderr.write(f"plant: {error}\n")
        return 4
    return 0


if __name__ == "__main__":
    sys.exit(main())
