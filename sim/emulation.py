"""The emulated CAN nodes of a whole machine around any world that moves: shared by the physics and the kinematic world.

``EmulatedMachine.step(now_ns, received)`` advances its world on a grid of steps, from the first call's ``now_ns`` up
to ``now_ns``.  Frames of either bus are delivered at their own time stamps between the steps, so a SYNC is answered
at once with the state of the last step.  It returns the frames sent meanwhile, with their buses.  It uses no clock
and no socket; equal inputs and seed give equal bytes.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any, Protocol

from can_dbc.dbc.codec import load
from can_dbc.frame import Frame
from can_dbc.protocols.canopen import NMT_ID, SDO_TO_SERVER, SYNC_ID
from machine.crane_nodes import CraneNode
from machine.geometry.carrier import ARMS, height_from_arm_angle
from machine.profile import Encoder, Profile
from sim.errors import PlantError
from sim.faults import FrameTap, SpoolFaults
from sim.hydraulics.layout import PA_PER_BAR
from sim.nodes import Outbox
from sim.nodes.device import Device, EstopBox, PressureModule
from sim.nodes.encoder import EncoderBus, EncoderNode, VirtualNetwork
from sim.nodes.gnss import GnssNode
from sim.nodes.imu import ImuNode
from sim.nodes.mach0 import ArmNode, EngineNode, VehicleNode
from sim.nodes.messages import MS
from sim.nodes.valve import CYCLE_NS, FUNCTIONS, ValveInputs, ValveNode
from sim.truth.load import Truth

SENSE_NS = 10 * MS
"""Sampling period of the carrier's own sensors."""
COMMANDED = (*FUNCTIONS, "steer", *ARMS)
"""Functions in the order of the nodes' commands; the first ones are those of a machine without a carrier."""


class SensedWorld(Protocol):
    """What the nodes sense of a world: joints by name, hydraulics, and the carrier (None on a machine without one)."""

    truth: Truth
    hydraulics: Any
    carrier: Any

    @property
    def q(self) -> Mapping[str, float]: ...
    @property
    def qd(self) -> Mapping[str, float]: ...
    @property
    def opening(self) -> float: ...
    def load_kg(self) -> float: ...
    def lean_rad(self) -> tuple[float, float]: ...


