"""Speed of the plant: real-time factors, cost over the number of logs, time of a camera picture.

Every interval of simulated time is measured by wall time and by CPU time, with a fixed piece of Python work measured
before it.  The result is the median over the intervals; ``*_per_reference`` is its cost relative
to that work.  The host is noisy if it withheld the processor or the fixed work itself took unequal time.
"""

from __future__ import annotations

import gc
import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import islice, product
from statistics import median
from typing import Any, Final, cast

from rich.console import Console

from can_dbc.dbc.codec import load
from can_dbc.frame import Frame
from can_dbc.protocols.canopen import NmtCommand, nmt_frame, sync_frame
from experiments.common.result import Metric
from experiments.common.worlds import carrier_profile, profile_named, step_neutral, trial_world
from experiments.plant.grasps import ARM, Driver, over_stakes_m, pick_logs, unload
from machine.geometry.carrier import ARMS
from machine.geometry.kinematics import Unreachable
from runtime.errors import InputRefused
from sim.mechanics.carrier import PARKED, Drive
from sim.nodes.messages import ARM_KEY, ProtectedMessage
from sim.nodes.valve import MODE_SPOOL
from sim.plant import Plant
from sim.wood.log_shape import LogSpec
from sim.world import STEP_NS, STEP_S, World

CYCLE_STEPS: Final = 2
SLOW_STEPS: Final = 8
MACHINE_BUS: Final = "mach0"
CRANE_MESSAGES: Final = ("GuardStat", "GuardPilot", "ValveCmdA", "ValveCmdB")
CARRIER_MESSAGES: Final = ("GuardAlive", "VehCmd", "ArmCmdA", "ArmCmdB")
LOG_COUNTS: Final = (1, 12, 50, 200)
PICTURE_LOGS: Final = 12
PER_SECOND: Final = round(1.0 / STEP_S)
MAX_STEAL_SHARE: Final = 0.05  # share of the wall time that the process did not run
MAX_SPREAD: Final = 0.20  # spread of the fixed work, (p90 - median) / median
METRICS: Final = (
    Metric(
        "rtf_crane12",
        "Real-time factor, crane at work among 12 logs, no camera",
        "x",
        "Physics and hydraulics of the fixed crane while it drives its functions.",
        least=5.0,
        clocked=True,
    ),
    Metric(
        "rtf_mission",
        "Real-time factor, forwarder: driving, then crane work, all CAN nodes",
        "x",
        "The whole plant behind both buses: 20 s of driving past a row of logs, then a grasp into the bunk.",
        least=3.0,
        clocked=True,
    ),
    Metric(
        "camera608_ms",
        "Camera picture 608 x 608 with depth, 12 logs",
        "ms",
        "One frame of the emulated stereo camera: colour, depth and its errors.",
        most=12.0,
        clocked=True,
    ),
)


