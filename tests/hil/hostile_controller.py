"""A controller that lies in lockstep: its own safety is off, it says that it operates, and it drives one valve.

The frames of the real controller are rewritten between its tick and the bus, with good checksums and counters, so that
SYNC, start-up and everything else that the nodes need stay as they are.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from can_dbc.dbc.codec import load
from can_dbc.protocols.e2e import protect
from controller.guard.verdicts import Verdict
from controller.tick import Outputs
from hil.harness.lockstep import Lockstep, Observer
from hil.harness.operator import Operator
from machine.loading.profile_file import load_profile
from machine.status.modes import Mode
from sim.plant import Plant
from tests.hil.stand_ins import Idle, in_lockstep

CRANE = load("crane")
FORGED = {CRANE.message(name).key: CRANE.message(name) for name in ("ValveCmdA", "ValveCmdB", "CtrlStatus")}
ARM_KEY, SPOOL, RUN = 0xA, 2, 3
MS = 1_000_000


@dataclass
class Hostile:
    """Rewrites commands from ``begin_ns`` on: the opening of ``signal`` grows by ``rate_pct_s`` up to ``most_pct``."""

    signal: str
    most_pct: float
    rate_pct_s: float
    begin_ns: int = 1 << 62
    told: dict[str, Any] = field(default_factory=lambda: {"Mode": RUN, "SafeState": 0, "Reason": 0})
    """What it says of itself in CtrlStatus."""
    jaws: dict[str, float] = field(default_factory=dict)
    """What it commands of the jaws in ValveCmdB, in place of the controller's."""

    def on_outputs(self, outputs: Outputs, now_ns: int) -> None:
        """Forge the frames of this tick."""
        if now_ns < self.begin_ns:
            return
        grown = self.rate_pct_s * (now_ns - self.begin_ns) * 1e-9
        percent = math.copysign(min(abs(self.most_pct), 10.0 + grown), self.most_pct)
        valve_b = {"ArmKey": ARM_KEY, "PumpReq": 1} | self.jaws
        values = {"ValveCmdA": {"Mode": SPOOL}, "ValveCmdB": valve_b, "CtrlStatus": self.told}
        functions = ("Slew", "Lift", "Tilt", "Ext", "Rot")
        for i, (key, data) in enumerate(outputs.frames):
            codec = FORGED.get(key)
            if codec is not None:
                wanted = {n: 0.0 for n in functions if n in codec.index} | values[codec.name]
                if self.signal in codec.index:
                    wanted[self.signal] = percent
                sent = codec.named(codec.decode(data)) | wanted
                payload = codec.encode(*(sent[s.name] for s in codec.signals))
                outputs.frames[i] = (key, protect(payload, data[1] & 0xF, codec.data_ids))


@dataclass
class Attack:
    """What came of it: speeds are shares of the joint's limit, over 50 ms."""

    verdict: Verdict = Verdict.GOOD
    exceeded_ns: int = 0
    """When the joint was first faster than 1.2 times its limit."""
    cut_ns: int = 0
    fastest: float = 0.0
    over_ns: int = 0
    """How long it was faster than 1.05 times its limit."""
    beyond: float = 0.0
    """How far it came past its range."""
    lowest_m: float = math.inf
    """Of the pin, in the crane's base frame."""
    tip_m: float = 0.0
    enabled_ns: int = 0
    """Time with the valves enabled, from the beginning of the attack."""


def is_armed(system: Lockstep) -> bool:
    """Whether its controller is armed."""
    return system.report is not None and system.report.mode == Mode.ARMED


def standing(machine: str, hostile: Hostile, operator: Operator | None, ready: Callable[[Lockstep], bool]) -> Lockstep:
    """A machine whose controller lies from the moment on at which it is ``ready``."""
    plant = Plant(load_profile(machine), seed=3, logs=0)
    observer = Observer(on_outputs=[hostile.on_outputs])
    system = in_lockstep(machine, plant, Idle(), operator, observer, max_stops=0)
    while not ready(system):
        system.advance()
        assert system.now_ns < 20_000_000_000
    hostile.begin_ns = system.now_ns
    return system


def attack(machine: str, hostile: Hostile, joint: int, seconds: float) -> Attack:
    """Arm, attack for so long, and look at the joint and the tip as they truly are."""
    system = standing(machine, hostile, None, is_armed)
    plant, guard = system.plant, system._guard
    try:
        limit, begun_ns = guard._commands[joint].axis, system.now_ns
        found, began, places = Attack(), plant.tip(), []
        while system.now_ns < begun_ns + int(seconds * 1e9):
            system.advance()
            at = plant.joint_positions()[joint]
            places.append((system.now_ns, at))
            while places[0][0] < system.now_ns - 50 * MS:
                del places[0]
            gone_ns = places[-1][0] - places[0][0]
            share = abs(at - places[0][1]) / (gone_ns * 1e-9) / limit.speed_limit if gone_ns > 40 * MS else 0.0
            found.fastest = max(found.fastest, share)
            found.over_ns += (share > 1.05) * 1_250_000
            if share > 1.2 and not found.exceeded_ns:
                found.exceeded_ns = system.now_ns
            if not guard.enabled and not found.cut_ns:
                found.cut_ns, found.verdict = system.now_ns, guard.verdict
            found.enabled_ns += guard.enabled * 1_250_000
            found.beyond = max(found.beyond, at - limit.upper, limit.lower - at)
            tip = plant.tip()
            found.lowest_m, found.tip_m = min(found.lowest_m, tip[2]), max(found.tip_m, math.dist(tip, began))
        return found
    finally:
        plant.close()
