"""Whose crane it is: an individual of the truth's spread, or one twice as far off, with a controller that knows its
valves as a calibration leaves them or as the profile assumes them.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import product
from typing import Any, Final

import msgspec

from experiments.common.pool import Job
from experiments.common.worlds import home_at, profile_named, trial_world
from experiments.joint_tracking.testbed import Calibration, Rig, controller_profile
from machine.geometry.kinematics import max_reach_m
from machine.loading.profile_file import load_profile
from sim.world import World

REACH_SHARE, HEIGHT_M = 0.55, 1.0
WIDE: Final = 2.0
"""Twice the spread of delay and gain that the truth states."""
CORNERS: Final = tuple(product((0, 1), (0, 1), (False, True)))
"""Corners of that: least or greatest delay, least or greatest gain, of all joints together; empty or loaded."""


def kind_of(job: Job) -> str:
    """The shipped machine that a profile is like."""
    return "palms_471" if profile_named(job.options["profile"]).carrier is None else "aoro_fc8"


class Machine:
    """A rig on a world of its own; closes it.  ``machine`` changes the truth of the individual."""

    def __init__(self, job: Job, machine: Callable[[Job, World], Any] | None = None) -> None:
        o = job.options
        profile = load_profile(o["profile"])
        home = home_at(o["profile"], REACH_SHARE * max_reach_m(profile), HEIGHT_M)
        with trial_world(o["profile"], o["truth"], job.seed) as world:
            truth = world.truth if machine is None else machine(job, world)
        self._world = world = World(profile, truth, job.seed, (), home=home)
        calibration = Calibration(job.seed) if o["calibrated"] else None
        made = controller_profile(profile, world, o["law"], calibration, o.get("damped", True))
        self._rig = Rig(made, world, job.seed)

    def __enter__(self) -> Rig:
        return self._rig

    def __exit__(self, *_: object) -> None:
        self._world.close()


def widened(job: Job, world: World) -> Any:
    """Twice as far from the middle of the spread in dead time, from the nominal one in gain."""
    middle_s = 0.5 * (world.truth.spread.delay_min_s + world.truth.spread.delay_max_s)

    def change(drawn: Any, nominal: Any) -> tuple[float, float, float]:
        plus, minus = (
            n + WIDE * (d - n)
            for d, n in ((drawn.full_speed_plus, nominal.full_speed_plus),
                         (drawn.full_speed_minus, nominal.full_speed_minus))
        )  # fmt: skip
        return middle_s + WIDE * (drawn.delay_s - middle_s), plus, minus

    return _changed(job, world, change)


def cornered(job: Job, world: World) -> Any:
    """All joints at the same bounds of twice the spread."""
    spread, (late, fast, _) = world.truth.spread, CORNERS[job.options["corner"]]
    middle_s, half_s = 0.5 * (spread.delay_max_s + spread.delay_min_s), 0.5 * (spread.delay_max_s - spread.delay_min_s)
    delay_s = middle_s + (WIDE if late else -WIDE) * half_s
    gain = 1.0 + (WIDE if fast else -WIDE) * spread.gain
    return _changed(job, world, lambda _, n: (delay_s, gain * n.full_speed_plus, gain * n.full_speed_minus))


def _changed(job: Job, world: World, change: Callable[[Any, Any], tuple[float, float, float]]) -> Any:
    """``change``: drawn and nominal valve to dead time [s], not below one physics step, and full speeds."""
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