class EmulatedMachine(ABC):
    """All nodes of a machine.  ``estop`` is the operator's emergency stop.

    ``vehicle_node``, ``arms``, ``engine`` and ``gnss`` are None on a machine without carrier, ``imu`` where the profile
    has none.  ``cycle_ns`` is the period of the valve node's feedback and of the fast pressures.  ``spool_faults`` and
    ``tap`` make valves and nodes fail (`sim.plant_faults`); ``tilt_rad`` is added to the measured roll and pitch.
    """

    def __init__(
        self,
        profile: Profile,
        facts: Truth,
        seed: int,
        world: SensedWorld,
        step_ns: int,
        cycle_ns: int = CYCLE_NS,
    ) -> None:
        self.profile = profile
        self._surroundings = world
        self._step_ns, self._sense_steps = step_ns, max(1, SENSE_NS // step_ns)
        self._time_ns: int | None = None
        self._steps = 0
        self.spool_faults, self.tap = SpoolFaults(), FrameTap()
        self.tilt_rad = (0.0, 0.0)
        self._pressures_of = -1
        self._pressures_pa: dict[str, tuple[float, float]] = {}
        self._received = {profile.crane_bus: self._deliver_crane, profile.machine_bus: self._deliver_machine}
        self._crane_out: Outbox = []
        self._machine_out: Outbox = []
        self._place_crane_nodes(facts, seed, cycle_ns)
        self.vehicle_node: VehicleNode | None = None
        self.arms: ArmNode | None = None
        self.engine: EngineNode | None = None
        self.gnss: GnssNode | None = None
        self._machine_nodes: tuple[VehicleNode | ArmNode | EngineNode | GnssNode, ...] = ()
        if world.carrier is not None:
            self._place_machine_nodes(facts, seed, world.carrier)
        self._measure(0)

    def _place_crane_nodes(self, facts: Truth, seed: int, cycle_ns: int) -> None:
        database, out = load("crane"), self._crane_out
        self.estop = EstopBox(database, out)
        command_ns = max(cycle_ns, 1_000_000_000 // self.profile.rate_hz)
        self.valve = ValveNode(database, out, self._pilot_on, self._sense_valves, cycle_ns, command_ns)
        spec = self.profile.imu
        self.imu = None if spec is None else ImuNode(spec, database, out, self._step_ns, seed)
        self._devices: tuple[Device, ...] = (
            self.estop,
            self.valve,
            PressureModule(
                CraneNode.PRESSURES_A, "PressA", cycle_ns, database, out, lambda: self._chambers("lift", "tilt")
            ),
            PressureModule(
                CraneNode.PRESSURES_B, "PressB", cycle_ns, database, out, lambda: self._chambers("ext", "slew")
            ),
            PressureModule(CraneNode.PRESSURES_C, "PressC", 20 * MS, database, out, self._grapple_pressures),
            *([] if self.imu is None else [self.imu]),
        )
        specs: dict[str, Encoder] = {n: s.encoder for n, s in self.profile.joints.items() if s.encoder is not None}
        if self.profile.carrier is not None:
            specs["articulation"] = self.profile.carrier.articulation_encoder
        network, step_ns = VirtualNetwork(out), self._step_ns
        self.encoders = {
            name: EncoderNode(name, spec, facts.encoders[name], step_ns, seed, network) for name, spec in specs.items()
        }
        self._encoder_bus = EncoderBus(self.encoders, network)

    def _place_machine_nodes(self, facts: Truth, seed: int, carrier: Any) -> None:
        spec, out = self.profile.carrier, self._machine_out
        if spec is None or facts.gnss is None:
            raise PlantError(
                "truth.no-gnss", f"the truth of {self.profile.name} has no [gnss] table; add it to the truth file"
            )
        machine = load("machine")
        self.vehicle_node = VehicleNode(machine, out, spec, self._pilot_on)
        self.arms = ArmNode(machine, out, self._pilot_on)
        self.engine = EngineNode(machine, out)
        self.gnss = GnssNode(machine, load("gnss"), out, spec, facts.gnss, seed, lambda: carrier.pose("front"))
        self._machine_nodes = (self.vehicle_node, self.arms, self.engine, self.gnss)

    def _pilot_on(self) -> bool:
        return self.estop.pilot_on

    @abstractmethod
    def _move(self, now_ns: int) -> None:
        """Advance the world by one step, which ends at ``now_ns``."""

    def step(self, now_ns: int, received: list[tuple[str, Frame]]) -> list[tuple[str, int, bytes]]:
        """Advance to ``now_ns``.

        ``received`` are (bus, frame) pairs sent by others since the last call, with stamps up to ``now_ns``.
        Returns (bus, key, data) of the frames that the nodes sent.
        """
        self._run(now_ns, received)
        return self.tap.pass_on(now_ns, self._collect())

    def _run(self, now_ns: int, received: list[tuple[str, Frame]]) -> None:
        """Advance to ``now_ns``; the nodes get what was received and fill their outboxes."""
        if self._time_ns is None:
            self._time_ns = now_ns
            self._tick(now_ns)
        for bus, frame in sorted((pair for pair in received if pair[0] in self._received), key=_stamp):
            stamp_ns = max(self._time_ns, min(now_ns, frame.stamp_ns))
            self._advance(stamp_ns)
            self._received[bus](frame.key, frame.data, stamp_ns)
        self._advance(now_ns)

    def _collect(self) -> list[tuple[str, int, bytes]]:
        """Empty both outboxes."""
        crane, machine = self.profile.crane_bus, self.profile.machine_bus or ""
        sent = [(crane, key, data) for key, data in self._crane_out]
        sent += [(machine, key, data) for key, data in self._machine_out]
        self._crane_out.clear()
        self._machine_out.clear()
        return sent

    @property
    def next_ns(self) -> int:
        """When the next step is due; 0 before the first ``step``."""
        return 0 if self._time_ns is None else self._time_ns + self._step_ns

    @property
    def time_s(self) -> float:
        """Simulated time since the start [s]."""
        return self._steps * self._step_ns * 1e-9

    def _advance(self, until_ns: int) -> None:
        """Run all steps that end at or before ``until_ns``."""
        assert self._time_ns is not None
        while self._time_ns + self._step_ns <= until_ns:
            self._time_ns += self._step_ns
            self._steps += 1
            self._move(self._time_ns)
            self._measure(self._time_ns)
            self._tick(self._time_ns)

    def _spools(self, now_ns: int) -> list[float]:
        """Return the commands of the nodes to the valves in this step, -1..1: `FUNCTIONS`, then steering and `ARMS`."""
        self.estop.decide(now_ns)
        self.valve.decide(now_ns)
        commands = [u / 100.0 for u in self.valve.outputs_pct]
        if self.vehicle_node is not None and self.arms is not None:
            self.vehicle_node.decide(now_ns)
            self.arms.decide(now_ns)
            commands += [self.vehicle_node.steer, *self.arms.spools]
        return self.spool_faults.apply(COMMANDED, commands) if self.spool_faults and self.estop.pilot_on else commands

    def _measure(self, now_ns: int) -> None:
        """Feed the present state to the sensors with a memory."""
        q, qd = self._surroundings.q, self._surroundings.qd
        for name, encoder in self.encoders.items():
            encoder.observe(now_ns, q[name], qd[name])
        if self.imu is not None:
            self.imu.observe(self._surroundings.lean_rad())
        if self._machine_nodes and self._steps % self._sense_steps == 0:
            self._measure_carrier()

    def _sense_valves(self) -> ValveInputs:
        """Return the readings of the PLC's inputs."""
        w, h = self._surroundings, self._surroundings.hydraulics
        spools, (opening, closing) = h.spools, self._pressures()["grapple"]
        return ValveInputs(
            spools=tuple(spools[name] for name in FUNCTIONS),
            flow_limited=h.flow_limited,
            opening=w.opening if self.profile.grapple.opening_sensor else None,
            clamp_bar=closing / PA_PER_BAR,
            release_bar=opening / PA_PER_BAR,
            load_kg=w.load_kg(),
            rot_deg=math.degrees(math.remainder(w.q["rot"], math.tau)) if "rot" in self.encoders else None,
        )

    def _chambers(self, first: str, second: str) -> tuple[float, ...]:
        pressures = self._pressures()
        return (*pressures[first], *pressures[second])

    def _pressures(self) -> dict[str, tuple[float, float]]:
        """Return the chamber pressures of every function [Pa]; computed once per step because three nodes read them."""
        if self._pressures_of != self._steps:
            self._pressures_of, self._pressures_pa = self._steps, self._surroundings.hydraulics.pressures_pa
        return self._pressures_pa

    def _grapple_pressures(self) -> tuple[float, ...]:
        """Return the pressures of pump, tank, closing and opening side of the grapple."""
        w = self._surroundings
        opening, closing = self._pressures()["grapple"]
        return (w.hydraulics.supply_pa, w.truth.supply.tank_pa, closing, opening)

    def _measure_carrier(self) -> None:
        """Read the carrier's own sensors: wheel speeds, articulation, arm heights, inclination, hydraulic power."""
        w, spec = self._surroundings, self.profile.carrier
        vehicle, arms, engine = self.vehicle_node, self.arms, self.engine
        assert spec and w.carrier and vehicle and arms and engine
        vehicle.speed_m_s = engine.speed_m_s = float(sum(w.carrier.wheel_speeds_rad_s)) / 4.0 * spec.wheel_radius_m
        vehicle.articulation_rad = w.q["articulation"]
        middle = spec.arm_travel_m / 2.0
        arms.heights_mm = tuple(1e3 * (height_from_arm_angle(spec, w.q[arm]) - middle) for arm in ARMS)
        roll, pitch, _ = w.carrier.attitude("rear")
        arms.roll_deg, arms.pitch_deg = math.degrees(roll + self.tilt_rad[0]), math.degrees(self.tilt_rad[1] - pitch)
        engine.energy_j, engine.brake = w.hydraulics.energy_j, vehicle.brake

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
        self.estop.receive(key, data, now_ns)

    def _deliver_machine(self, key: int, data: bytes, now_ns: int) -> None:
        for node in self._machine_nodes:
            node.receive(key, data, now_ns)


def _stamp(received: tuple[str, Frame]) -> int:
    return received[1].stamp_ns