@dataclass(slots=True)
class Stopwatch:
    """Collects measured intervals of one workload, and of the fixed work beside them."""

    wall_s: list[float] = field(default_factory=list)
    processor_s: list[float] = field(default_factory=list)
    reference_s: list[float] = field(default_factory=list)
    _wall: float = 0.0
    _processor: float = 0.0

    def begin(self) -> None:
        """Do the fixed work, then start an interval."""
        self.reference_s.append(_fixed_work_s())
        self._wall, self._processor = time.perf_counter(), time.process_time()

    def end(self) -> None:
        """End the interval."""
        self.wall_s.append(time.perf_counter() - self._wall)
        self.processor_s.append(time.process_time() - self._processor)

    @property
    def steal_share(self) -> float:
        """Share of the wall time in which the process did not run."""
        return max(0.0, 1.0 - sum(self.processor_s) / sum(self.wall_s))

    @property
    def spread(self) -> float:
        """Spread of the fixed work."""
        ordered = sorted(self.reference_s)
        return ordered[9 * (len(ordered) - 1) // 10] / median(ordered) - 1.0

    @property
    def noisy(self) -> bool:
        """Whether the host was too busy for a comparison with limits."""
        return self.steal_share > MAX_STEAL_SHARE or self.spread > MAX_SPREAD


def _fixed_work_s() -> float:
    start = time.perf_counter()
    total = 0.0
    for i in range(1, 60_001):
        total += math.sqrt(i) / i
    return time.perf_counter() - start + 0.0 * total


def measure(profile: str, truth: str, quick: bool, console: Console) -> tuple[dict[str, float], bool, dict[str, Any]]:
    """Measure metrics, whether the host was noisy, and traces for the plots."""
    watches: dict[str, Stopwatch] = {}
    metrics: dict[str, float] = {}
    cost: dict[str, float] = {}
    gc.collect()
    stretches = 4 if quick else 24
    with console.status("timing the plant") as status:
        status.update("timing: crane among 12 logs")
        watches["rtf_crane12"] = _crane(profile, truth, stretches)
        status.update("timing: forwarder, driving and loading, all nodes")
        watches["rtf_mission"] = _mission(carrier_profile(profile), truth, quick)
        for count in LOG_COUNTS:
            status.update(f"timing: {count} logs")
            watch = _growth(profile, truth, count, 2 if quick else 6)
            cost[str(count)] = 1e3 * median(watch.wall_s) / (PER_SECOND // 2)
            metrics[f"step_ms_{count}_logs"] = cost[str(count)]
        status.update("timing: camera")
        camera = watches["camera608_ms"] = _camera(profile, truth, 6 if quick else 30)
    for name, watch in watches.items():
        reference = median(watch.reference_s)
        if watch is camera:
            metrics[name] = 1e3 * median(watch.wall_s)
            metrics["camera608_processor_ms"] = 1e3 * median(watch.processor_s)
            metrics["camera608_per_reference"] = median(watch.wall_s) / reference
            continue
        metrics[name] = 1.0 / median(watch.wall_s)
        metrics[f"{name}_processor"] = 1.0 / median(watch.processor_s)
        metrics[f"{name}_per_reference"] = median(watch.wall_s) / reference
    metrics["host_stolen"] = max(w.steal_share for w in watches.values())
    metrics["host_unequal"] = max(w.spread for w in watches.values())
    return metrics, any(w.noisy for w in watches.values()), {"step_ms": cost}


def rows_of_logs(count: int, x_m: float, y_m: float) -> tuple[LogSpec, ...]:
    """Place logs side by side on the ground from a corner away from the machine, ten in a row."""
    places = ((x_m - 3.0 * column, y_m - 0.5 * row) for row, column in product(range(count), range(10)))
    return tuple(LogSpec(x, y, 0.0, 2.6, 0.2, 600.0) for x, y in islice(places, count))


def heap(count: int, x_m: float, y_m: float) -> tuple[LogSpec, ...]:
    """Release logs in layers of four above each other: a heap with many contacts."""
    return tuple(
        LogSpec(x_m + 0.30 * (i % 4 - 1.5), y_m, math.pi / 2, 2.6, 0.2, 600.0, z_m=0.26 * (i // 4))
        for i in range(count)
    )


def _crane(profile: str, truth: str, stretches: int) -> Stopwatch:
    """Time intervals of one second with the crane moving all its functions, 12 logs in a heap."""
    p = profile_named(profile)
    with trial_world(profile, truth, 1, heap(12, *p.workspace.pick_center_m)) as world:
        driver, watch = Driver(world), Stopwatch()
        start = dict(driver.reference)
        _second(driver, start, 0)
        for i in range(1, stretches + 1):
            watch.begin()
            _second(driver, start, i)
            watch.end()
    return watch


def _second(driver: Driver, start: dict[str, float], number: int) -> None:
    """Move every function in slow sines for a second."""
    spans = {"slew": 0.30, "lift": 0.08, "tilt": 0.15, "ext": 0.15, "rot": 0.8}
    n = PER_SECOND
    driver.grapple = 0.5 if number % 6 < 3 else -0.5
    for i in range(n):
        phase = 2.0 * math.pi * (number + i / n) / 6.0
        driver.reference.update({name: start[name] + span * math.sin(phase) for name, span in spans.items()})
        driver.tick({name: span * math.cos(phase) * 2.0 * math.pi / 6.0 for name, span in spans.items()})


class BusWorld:
    """The whole plant behind its bus with the interface of a World: spools in, CAN frames to the plant and back.

    It replaces controller and guard and sends their messages at their periods: valve commands, guard and SYNC every 5
    ms, vehicle and swing-arm commands every 20 ms.  It has no supervision; it serves timing only.
    """

    def __init__(self, plant: Plant) -> None:
        self.plant, self._world = plant, plant.world
        crane, machine = load("crane"), load("machine")
        self._send = {name: ProtectedMessage(crane, name).frame for name in CRANE_MESSAGES}
        self._send |= {name: ProtectedMessage(machine, name).frame for name in CARRIER_MESSAGES}
        self.now_ns, self._steps, self._sync = 1_000_000_000, 0, 1
        self._crane_bus = plant.profile.crane_bus
        self._pass([(self._crane_bus, *nmt_frame(NmtCommand.START))])

    def __getattr__(self, name: str) -> Any:
        return getattr(self._world, name)

    def step(self, spools: Sequence[float], drive: Drive = PARKED, articulation_rad_s: float = 0.0) -> None:
        """Run one physics step of the plant with the spools (-1 to 1) commanded over the bus."""
        pct = {n: 100.0 * max(-1.0, min(1.0, u)) for n, u in zip(self._world.functions, spools, strict=True)}
        frames: list[tuple[str, int, bytes]] = []
        if self._steps % CYCLE_STEPS == 0:
            frames += [(self._crane_bus, *frame) for frame in self._fast(pct)]
        if self._world.carrier is not None and self._steps % SLOW_STEPS == 0:
            frames += [(MACHINE_BUS, *frame) for frame in self._slow(pct, drive, articulation_rad_s)]
        self._pass(frames)
        self._steps += 1

    def _fast(self, pct: Mapping[str, float]) -> list[tuple[int, bytes]]:
        grapple = pct["grapple"]
        grapple_mode = 1 if grapple > 0.0 else 2 if grapple < 0.0 else 0
        self._sync = self._sync % 240 + 1
        return [
            self._send["GuardStat"](ARM_KEY, 0, 0, 0, 0, 0),
            self._send["GuardPilot"](ARM_KEY, 0, 0),
            self._send["ValveCmdA"](MODE_SPOOL, *(pct[name] for name in ARM)),
            self._send["ValveCmdB"](ARM_KEY, pct["rot"], abs(grapple), 0.0, grapple_mode, 0, 100.0),
            sync_frame(self._sync),
        ]

    def _slow(self, pct: Mapping[str, float], drive: Drive, articulation_rad_s: float) -> list[tuple[int, bytes]]:
        key = ARM_KEY if self._steps > SLOW_STEPS else 0  # a controller starts disarmed
        return [
            self._send["GuardAlive"](ARM_KEY, 0, 0, 0),
            self._send["VehCmd"](key, articulation_rad_s, drive.speed_m_s, 100.0 if drive.brake else 0.0),
            self._send["ArmCmdA"](key, *(pct[name] for name in ARMS)),
            self._send["ArmCmdB"](key, 0, 0),
        ]

    def _pass(self, frames: list[tuple[str, int, bytes]]) -> None:
        self.now_ns += STEP_NS
        self.plant.step(self.now_ns, [(bus, Frame(self.now_ns, key, data)) for bus, key, data in frames])


def _mission(profile: str, truth: str, quick: bool) -> Stopwatch:
    """Drive along a row of 12 logs with gentle bends, stop, load the nearest log into the bunk."""
    plant = Plant(profile_named(profile), seed=1, truth=truth, logs=PICTURE_LOGS, scene="row")
    try:
        bus, watch = BusWorld(plant), Stopwatch()
        spec = plant.profile.carrier
        assert spec is not None
        neutral = [0.0] * len(bus.functions)
        steps = 0

        def lap() -> None:
            nonlocal steps
            steps += 1
            if steps % PER_SECOND == 0:
                watch.end()
                watch.begin()

        watch.begin()
        for i in range((3 if quick else 20) * PER_SECOND):
            rate = 0.05 * math.cos(2.0 * math.pi * i / PER_SECOND / 8.0)
            bus.step(neutral, Drive(spec.cruise_speed_m_s), rate)
            lap()
        world = cast(World, bus)
        _load_one(world, Driver(world, lap), quick)
        return watch
    finally:
        plant.close()


def _load_one(world: World, driver: Driver, quick: bool) -> None:
    """Grasp the nearest log that the crane reaches and lay it into the bunk."""
    driver.wait(1.0)
    centre, logs = world.base_pose()[0], world.log_bodies.states()
    for i in sorted(range(len(logs)), key=lambda i: math.dist(logs[i].position_m, centre)):
        try:
            pick_logs(world, driver, lift_to_m=None if quick else over_stakes_m(world), logs=[logs[i]])
        except Unreachable:
            continue
        if not quick:
            unload(world, driver, [world.log_bodies.states()[i]])
        return
    raise InputRefused(
        "experiment.plant-benchmark", "the crane reaches no log of the row after the drive; change the route"
    )


def _growth(profile: str, truth: str, count: int, stretches: int) -> Stopwatch:
    """Time half-second intervals of the crane at rest with this number of logs on the ground."""
    with trial_world(profile, truth, 1, rows_of_logs(count, 12.0, -6.0)) as world:
        watch = Stopwatch()
        step_neutral(world, PER_SECOND // 2)
        for _ in range(stretches):
            watch.begin()
            step_neutral(world, PER_SECOND // 2)
            watch.end()
    return watch


def _camera(profile: str, truth: str, pictures: int) -> Stopwatch:
    """Render one picture per interval while the crane moves."""
    from sim.camera.rig import CameraRig

    p = profile_named(profile)
    with trial_world(profile, truth, 1, heap(PICTURE_LOGS, *p.workspace.pick_center_m)) as world:
        rig = CameraRig(world, p, world.truth, 1, 608)
        name = next(iter(p.cameras))
        rig.frame(name, 0)
        watch = Stopwatch()
        for i in range(pictures):
            step_neutral(world, 1)
            watch.begin()
            rig.frame(name, (i + 1) * 33_000_000)
            watch.end()
    return watch
