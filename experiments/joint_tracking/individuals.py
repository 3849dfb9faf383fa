"""Individual machines of the truth's spread or twice that spread, with calibrated or shipped valves in the
controller."""

from __future__ import annotations

from collections.abc import Callable
from itertools import product
from typing import Any, Final

import msgspec

from experiments.common.pool import Job
from experiments.common.worlds import home_at, profile_named, trial_world
from experiments.joint_tracking.testbed import Calibration, JointTestbed, controller_profile
from machine.geometry.kinematics import max_reach_m
from machine.loading.profile_file import load_profile
from sim.world import World

REACH_SHARE, HEIGHT_M = 0.55, 1.0
WIDE_FACTOR: Final = 2.0
"""Factor on the spread of dead time and gain."""
CORNERS: Final = tuple(product((0, 1), (0, 1), (False, True)))
"""Corners of that spread for all joints together: least or largest dead time, least or largest gain, empty or loaded.
"""


def kind_of(job: Job) -> str:
    """Name the shipped machine that a profile resembles."""
    return "palms_471" if profile_named(job.options["profile"]).carrier is None else "aoro_fc8"


class Machine:
    """Context of a testbed on a world of its own; ``machine`` changes the truth of the individual, ``later`` what it
    is after its calibration.
    """

    def __init__(
        self,
        job: Job,
        machine: Callable[[Job, World], Any] | None = None,
        later: Callable[[Any], Any] | None = None,
    ) -> None:
        o = job.options
        profile = load_profile(o["profile"])
        home = home_at(o["profile"], REACH_SHARE * max_reach_m(profile), HEIGHT_M)
        with trial_world(o["profile"], o["truth"], job.seed) as world:
            truth = world.truth if machine is None else machine(job, world)
        now = truth if later is None else later(truth)
        self._world = world = World(profile, now, job.seed, (), home=home)
        calibration = Calibration(job.seed) if o["calibrated"] else None
        made = controller_profile(profile, truth, o["law"], calibration, o.get("damped", True))
        self._rig = JointTestbed(made, world, job.seed)

    def __enter__(self) -> JointTestbed:
        return self._rig

    def __exit__(self, *_: object) -> None:
        self._world.close()


def with_valves(truth: Any, gain: float, delay: float = 1.0) -> Any:
    """Multiply the gains and dead times of all valves of the truth by these factors."""
    functions = {}
    for name, function in truth.functions.items():
        valve = function.valve
        valve = msgspec.structs.replace(
            valve,
            full_speed_plus=gain * valve.full_speed_plus,
            full_speed_minus=gain * valve.full_speed_minus,
            delay_s=delay * valve.delay_s,
        )
        functions[name] = msgspec.structs.replace(function, valve=valve)
    return msgspec.structs.replace(truth, functions=functions)


def widened(job: Job, world: World) -> Any:
    """Double the truth's deviation of the dead time from the middle of the spread, and of the gain from nominal."""
    middle_s = 0.5 * (world.truth.spread.delay_min_s + world.truth.spread.delay_max_s)

    def change(drawn: Any, nominal: Any) -> tuple[float, float, float]:
        plus, minus = (
            n + WIDE_FACTOR * (d - n)
            for d, n in (
                (drawn.full_speed_plus, nominal.full_speed_plus),
                (drawn.full_speed_minus, nominal.full_speed_minus),
            )
        )
        return middle_s + WIDE_FACTOR * (drawn.delay_s - middle_s), plus, minus

    return _changed(job, world, change)


def cornered(job: Job, world: World) -> Any:
    """Put all joints of the truth at the same bounds of twice the spread."""
    spread, (late, fast, _) = world.truth.spread, CORNERS[job.options["corner"]]
    middle_s, half_s = 0.5 * (spread.delay_max_s + spread.delay_min_s), 0.5 * (spread.delay_max_s - spread.delay_min_s)
    delay_s = middle_s + (WIDE_FACTOR if late else -WIDE_FACTOR) * half_s
    gain = 1.0 + (WIDE_FACTOR if fast else -WIDE_FACTOR) * spread.gain
    return _changed(job, world, lambda _, n: (delay_s, gain * n.full_speed_plus, gain * n.full_speed_minus))


def _changed(job: Job, world: World, change: Callable[[Any, Any], tuple[float, float, float]]) -> Any:
    """Change every valve: ``change`` maps drawn and nominal to dead time [s] (least: one step) and full speeds."""
    with trial_world(job.options["profile"], "nominal", job.seed) as middle:
        nominal = middle.truth
    functions = {}
    for name, function in world.truth.functions.items():
        valve = function.valve
        delay_s, plus, minus = change(valve, nominal.functions[name].valve)
        valve = msgspec.structs.replace(
            valve,
            delay_s=max(0.005, delay_s) if valve.delay_s else 0.0,
            full_speed_plus=plus,
            full_speed_minus=minus,
        )
        functions[name] = msgspec.structs.replace(function, valve=valve)
    return msgspec.structs.replace(world.truth, functions=functions)
