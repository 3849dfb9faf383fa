"""The live plant: ``python -m sim --profile palms_471 --seed 1 --bus crane0=wire:crane0 [--port 4710]``.

Runs the plant against the monotonic clock with absolute deadlines and looks at the bus at every physics step: a SYNC
is answered within 2.5 ms with the state at its own stamp.  A host too slow for real time makes the plant's time stand
still for a moment (no burst); how often is counted and reported at the end.  ``--port`` answers JSON requests over UDP
on the loopback interface:
``{"op": "state" | "shapes" | "verdict" | "logs" | "poses" | "press" | "release" | "reset" | "quit"}``.

Exit codes: 0 stopped by SIGTERM, SIGINT or quit; 2 usage; 3 profile; 4 bus.
"""

from __future__ import annotations

import argparse
import gc
import signal
import socket
import sys
import time
from typing import Any

import msgspec

from can_dbc.bus import Bus, BusError, open_bus
from can_dbc.frame import Frame
from machine.load import ProfileError, load_profile
from sim.plant import Plant

TX_QUEUE = 256  # this process plays a dozen nodes
LAG_NS = 25_000_000
ANSWER_NS = 20_000_000


class LivePlant:
    """A Plant on the clock and on a bus.  ``stop`` ends ``run``."""

    def __init__(self, plant: Plant, bus: Bus, port: int | None) -> None:
        self._plant, self._bus = plant, bus
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
        name = self._plant.profile.crane_bus
        self._started_ns = time.monotonic_ns()
        answer_ns = 0
        while self._running:
            now_ns = time.monotonic_ns() - self._skipped_ns
            behind_ns = now_ns - self._plant.next_ns if self._plant.next_ns else 0
            if behind_ns > LAG_NS:
                self._skipped_ns += behind_ns
                self._stalls += 1
                now_ns -= behind_ns
            frames.clear()
            self._bus.drain(frames)
            received = [(name, f._replace(stamp_ns=f.stamp_ns - self._skipped_ns)) for f in frames]
            for _, key, data in self._plant.step(now_ns, received):
                self._bus.send(key, data)
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
            "refused_frames": self._bus.stats.refused,
        }

    def _answer(self, requests: socket.socket) -> None:
        while True:
            try:
                datagram, sender = requests.recvfrom(4096)
            except BlockingIOError:
                return
            try:
                request = msgspec.json.decode(datagram, type=dict[str, str])
                reply = self._reply(request.get("op", ""))
            except msgspec.DecodeError as error:
                reply = {"error": f"not a JSON object of strings: {error}"}
            requests.sendto(msgspec.json.encode(reply), sender)

    def _reply(self, op: str) -> Any:
        plant = self._plant
        match op:
            case "state":
                return {
                    "joints": plant.joint_positions(),
                    "tong_rad": plant.tong_angle(),
                    "tip_m": plant.tip(),
                    "poses": plant.link_poses(),
                    "logs": plant.logs(),
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
            case "press" | "release" | "reset":
                getattr(plant.estop, op)()
                return {"ok": True}
            case "quit":
                self.stop()
                return {"ok": True}
            case _:
                return {"error": f"unknown op {op!r}"}


def _address(text: str) -> tuple[str, str]:
    name, equals, address = text.partition("=")
    if not equals or not name or not address:
        raise argparse.ArgumentTypeError(f"'{text}' is not NAME=ADDRESS, as in crane0=wire:crane0")
    return name, address


def main(arguments: list[str] | None = None) -> int:
    """Command line; returns the exit code."""
    parser = argparse.ArgumentParser(prog="python -m sim", description="The live plant of a crane on a CAN bus.")
    parser.add_argument("--profile", default="palms_471", help="shipped profile name or TOML file")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--truth", default="nominal", help="nominal, sampled or a TOML file")
    parser.add_argument("--logs", type=int, default=1)
    parser.add_argument("--bus", type=_address, required=True, metavar="NAME=ADDRESS")
    parser.add_argument("--port", type=int, help="UDP port on the loopback interface for requests")
    options = parser.parse_args(arguments)
    name, address = options.bus
    try:
        profile = load_profile(options.profile)
        if name != profile.crane_bus:
            raise ProfileError(f"{profile.name} has its crane on {profile.crane_bus}, not on {name}; change --bus")
        plant = Plant(profile, options.seed, options.truth, options.logs)
        with open_bus(address, tx_queue=TX_QUEUE, participant="plant") as bus:
            live = LivePlant(plant, bus, options.port)
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
