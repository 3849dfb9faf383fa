"""A crane that slews at its full speed in lockstep, a planner that freezes, and a valve that sticks open."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

from autonomy.motion.setpoint_stream import PERIOD_NS, SetpointStream
from can_dbc.dbc.codec import load
from can_dbc.frame import Frame
from can_dbc.messages.crane import GrappleCommand, StateReport
from hil.harness.lockstep import Lockstep, Observer
from hil.wire.inprocess import InProcessBus
from machine.joints import Joint
from machine.loading.profile_file import load_profile, profile_hash
from machine.profile import Profile, joint
from machine.status.modes import Mode
from sim.plant import Plant
from tests.hil.stand_ins import in_lockstep

LEASE_NS = 200_000_000
CRANE = load("crane")
COMMANDS = (CRANE.message("ValveCmdA"), CRANE.message("ValveCmdB"))


@dataclass
class Sweep:
    """Planner: speeds one joint up to its limit, keeps it there, and says nothing more from ``silent_s`` on."""

    profile: Profile
    j: Joint
    silent_s: float = math.inf
    begun_ns: int = 0
    due_ns: int = 0
    last_ns: int = 0
    start: tuple[float, ...] = ()
    way: float = 1.0

    def __post_init__(self) -> None:
        self.stream = SetpointStream(profile_hash(self.profile), LEASE_NS)
        self.spec = joint(self.profile, self.j)

    duration_s = math.inf

    def at(self, time_s: float) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """The motion (`autonomy.motion.setpoint_stream.Motion`)."""
        top, a = self.spec.speed_limit, 0.8 * self.spec.acceleration_limit
        rise_s, t = top / a, max(0.0, time_s)
        moved = 0.5 * a * t * t if t < rise_s else 0.5 * top * rise_s + top * (t - rise_s)
        position, velocity = list(self.start), [0.0] * len(self.start)
        position[self.j] += self.way * moved
        velocity[self.j] = self.way * min(a * t, top)
        return tuple(position), tuple(velocity)

    def step(self, now_ns: int, report: StateReport | None, logs: Any) -> bytes | None:
        if report is None or report.mode not in (Mode.ARMED, Mode.ACTIVE) or now_ns < self.due_ns:
            return None
        if not self.begun_ns:
            self.begun_ns = now_ns
            self.start = tuple(0.0 if q != q else q for q in report.position)
            middle = 0.5 * (self.spec.lower + self.spec.upper)
            self.way = 1.0 if self.start[self.j] <= middle else -1.0
        time_s = (now_ns - self.begun_ns) * 1e-9
        if time_s >= self.silent_s:
            return None
        self.due_ns, self.last_ns = now_ns + PERIOD_NS, now_ns
        return self.stream.datagram(now_ns, self, time_s, GrappleCommand.NEUTRAL)


@dataclass
class Watched:
    """A lockstep run with what happened on the bus and at the tip."""

    system: Lockstep
    plant: Plant
    witness: InProcessBus
    reports: list[StateReport] = field(default_factory=list)
    _open: set[int] = field(default_factory=set)
    neutral_since_ns: int = 0
    """Time of the first of the neutral commands, 0 while some valve is commanded to open."""

    def run(self, seconds: float, until: Any = lambda: False) -> bool:
        """Advance; True when the condition came true."""
        end_ns = self.system.now_ns + round(seconds * 1e9)
        while self.system.now_ns < end_ns:
            self.system.advance()
            frames: list[Frame] = []
            self.witness.drain(frames)
            for frame in frames:
                for codec in COMMANDS:
                    if frame.key == codec.key:
                        self._see(frame, codec.named(codec.decode(frame.data)))
            if until():
                return True
        return False

    def _see(self, frame: Frame, values: dict[str, Any]) -> None:
        opened = any(values.get(name) for name in ("Slew", "Lift", "Tilt", "Ext", "Rot", "Grapple", "Aux"))
        self._open.discard(frame.key)
        if opened:
            self._open.add(frame.key)
        if self._open:
            self.neutral_since_ns = 0
        elif not self.neutral_since_ns:
            self.neutral_since_ns = frame.stamp_ns

    @property
    def mode(self) -> int:
        return self.reports[-1].mode if self.reports else Mode.BOOT

    @property
    def reason(self) -> int:
        return self.reports[-1].reason & 0xFF if self.reports else 0

    def tip(self) -> tuple[float, float, float]:
        return self.plant.world.tip()

    def __enter__(self) -> Watched:
        return self

    def __exit__(self, *_: object) -> None:
        self.plant.close()


def watched(
    name: str, planner: Any, seed: int = 1, truth: str = "sampled", max_stops: int = 0, blind: bool = False
) -> Watched:
    """A run whose operator arms once and leaves a stopped machine alone.

    ``blind``: the guard does not compare motion with commands, so that the supervisor has to see it.
    """
    plant = Plant(load_profile(name), seed=seed, truth=truth, logs=0)
    reports: list[StateReport] = []
    system = in_lockstep(name, plant, planner, observer=Observer(None, [reports.append]), max_stops=max_stops)
    if blind:
        system.guard.motion.clear()
    return Watched(system, plant, InProcessBus(system.core, "witness", receive_own=True), reports)


@dataclass
class Hold:
    """Planner: keeps the crane where it found it."""

    profile: Profile
    due_ns: int = 0
    place: tuple[float, ...] = ()
    duration_s = math.inf

    def __post_init__(self) -> None:
        self.stream = SetpointStream(profile_hash(self.profile), LEASE_NS)

    def at(self, time_s: float) -> tuple[tuple[float, ...], tuple[float, ...]]:
        return self.place, (0.0,) * len(self.place)

    def step(self, now_ns: int, report: StateReport | None, logs: Any) -> bytes | None:
        if report is None or report.mode not in (Mode.ARMED, Mode.ACTIVE) or now_ns < self.due_ns:
            return None
        self.place = self.place or tuple(0.0 if q != q else q for q in report.position)
        self.due_ns = now_ns + PERIOD_NS
        return self.stream.datagram(now_ns, self, 0.0, GrappleCommand.NEUTRAL)
