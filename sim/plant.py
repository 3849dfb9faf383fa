"""The plant: physics world and emulated CAN nodes behind one pure step, in place of the machine on the bus.

``Plant.step(now_ns, received)`` advances physics on a 2.5 ms grid, which starts at the first call's ``now_ns``, up to
``now_ns``; frames are delivered at their own stamps between physics steps, so a SYNC is answered with the state at
that moment.  Returned are the frames sent meanwhile.  No clock, no socket; equal inputs and seed give equal bytes.
A scene that cannot be made raises ValueError.
"""

from __future__ import annotations

import math

from can_dbc.canopen import NMT_ID, SYNC_ID
from can_dbc.codec import load
from can_dbc.frame import Frame
from machine.joints import JOINTS
from machine.profile import Profile
from sim.crane import Quaternion, Shape, Vector, crane_shapes
from sim.judge import Judge, Verdict
from sim.logs import LogState, bunk_shapes
from sim.nodes import Outbox
from sim.nodes.device import MS, EstopBox, PressureModule
from sim.nodes.encoder import EncoderBus, EncoderNode, VirtualNetwork
from sim.nodes.valve import Measured, ValveNode
from sim.truth import load_truth
from sim.world import STEP_NS, Spools, World

__all__ = ["LogState", "Plant", "Shape", "Verdict"]


class Plant:
    """The whole machine.  ``estop`` is the operator's box; the rest of the public names show the truth to a harness."""

    def __init__(self, profile: Profile, seed: int = 0, truth: str = "nominal", logs: int = 1) -> None:
        self.profile = profile
        facts = load_truth(truth, seed)
        self.world = World(profile, facts, seed, logs)
        self._judge = Judge(self.world)
        self._outbox: Outbox = []
        database = load("crane")
        self.estop = EstopBox(database, self._outbox)
        self.valve = ValveNode(database, self._outbox, lambda: self.estop.pilot_on)
        self._pressures = (
            PressureModule(0x20, "PressA", 5 * MS, database, self._outbox),
            PressureModule(0x21, "PressB", 5 * MS, database, self._outbox),
            PressureModule(0x22, "PressC", 20 * MS, database, self._outbox),
        )
        self._devices = (self.estop, self.valve, *self._pressures)
        network = VirtualNetwork(self._outbox)
        self.encoders = {
            name: EncoderNode(name, spec.encoder, facts.encoders[name], STEP_NS, seed, network)
            for name, spec in profile.joints.items()
            if spec.encoder is not None
        }
        self._encoder_bus = EncoderBus(self.encoders, network)
        self._time_ns: int | None = None
        self._measure(0)

    def step(self, now_ns: int, received: list[tuple[str, Frame]]) -> list[tuple[str, int, bytes]]:
        """Advance to ``now_ns``; ``received`` are (bus, frame) sent by others since, stamps up to ``now_ns``."""
        if self._time_ns is None:
            self._time_ns = now_ns
            self._tick(now_ns)
        bus = self.profile.crane_bus
        for frame in sorted((f for name, f in received if name == bus), key=_stamp):
            stamp_ns = max(self._time_ns, min(now_ns, frame.stamp_ns))
            self._advance(stamp_ns)
            self._deliver(frame.key, frame.data, stamp_ns)
        self._advance(now_ns)
        sent = [(bus, key, data) for key, data in self._outbox]
        self._outbox.clear()
        return sent

    @property
    def next_ns(self) -> int:
        """When the next physics step is due; 0 before the first ``step``."""
        return 0 if self._time_ns is None else self._time_ns + STEP_NS

    def _advance(self, until_ns: int) -> None:
        """Physics steps that end at or before ``until_ns``."""
        assert self._time_ns is not None
        while self._time_ns + STEP_NS <= until_ns:
            self._time_ns += STEP_NS
            self.valve.decide(self._time_ns)
            self.world.step(Spools(*(u / 100.0 for u in self.valve.outputs_pct)))
            self._judge.watch()
            self._measure(self._time_ns)
            self._tick(self._time_ns)

    def _measure(self, now_ns: int) -> None:
        """Let every sensor feel the present state."""
        w = self.world
        for name, encoder in self.encoders.items():
            encoder.observe(now_ns, w.q[name], w.qd[name])
        h = w.hydraulics
        slew, lift, tilt, ext = ((a.pressure_a, a.pressure_b) for a in h.actuators)
        closing, opening = w.grapple_pressures_pa
        a, b, c = self._pressures
        a.pressures_pa, b.pressures_pa = (*lift, *tilt), (*ext, *slew)
        c.pressures_pa = (h.supply_pa, w.truth.supply.tank_pa, closing, opening)
        self.valve.measured = Measured(
            spools=tuple(s.position for s in w.spools),
            flow_limited=h.flow_limited,
            opening=w.opening,
            clamp_bar=closing / 1e5,
            load_kg=w.load_kg(),
            rot_deg=math.degrees(w.q["rot"]),
        )

    def _tick(self, now_ns: int) -> None:
        self._encoder_bus.tick(now_ns)
        for device in self._devices:
            device.tick(now_ns)

    def _deliver(self, key: int, data: bytes, now_ns: int) -> None:
        if key == SYNC_ID:
            self._encoder_bus.sync(now_ns)
            self.valve.sync(now_ns)
            return
        if key == NMT_ID:
            for device in self._devices:
                device.receive_nmt(data)
        self._encoder_bus.receive(key, data, now_ns)
        self.valve.receive(key, data, now_ns)

    def logs(self) -> list[LogState]:
        """Every log now: what a perfect detector sees."""
        return self.world.yard.states()

    def joint_positions(self) -> tuple[float, ...]:
        """True joint positions in ``Joint`` order [rad, m]."""
        return tuple(self.world.q[j.name.lower()] for j in JOINTS)

    def tong_angle(self) -> float:
        """True mean tong angle [rad], 0 open."""
        return self.world.tong_angle

    def link_poses(self) -> dict[str, tuple[Vector, Quaternion]]:
        """Link frames in the base frame: position [m] and quaternion (x, y, z, w)."""
        return self.world.crane.link_poses()

    def shapes(self) -> list[Shape]:
        """Boxes to draw; those of link ``base`` stand in the base frame (crane foot, bunk)."""
        return [*crane_shapes(self.profile), *bunk_shapes(self.profile)]

    def tip(self) -> Vector:
        """True hanger pin in the base frame [m]."""
        return self.world.tip()

    def judge(self) -> Verdict:
        """The judge's verdict now."""
        return self._judge.verdict()

    def close(self) -> None:
        """Release the physics client."""
        self.world.close()


def _stamp(frame: Frame) -> int:
    return frame.stamp_ns
