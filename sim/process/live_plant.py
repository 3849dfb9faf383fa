"""The plant in real time on its buses, with a UDP port for JSON requests and a TCP port for camera pictures.

Requests and answers are listed in ``sim/__main__.py``.  Both ports are bound on the loopback interface only.
"""

from __future__ import annotations

import math
import socket
import time
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final

import msgspec

from can_dbc.bus.base import Bus
from machine.geometry.carrier import ARMS
from sim.errors import PlantError
from sim.geometry import Quaternion, Vector
from sim.ground.terrain import Terrain
from sim.hydraulics.layout import PA_PER_BAR
from sim.instruments import TotalStation, detect, detect_in_view, grapple_yaw
from sim.plant import Plant
from sim.plant_faults import End, PlantFault, begin
from sim.process.live import LiveMachine
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


# -- The plant for display: plain JSON values for a page or a picture.  World frame: metres, z up.
#
# A pose is [x, y, z, qx, qy, qz, qw].  Each answer fits into one UDP datagram.

GROUND_HALF_M: Final = 20.0  # half the width of the uneven ground in the view
GROUND_CELL_M: Final = 0.6
LEVER_LABELS: Final = {
    "slew": ("right", "left"),
    "lift": ("lower", "lift"),
    "tilt": ("in", "out"),
    "ext": ("in", "out"),
    "rot": ("right", "left"),
    "grapple": ("close", "open"),
    "steer": ("right", "left"),
    "drive": ("back", "forward"),
}


def scene_of(plant: Plant) -> dict[str, Any]:
    """Describe the constant part: shapes on links, wheels, logs, ground, levers, and the view point."""
    carrier, log_bodies = plant.profile.carrier, plant.world.log_bodies
    wheel = None if carrier is None else {"radius_m": carrier.wheel_radius_m, "width_m": carrier.wheel_width_m}
    middle, _ = plant.base_pose()
    return {
        "title": plant.profile.title,
        "shapes": plant.shapes(),
        "wheels": [] if wheel is None else [wheel] * len(ARMS),
        "logs": [
            {
                "length_m": log.length_m,
                "diameter_m": log.diameter_m,
                "taper_m_m": log.taper_m_m,
                "sweep_m": log.sweep_m,
            }
            for log in log_bodies.states()
        ],
        "ground": _ground(plant.world.terrain),
        "levers": [dict(zip(("name", "minus", "plus"), (n, *_labels(n)), strict=True)) for n in plant.levers()],
        "centre_m": [middle[0], middle[1], middle[2] + 1.0],
        "size_m": 9.0 if carrier is None else 12.0,
    }


def view_of(plant: Plant) -> dict[str, Any]:
    """Describe the moving part, and the numbers beside it."""
    h = plant.world.hydraulics
    return {
        "time_s": plant.time_s,
        "poses": {name: _pose(*pose) for name, pose in plant.link_poses().items()},
        "logs": [_pose(log.position_m, log.quaternion) for log in plant.logs()],
        "wheels": _wheels(plant),
        "facts": _facts(plant),
        "pressures_bar": {n: [round(p / PA_PER_BAR, 1) for p in h.pressures_pa[n]] for n in h.names},
    }


def _labels(lever: str) -> tuple[str, str]:
    return LEVER_LABELS.get(lever, ("lower", "raise"))


def _pose(position: Vector, turn: Quaternion) -> list[float]:
    return [round(v, 4) for v in (*position, *turn)]


def _wheels(plant: Plant) -> list[list[float]]:
    carrier, spec = plant.world.carrier, plant.profile.carrier
    if carrier is None or spec is None:
        return []
    out = []
    for arm, spin in zip(ARMS, carrier.wheel_spin_rad, strict=True):
        hub = [spec.arm_length_m if arm[4] == "f" else -spec.arm_length_m, 0.0, 0.0]
        turned = [0.0, math.sin(spin / 2), 0.0, math.cos(spin / 2)]
        out.append(_pose(*plant.world.client.multiplyTransforms(*carrier.pose(arm), hub, turned)))
    return out


def _facts(plant: Plant) -> dict[str, str]:
    world, verdict = plant.world, plant.evaluate()
    tip, rigid = world.tip(), world.rigid_tip()
    facts = {
        "tip": " ".join(_fixed(v, 2) for v in tip) + " m",
        "sag": f"{1e3 * math.dist(tip, rigid):.0f} mm",
        "load": f"{world.load_kg():.0f} kg",
        "opening": f"{100 * world.opening:.0f} %",
        "pump": f"{world.hydraulics.supply_pa / PA_PER_BAR:.0f} bar",
        "in the bunk": f"{verdict.loaded} of {len(verdict.logs)}",
    }
    vehicle = plant.vehicle()
    if vehicle is not None:
        facts |= {
            "speed": f"{_fixed(3.6 * vehicle.speed_m_s, 1)} km/h",
            "articulation": f"{_fixed(math.degrees(vehicle.articulation_rad), 1)}°",
            "roll, pitch": " ".join(f"{_fixed(math.degrees(a), 1)}°" for a in (vehicle.roll_rad, vehicle.pitch_rad)),
            "arm heights": _list(vehicle.arm_heights_m, 100, "cm"),
            "wheel loads": _list(vehicle.wheel_loads_n, 1e-3, "kN"),
        }
    return facts


def _fixed(value: float, digits: int) -> str:
    """Format without a minus sign before zero."""
    return f"{round(value, digits) + 0.0:.{digits}f}"


def _list(values: Sequence[float], scale: float, unit: str) -> str:
    return " ".join(f"{scale * v:.0f}" for v in values) + f" {unit}"


def _ground(terrain: Terrain) -> dict[str, Any]:
    """Describe level ground by its height, uneven ground by a coarse grid about the origin."""
    if terrain.kind == "flat":
        return {"z_m": terrain.height(0.0, 0.0)}
    n = round(2 * GROUND_HALF_M / GROUND_CELL_M) + 1
    at = [-GROUND_HALF_M + i * GROUND_CELL_M for i in range(n)]
    return {
        "x0_m": -GROUND_HALF_M,
        "y0_m": -GROUND_HALF_M,
        "cell_m": GROUND_CELL_M,
        "columns": n,
        "rows": n,
        "heights": [round(terrain.height(x, y), 2) for y in at for x in at],
    }
