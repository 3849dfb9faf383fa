"""The plant: physics world and emulated CAN nodes behind one pure step, in place of the machine on the bus.

``Plant.step(now_ns, received)`` advances physics on a 2.5 ms grid, which starts at the first call's ``now_ns``, up to
``now_ns``; frames of either bus are delivered at their own stamps between physics steps, so a SYNC is answered with
the state at that moment.  Returned are the frames sent meanwhile, with their buses.  No clock, no socket; equal inputs
and seed give equal bytes.  A scene that cannot be made raises ValueError.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from can_dbc.canopen import NMT_ID, SDO_TO_SERVER, SYNC_ID
from can_dbc.codec import load
from can_dbc.frame import Frame
from machine.carrier import ARMS, height_from_arm_angle
from machine.joints import JOINTS
from machine.profile import Encoder, Profile
from sim.bunk import bunk_shapes
from sim.carrier import PARKED, Carrier, Drive, carrier_links
from sim.crane import crane_shapes
from sim.judge import Judge, Verdict
from sim.levers import DRIVE, HandLevers
from sim.logs import LogState
from sim.nodes import Outbox
from sim.nodes.arms import ArmNode, ArmState
from sim.nodes.device import EstopBox, PressureModule
from sim.nodes.encoder import EncoderBus, EncoderNode, VirtualNetwork
from sim.nodes.engine import EngineNode
from sim.nodes.gnss import GnssNode
from sim.nodes.traffic import MS
from sim.nodes.valve import FUNCTIONS, Measured, ValveNode, ValveState
from sim.nodes.vehicle import VehicleNode
from sim.scene import LogSpec, arrangement, random_scene
from sim.shape import Quaternion, Shape, Vector
from sim.truth import Truth, load_truth
from sim.world import STEP_NS, World

__all__ = ["LogState", "Plant", "Shape", "VehicleState", "Verdict"]
SENSE_STEPS = 4  # the carrier's own sensors are read every 10 ms


@dataclass(frozen=True, slots=True)
class VehicleState:
    """The carrier now, in truth.  Pose of the rear half and heading of the front half in the world, east 0, + left;
    roll + right side down and pitch + nose up of the rear half; heights and loads fl, fr, rl, rr.
    """

    position_m: Vector
    quaternion: Quaternion
    heading_rad: float
    roll_rad: float
    pitch_rad: float
    speed_m_s: float
    articulation_rad: float
    arm_heights_m: tuple[float, ...]
    wheel_loads_n: tuple[float, ...]


class Plant:
    """The whole machine.  ``estop`` is the operator's box; the rest of the public names show the truth to a harness.

    ``scene`` is the name of an arrangement of ``logs`` logs, or the logs themselves; by default they lie at random.
    ``vehicle_node``, ``arms``, ``engine`` and ``gnss`` are None on a machine without carrier.
    """

    def __init__(
        self,
        profile: Profile,
        seed: int = 0,
        truth: str = "nominal",
        logs: int = 1,
        *,
        scene: str | Sequence[LogSpec] | None = None,
        terrain: str = "flat",
    ) -> None:
        self.profile = profile
        facts = load_truth(truth, seed, profile.name)
        self.world = World(profile, facts, seed, _scene(profile, facts, seed, logs, scene), terrain)
        self._judge = Judge(self.world)
        self._time_ns: int | None = None
        self._steps = 0
        self._pressures_of = -1
        self._received = {profile.crane_bus: self._deliver_crane, profile.machine_bus: self._deliver_machine}
        self._floats = (False, False)
        self._crane_out: Outbox = []
        self._machine_out: Outbox = []
        self._place_crane_nodes(facts, seed)
        # Commands come node by node; the world wants them in its own order.
        self._order = (*FUNCTIONS, "steer", *ARMS)
        self._by_function = [self._order.index(name) for name in self.world.functions]
        self._levers = HandLevers(self.world.functions, self.world.carrier is not None)
        self.vehicle_node: VehicleNode | None = None
        self.arms: ArmNode | None = None
        self.engine: EngineNode | None = None
        self.gnss: GnssNode | None = None
        self._machine_nodes: tuple[VehicleNode | ArmNode | EngineNode | GnssNode, ...] = ()
        if self.world.carrier is not None:
            self._place_machine_nodes(facts, seed, self.world.carrier)
        self._measure(0)

    def _place_crane_nodes(self, facts: Truth, seed: int) -> None:
        database, out = load("crane"), self._crane_out
        self.estop = EstopBox(database, out)
        self.valve = ValveNode(database, out, self._pilot_on, self._sense_valves)
        self._devices = (
            self.estop,
            self.valve,
            PressureModule(0x20, "PressA", 5 * MS, database, out, lambda: self._chambers("lift", "tilt")),
            PressureModule(0x21, "PressB", 5 * MS, database, out, lambda: self._chambers("ext", "slew")),
            PressureModule(0x22, "PressC", 20 * MS, database, out, self._grapple_pressures),
        )
        specs: dict[str, Encoder] = {n: s.encoder for n, s in self.profile.joints.items() if s.encoder is not None}
        if self.profile.carrier is not None:
            specs["articulation"] = self.profile.carrier.articulation_encoder
        network = VirtualNetwork(out)
        self.encoders = {
            name: EncoderNode(name, spec, facts.encoders[name], STEP_NS, seed, network) for name, spec in specs.items()
        }
        self._encoder_bus = EncoderBus(self.encoders, network)

    def _place_machine_nodes(self, facts: Truth, seed: int, carrier: Carrier) -> None:
        spec, out = self.profile.carrier, self._machine_out
        if spec is None or facts.gnss is None:
            raise ValueError(f"the truth of {self.profile.name} needs a [gnss] table; add it to the truth file")
        machine = load("machine")
        self.vehicle_node = VehicleNode(machine, out, spec, self._pilot_on)
        self.arms = ArmNode(machine, out, self._pilot_on)
        self.engine = EngineNode(machine, out)
        self.gnss = GnssNode(machine, load("gnss"), out, spec, facts.gnss, seed, lambda: carrier.pose("front"))
        self._machine_nodes = (self.vehicle_node, self.arms, self.engine, self.gnss)

    def _pilot_on(self) -> bool:
        return self.estop.pilot_on

    def step(self, now_ns: int, received: list[tuple[str, Frame]]) -> list[tuple[str, int, bytes]]:
        """Advance to ``now_ns``; ``received`` are (bus, frame) sent by others since, stamps up to ``now_ns``."""
        if self._time_ns is None:
            self._time_ns = now_ns
            self._tick(now_ns)
        for bus, frame in sorted((pair for pair in received if pair[0] in self._received), key=_stamp):
            stamp_ns = max(self._time_ns, min(now_ns, frame.stamp_ns))
            self._advance(stamp_ns)
            self._received[bus](frame.key, frame.data, stamp_ns)
        self._advance(now_ns)
        crane, machine = self.profile.crane_bus, self.profile.machine_bus or ""
        sent = [(crane, key, data) for key, data in self._crane_out]
        sent += [(machine, key, data) for key, data in self._machine_out]
        self._crane_out.clear()
        self._machine_out.clear()
        return sent

    @property
    def next_ns(self) -> int:
        """When the next physics step is due; 0 before the first ``step``."""
        return 0 if self._time_ns is None else self._time_ns + STEP_NS

    @property
    def time_s(self) -> float:
        """Physical time that has passed [s]."""
        return self._steps * STEP_NS * 1e-9

    def _advance(self, until_ns: int) -> None:
        """Physics steps that end at or before ``until_ns``."""
        assert self._time_ns is not None
        while self._time_ns + STEP_NS <= until_ns:
            self._time_ns += STEP_NS
            self._steps += 1
            self.world.step(*self._decide(self._time_ns))
            self._judge.watch()
            self._measure(self._time_ns)
            self._tick(self._time_ns)

    def _decide(self, now_ns: int) -> tuple[list[float], Drive]:
        """What the nodes and levers do to the valves and the drive in this step."""
        self.valve.decide(now_ns)
        commands = [u / 100.0 for u in self.valve.outputs_pct]
        drive = PARKED
        if self.vehicle_node is not None and self.arms is not None:
            self.vehicle_node.decide(now_ns)
            self.arms.decide(now_ns)
            commands += [self.vehicle_node.steer, *self.arms.spools]
            self._float((self.arms.float_front, self.arms.float_rear))
            drive = Drive(self.vehicle_node.drive_m_s, self.vehicle_node.brake)
        held = self._levers.held(now_ns)
        if held and self.estop.pilot_on and not self._commanded():
            if DRIVE in held and self.profile.carrier is not None:
                drive = Drive(held.pop(DRIVE) * self.profile.carrier.cruise_speed_m_s)
            for name, position in held.items():
                commands[self._order.index(name)] = position
        return [commands[i] for i in self._by_function], drive

    def _float(self, wanted: tuple[bool, bool]) -> None:
        """Open or close the float valves of front and rear axle; never both open, not even for a moment."""
        if wanted != self._floats:
            self._floats, valves = wanted, self.world.hydraulics
            valves.float_front = valves.float_rear = False
            valves.float_front, valves.float_rear = wanted

    def _commanded(self) -> bool:
        """Whether a controller moves the machine over the bus."""
        carried = self.vehicle_node is not None and self.vehicle_node.active
        raised = self.arms is not None and self.arms.state is ArmState.ACTIVE
        return self.valve.valve_state is ValveState.ACTIVE or carried or raised

    def _measure(self, now_ns: int) -> None:
        """Let the sensors with a memory feel the present state."""
        q, qd = self.world.q, self.world.qd
        for name, encoder in self.encoders.items():
            encoder.observe(now_ns, q[name], qd[name])
        if self._machine_nodes and self._steps % SENSE_STEPS == 0:
            self._measure_carrier()

    def _sense_valves(self) -> Measured:
        """What the PLC's inputs show now."""
        w, h = self.world, self.world.hydraulics
        spools, (opening, closing) = h.spools, self._pressures()["grapple"]
        return Measured(
            spools=tuple(spools[name] for name in FUNCTIONS),
            flow_limited=h.flow_limited,
            opening=w.opening if self.profile.grapple.opening_sensor else None,
            clamp_bar=closing / 1e5,
            release_bar=opening / 1e5,
            load_kg=w.load_kg(),
            rot_deg=math.degrees(math.remainder(w.q["rot"], math.tau)) if "rot" in self.encoders else None,
        )

    def _chambers(self, first: str, second: str) -> tuple[float, ...]:
        pressures = self._pressures()
        return (*pressures[first], *pressures[second])

    def _pressures(self) -> dict[str, tuple[float, float]]:
        """Chambers of every function [Pa]; made once a step, for three nodes ask."""
        if self._pressures_of != self._steps:
            self._pressures_of, self._pressures_pa = self._steps, self.world.hydraulics.pressures_pa
        return self._pressures_pa

    def _grapple_pressures(self) -> tuple[float, ...]:
        """Pump, tank, closing and opening side of the grapple."""
        h = self.world.hydraulics
        opening, closing = self._pressures()["grapple"]
        return (h.supply_pa, self.world.truth.supply.tank_pa, closing, opening)

    def _measure_carrier(self) -> None:
        """The carrier's own sensors: wheel speeds, articulation, arm heights, inclination, hydraulic power."""
        spec, carrier, vehicle, arms, engine = (
            self.profile.carrier, self.world.carrier, self.vehicle_node, self.arms, self.engine,
        )  # fmt: skip
        assert spec and carrier and vehicle and arms and engine
        vehicle.speed_m_s = engine.speed_m_s = float(sum(carrier.wheel_speeds_rad_s)) / 4.0 * spec.wheel_radius_m
        vehicle.articulation_rad = self.world.q["articulation"]
        middle = spec.arm_travel_m / 2.0
        arms.heights_mm = tuple(1e3 * (height_from_arm_angle(spec, self.world.q[arm]) - middle) for arm in ARMS)
        roll, pitch, _ = carrier.attitude("rear")
        arms.roll_deg, arms.pitch_deg = math.degrees(roll), -math.degrees(pitch)
        engine.energy_j, engine.brake = self.world.hydraulics.energy_j, vehicle.brake

    def _tick(self, now_ns: int) -> None:
        self._encoder_bus.tick(now_ns)
        for device in self._devices:
            device.tick(now_ns)
        for node in self._machine_nodes:
            node.tick(now_ns)

    def _deliver_crane(self, key: int, data: bytes, now_ns: int) -> None:
        if key == SYNC_ID:
            self._encoder_bus.sync(now_ns)
            self.valve.sync(now_ns)
            return
        if key == NMT_ID:
            for device in self._devices:
                device.receive_nmt(data)
        elif SDO_TO_SERVER < key <= SDO_TO_SERVER + 0x7F:
            for device in self._devices:
                device.receive_sdo(key, data)
        self._encoder_bus.receive(key, data, now_ns)
        self.valve.receive(key, data, now_ns)

    def _deliver_machine(self, key: int, data: bytes, now_ns: int) -> None:
        for node in self._machine_nodes:
            node.receive(key, data, now_ns)

    def lever(self, name: str, value: float) -> None:
        """Pull a hand lever (``world.functions``, and ``drive``) to -1..1 for a moment.

        Raises:
            ValueError: no such lever or position, or a controller has the machine.
        """
        if self._commanded():
            raise ValueError("a controller moves the machine over the bus; disarm it before you pull a lever")
        self._levers.pull(name, value, self._time_ns or 0)

    def levers(self) -> tuple[str, ...]:
        """Names of the hand levers."""
        return self._levers.names

    def logs(self) -> list[LogState]:
        """Every log now, in the world frame: what a perfect detector sees."""
        return self.world.yard.states()

    def joint_positions(self) -> tuple[float, ...]:
        """True joint positions in ``Joint`` order [rad, m]."""
        return tuple(self.world.q[j.name.lower()] for j in JOINTS)

    def tong_angle(self) -> float:
        """True mean tong angle [rad], 0 open."""
        return self.world.tong_angle

    def link_poses(self) -> dict[str, tuple[Vector, Quaternion]]:
        """Link frames in the world frame: position [m] and quaternion (x, y, z, w)."""
        return self.world.link_poses()

    def base_pose(self) -> tuple[Vector, Quaternion]:
        """The crane's base frame in the world frame; identity for a machine that stands still."""
        return self.world.base_pose()

    def shapes(self) -> list[Shape]:
        """Boxes to draw, in the frames of their links (crane, bunk, carrier)."""
        under = carrier_links(self.profile, self.world.truth)[0] if self.world.carrier is not None else []
        return [*(s for link in under for s in link.shapes), *crane_shapes(self.profile), *bunk_shapes(self.profile)]

    def vehicle(self) -> VehicleState | None:
        """The carrier in truth; None on a machine without one."""
        c = self.world.carrier
        if c is None:
            return None
        position, turn = c.pose("rear")
        return VehicleState(
            position, turn, c.heading_rad, c.roll_rad, -c.pitch_rad, c.speed_m_s, c.articulation_rad,
            tuple(c.arm_heights_m), tuple(self.world.wheel_loads_n()),
        )  # fmt: skip

    def tip(self) -> Vector:
        """True hanger pin in the crane's base frame [m]."""
        return self.world.tip()

    def judge(self) -> Verdict:
        """The judge's verdict now."""
        return self._judge.verdict()

    def close(self) -> None:
        """Release the physics client."""
        self.world.close()


def _scene(
    profile: Profile, facts: Truth, seed: int, logs: int, scene: str | Sequence[LogSpec] | None
) -> Sequence[LogSpec]:
    if scene is None or scene == "random":
        return random_scene(profile, facts.wood, seed, logs)
    return arrangement(scene, profile, facts.wood, seed, logs) if isinstance(scene, str) else scene


def _stamp(received: tuple[str, Frame]) -> int:
    return received[1].stamp_ns
