"""The whole plant behind its bus with the interface of a World: spools in, CAN frames to the plant and back.

It replaces controller and guard and sends their messages at their periods: valve commands, guard and SYNC every 5 ms,
vehicle and swing-arm commands every 20 ms.  It has no supervision; it serves timing only.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

from can_dbc.dbc.codec import load
from can_dbc.frame import Frame
from can_dbc.protocols.canopen import NmtCommand, nmt_frame, sync_frame
from sim.mechanics.carrier import PARKED, Drive
from sim.nodes.messages import ARM_KEY, ProtectedMessage
from sim.nodes.valve import MODE_SPOOL
from sim.plant import Plant
from sim.world import STEP_NS

CYCLE_STEPS: Final = 2
SLOW_STEPS: Final = 8
MACHINE_BUS: Final = "mach0"


class BusWorld:
    """``step`` is like that of a World; every other attribute is that of the plant's world."""

    def __init__(self, plant: Plant) -> None:
        self.plant, self._world = plant, plant.world
        crane, machine = load("crane"), load("machine")
        self._valve_a, self._valve_b, self._guard, self._pilot = (
            ProtectedMessage(crane, name) for name in ("ValveCmdA", "ValveCmdB", "GuardStat", "GuardPilot")
        )
        self._vehicle, self._arms_a, self._arms_b, self._alive = (
            ProtectedMessage(machine, name) for name in ("VehCmd", "ArmCmdA", "ArmCmdB", "GuardAlive")
        )
        self.now_ns, self._steps, self._sync = 1_000_000_000, 0, 1
        self.sent = self.received = 0
        self._crane_bus = plant.profile.crane_bus
        self._pass([(self._crane_bus, *nmt_frame(NmtCommand.START))])

    def __getattr__(self, name: str) -> Any:
        return getattr(self._world, name)

    def step(self, spools: Sequence[float], drive: Drive = PARKED, articulation_rad_s: float = 0.0) -> None:
        """One physics step of the plant with the spools (-1 to 1) commanded over the bus."""
        frames: list[tuple[str, int, bytes]] = []
        if self._steps % CYCLE_STEPS == 0:
            frames += [(self._crane_bus, *frame) for frame in self._fast(spools)]
        if self._world.carrier is not None and self._steps % SLOW_STEPS == 0:
            frames += [(MACHINE_BUS, *frame) for frame in self._slow(spools, drive, articulation_rad_s)]
        self._pass(frames)
        self._steps += 1

    def _fast(self, spools: Sequence[float]) -> list[tuple[int, bytes]]:
        pct = {n: 100.0 * max(-1.0, min(1.0, u)) for n, u in zip(self._world.functions, spools, strict=True)}
        grapple = pct["grapple"]
        grapple_mode = 1 if grapple > 0.0 else 2 if grapple < 0.0 else 0
        self._sync = self._sync % 240 + 1
        return [
            self._guard.frame(ARM_KEY, 0, 0, 0, 0, 0),
            self._pilot.frame(ARM_KEY, 0, 0),
            self._valve_a.frame(MODE_SPOOL, pct["slew"], pct["lift"], pct["tilt"], pct["ext"]),
            self._valve_b.frame(ARM_KEY, pct["rot"], abs(grapple), 0.0, grapple_mode, 0, 100.0),
            sync_frame(self._sync),
        ]

    def _slow(self, spools: Sequence[float], drive: Drive, articulation_rad_s: float) -> list[tuple[int, bytes]]:
        pct = {n: 100.0 * u for n, u in zip(self._world.functions, spools, strict=True)}
        brake = 100.0 if drive.brake else 0.0
        key = ARM_KEY if self._steps > SLOW_STEPS else 0  # a controller starts disarmed
        arms = (pct[name] for name in ("arm_fl", "arm_fr", "arm_rl", "arm_rr"))
        return [
            self._alive.frame(ARM_KEY, 0, 0, 0),
            self._vehicle.frame(key, articulation_rad_s, drive.speed_m_s, brake),
            self._arms_a.frame(key, *arms),
            self._arms_b.frame(key, 0, 0),
        ]

    def _pass(self, frames: list[tuple[str, int, bytes]]) -> None:
        self.now_ns += STEP_NS
        back = self.plant.step(self.now_ns, [(bus, Frame(self.now_ns, key, data)) for bus, key, data in frames])
        self.sent += len(frames)
        self.received += len(back)
