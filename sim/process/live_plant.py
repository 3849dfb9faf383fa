"""The plant in real time on its buses, with a UDP port for JSON requests and a TCP port for camera pictures.

Requests and answers are listed in ``sim/__main__.py``.  Both ports are bound on the loopback interface only.
"""

from __future__ import annotations

import math
import socket
import time
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Final

import msgspec

from can_dbc.bus.base import Bus
from sim.errors import PlantError
from sim.instruments.ideal_detector import detect, detect_in_view
from sim.instruments.total_station import TotalStation, grapple_yaw
from sim.plant import Plant
from sim.plant_faults import End, PlantFault, begin
from sim.process.live import LiveMachine
from sim.process.scene_view import scene_of, view_of
from sim.site.log_supply import LogSupplier
from sim.site.site_file import Site

if TYPE_CHECKING:
    from sim.camera.server import CameraServer

REQUEST_POLL_NS: Final = 20_000_000
LOG_SUPPLY_PERIOD_NS: Final = 1_000_000_000


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
        self._poll_ns = self._supply_ns = 0
        self._faults: list[tuple[int, End]] = []
        """Faults that end by themselves: time [ns] and what ends them."""
        self._log_supplier = None if site is None else LogSupplier(plant, site.places, site.rounds)
        self._requests: socket.socket | None = None
        if port is not None:
            self._requests = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
            self._requests.setblocking(False)
            self._requests.bind(("127.0.0.1", port))
        self.cameras: CameraServer | None = None
        if cameras is not None:
            from sim.camera.rig import CameraRig
            from sim.camera.server import CameraServer

            def rig() -> CameraRig:
                return CameraRig(plant.world, plant.profile, plant.world.truth, seed)

            warm = rig()  # the first picture loads compiled code: for longer than the buses wait
            for name in warm.names:
                warm.frame(name, 0)
            self.cameras = CameraServer(rig(), cameras)

    def _on_step(self, now_ns: int) -> None:
        for fault in [f for f in self._faults if now_ns >= f[0]]:
            self._faults.remove(fault)
            fault[1]()
        if self.cameras is not None:
            self.cameras.serve(now_ns)
        if self._requests is not None and now_ns >= self._poll_ns:
            self._answer(self._requests)
            self._poll_ns = now_ns + REQUEST_POLL_NS
        if self._log_supplier is not None and now_ns >= self._supply_ns:
            self._log_supplier.step()
            self._supply_ns = now_ns + LOG_SUPPLY_PERIOD_NS

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
            except PlantError as error:
                reply = {"error": str(error)}
            requests.sendto(msgspec.json.encode(reply), sender)

    def _reply(self, request: dict[str, str]) -> Any:
        plant = self._plant
        match request.get("op", ""):
            case "state":
                return {
                    "joints": plant.joint_positions(),
                    "tong_rad": plant.jaw_angle_rad(),
                    "tip_m": plant.tip(),
                    "poses": plant.link_poses(),
                    "logs": plant.logs(),
                    "vehicle": plant.vehicle(),
                    "verdict": plant.evaluate(),
                    "host": self.report(),
                }
            case "logs":
                return detect(plant) if self._log_supplier is None else detect_in_view(plant)
            case "verdict":
                return plant.evaluate()
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
                plant.lever(request.get("name", ""), _lever_position(request.get("value", "")))
                return {"ok": True}
            case "press" | "release" | "reset":
                getattr(plant.estop, request["op"])()
                return {"ok": True}
            case "fault":
                self._begin_fault(request)
                return {"ok": True}
            case "quit":
                self.stop()
                return {"ok": True}
            case op:
                return {"error": f"unknown op {op!r}"}

    def _begin_fault(self, request: dict[str, str]) -> None:
        """Begin the fault of a request now; ``for_s`` is its length, for ever without one.

        Raises:
            PlantError: this machine has no such fault.
        """
        now_ns = time.monotonic_ns() - self._skipped_ns
        size, seed = _number(request, "size", 0.0), int(_number(request, "seed", 0.0))
        end = begin(self._plant, PlantFault(request.get("name", ""), request.get("part", ""), size, seed), now_ns)
        length_s = _number(request, "for_s", math.inf)
        if math.isfinite(length_s):
            self._faults.append((now_ns + round(length_s * 1e9), end))


def _number(request: dict[str, str], name: str, otherwise: float) -> float:
    try:
        return float(request.get(name, otherwise))
    except ValueError:
        raise PlantError("fault.not-a-number", f"{name} of a fault is {request[name]!r}; give a number") from None


def _lever_position(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise PlantError("lever.not-a-number", f"lever position {text!r} is not a number; use -1..1") from None
