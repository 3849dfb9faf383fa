"""A machine on its virtual buses with the planner of the experiment, and what is seen of it while it moves.

Controller, guard, CAN bytes and plant as in every lockstep run (`hil.harness.lockstep`).  The plant is made from the profile as
shipped: a calibration changes what is believed of a machine, not the machine.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from math import acos, degrees
from pathlib import Path
from typing import Final

import numpy as np

from autonomy.calibration.trace import BusTrace
from can_dbc.dbc.codec import load
from can_dbc.frame import Frame
from can_dbc.messages.crane import OperatorAction, StateReport
from controller.config import Settings
from controller.guard.__main__ import build as build_guard
from experiments.common.worlds import hang
from experiments.crane_accuracy.measure import Trace
from experiments.crane_accuracy.plan import Visit
from experiments.crane_accuracy.reach_cycles import Part, Rounds, Run
from hil.harness.lockstep import START_NS, Lockstep, Observer
from hil.harness.operator import Operator
from hil.wire.inprocess import InProcessBus
from machine.joints import JOINTS, Joint
from machine.kinematics import pin_position
from machine.load import profile_hash
from machine.profile import Profile
from sim.plant import Plant

ROUND_S: Final = 60.0
"""More than any motion there and back with its rests takes; a machine that needs longer has failed."""
PATIENCE: Final = 8
COMMANDS: Final = ("ValveCmdA", "ValveCmdB")


@dataclass(slots=True)
class Seen:
    """Samples of one motion at the controller's reports: time [ns], true and encoder pin [m], joints, lean [deg]."""

    stamps_ns: list[int] = field(default_factory=list)
    true_m: list[tuple[float, ...]] = field(default_factory=list)
    encoder_m: list[tuple[float, ...]] = field(default_factory=list)
    position: list[tuple[float, ...]] = field(default_factory=list)
    lean_deg: list[float] = field(default_factory=list)


class Stand:
    """``profile`` is what the controller believes, ``guard`` its file for the guard; ``shipped`` makes the plant."""

    def __init__(
        self,
        profile: Profile,
        guard: Path,
        shipped: Profile,
        truth: str,
        seed: int,
        visits: Sequence[Visit],
        shaped: bool = True,
    ) -> None:
        self.profile, self.seen = profile, list[Seen]()
        digest = profile_hash(profile)
        self.plant = Plant(shipped, seed=seed, truth=truth, logs=0)
        self.rounds = Rounds(profile, digest, visits, lambda kg: hang(self.plant.world, kg), shaped)
        self.operator = Operator(digest, _pressed, PATIENCE)
        settings = Settings(profile, digest, profile.rate_hz)
        self._system = Lockstep(
            settings, build_guard(guard), self.plant, self.rounds, self.operator, Observer(None, [self._look])
        )
        database = load("crane")
        self.bus = BusTrace(profile, database)
        keys = [database.message(name).key for name in COMMANDS]
        self._listener = InProcessBus(self._system.core, "surveyor", filters=keys)
        self._frames: list[Frame] = []

    def run(self) -> None:
        """Until every motion was made, the operator gave up, or the time for all of them is over."""
        limit_ns = START_NS + int(ROUND_S * 1e9) * (2 + len(self.rounds.visits))
        system = self._system
        while not self.rounds.done and not self.operator.gave_up and system.now_ns < limit_ns:
            system.advance()

    def close(self) -> None:
        """Release the physics."""
        self.plant.close()

    def _look(self, report: StateReport) -> None:
        """Called with every report: notes what is so now."""
        self._frames.clear()
        self._listener.drain(self._frames)
        rounds = self.rounds
        if rounds.part is not Part.OUT and rounds.part is not Part.REST:
            return
        self.bus.take(self._frames)
        while len(self.seen) < len(rounds.runs):
            self.seen.append(Seen())
        seen = self.seen[-1]
        seen.stamps_ns.append(report.stamp_ns)
        seen.true_m.append(self.plant.tip())
        seen.encoder_m.append(pin_position(self.profile.kinematics, report.position))
        seen.position.append(report.position)
        _, (x, y, _, _) = self.plant.world.crane.pose("rotator")
        seen.lean_deg.append(degrees(acos(max(-1.0, min(1.0, 1.0 - 2.0 * (x * x + y * y))))))

    def trace(self, run: Run, seen: Seen) -> Trace:
        """One motion with its rest."""
        time_s = (np.array(seen.stamps_ns) - run.begun_ns) * 1e-9
        command_s, shut = self._valves(run)
        return Trace(time_s, np.array(seen.encoder_m), np.array(seen.true_m), np.array(seen.lean_deg), command_s, shut)

    def spools(self, run: Run, which: Joint) -> tuple[np.ndarray, np.ndarray]:
        """Times [s] and commands of one joint's valve on the bus, -1..1."""
        return self.bus.commands[which].between(run.begun_ns, run.over_ns or self._system.now_ns)

    def _valves(self, run: Run) -> tuple[np.ndarray, np.ndarray]:
        """Times [s] of the commands and whether all joints' valves were told exactly zero then."""
        times, slew = self.spools(run, Joint.SLEW)
        shut = slew == 0.0
        for j in JOINTS:
            when, values = self.spools(run, j)
            at = np.searchsorted(when, times, side="right") - 1
            shut &= values[np.maximum(at, 0)] == 0.0
        return times, shut


def _pressed(action: OperatorAction, report: StateReport) -> None:
    """The human who arms says nothing."""
