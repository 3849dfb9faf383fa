"""One grasp trial: new logs, an aim with noise, pick, optionally unload into the bunk; by the plant's ground truth."""

from __future__ import annotations

import math
import random
from collections.abc import Sequence
from typing import Any, Final

from experiments.common.pool import Job
from experiments.common.worlds import to_base, trial_world, yaw_in_base
from experiments.plant.driver import Driver
from machine.geometry.grapple import lowest_tip_below_pin_m
from machine.geometry.kinematics import Unreachable
from sim.evaluator import LIFTED_M, Evaluator
from sim.wood.bunk import from_bunk
from sim.wood.logs import LogState
from sim.world import STEP_S, World

AIM_M: Final = 0.04
AIM_RAD: Final = math.radians(4.0)
HOVER_M: Final = 0.5  # tips over the ground before the descent
LIFT_HEIGHT_M: Final = 1.0  # tips over the ground after the lift: higher than the criterion for a lifted log
WEIGH_S: Final = 0.5
UNLOADED_S: Final = 20  # a crooked log may rock this long
OVER_STAKES_M: Final = 0.15
OVER_FLOOR_M: Final = 0.05


def grasp(job: Job) -> dict[str, Any]:
    """Options: profile, truth, scene, logs, across_m, turned_rad, unload.

    ``held``: logs half a metre and more off the ground a second after the lift; ``raised``: logs that ever were;
    ``in_bunk``: logs at rest in the bunk after unloading.
    """
    o = job.options
    with trial_world(o["profile"], o["truth"], job.seed, o["scene"], o["logs"]) as world:
        evaluator, fastest = Evaluator(world), TopSpeed(world)

        def watch() -> None:
            evaluator.watch()
            fastest.watch()

        driver = Driver(world, watch)
        rng = random.Random(f"aim {job.seed}")
        high = over_stakes_m(world) if o["unload"] else None
        pick_logs(world, driver, rng, o["across_m"], o["turned_rad"], high)
        weighed = []
        for _ in range(round(WEIGH_S / STEP_S)):
            driver.tick({})
            weighed.append(world.load_kg())
        after = evaluator.evaluate()
        # This includes the top log of a pile, which the grapple does not touch.
        held = [
            log.position_m[2] - world.terrain.height(*log.position_m[:2]) > LIFTED_M
            for log in world.log_bodies.states()
        ]
        outcome: dict[str, Any] = {
            "held": sum(held),
            "raised": sum(v.lifted or h for v, h in zip(after.logs, held, strict=True)),
            "load_kg": sum(weighed) / len(weighed),
            "true_load_kg": sum(m for m, h in zip(world.log_bodies.masses, held, strict=True) if h),
        }
        if o["unload"] and any(held):
            hanging = [log for log, h in zip(world.log_bodies.states(), held, strict=True) if h]
            unload(world, driver, hanging)
            for _ in range(UNLOADED_S):
                driver.wait(1.0)
                evaluation = evaluator.evaluate()
                if all(v.at_rest for v in evaluation.logs):
                    break
            outcome["in_bunk"] = sum(v.done for v, h in zip(evaluation.logs, held, strict=True) if h)
        last = evaluator.evaluate()
        outcome |= {
            "penetration_m": last.max_penetration_m,
            "log_speed_m_s": fastest.m_s,
            "peak_bar": last.peak_pressure_bar,
            "energy_j": last.energy_j,
            "time_s": last.time_s,
        }
        return outcome


class TopSpeed:
    """Highest speed of the middle or an end of a log so far [m/s]; the evaluator's own value is an upper bound."""

    def __init__(self, world: World) -> None:
        self._world, self._steps, self.m_s = world, 0, 0.0

    def watch(self) -> None:
        """Sample the speeds; called in every physics step, evaluates every fourth."""
        self._steps += 1
        if self._steps % 4:
            return
        p, bodies = self._world.client, self._world.log_bodies
        for body, spec in zip(bodies.body_ids, bodies.scene, strict=True):
            v, w = p.getBaseVelocity(body)
            if v == w == (0.0, 0.0, 0.0):
                continue
            m = p.getMatrixFromQuaternion(p.getBasePositionAndOrientation(body)[1])
            half = [spec.length_m / 2.0 * a for a in (m[2], m[5], m[8])]
            turn = (w[1] * half[2] - w[2] * half[1], w[2] * half[0] - w[0] * half[2], w[0] * half[1] - w[1] * half[0])
            for side in (-1.0, 0.0, 1.0):
                self.m_s = max(self.m_s, math.hypot(*(a + side * b for a, b in zip(v, turn, strict=True))))


def pick_logs(
    world: World,
    driver: Driver,
    rng: random.Random | None = None,
    across_m: float = 0.0,
    turned_rad: float = 0.0,
    lift_to_m: float | None = None,
    logs: Sequence[LogState] | None = None,
) -> None:
    """Grasp at the middle of the logs (default: all) and lift.

    The aim is off by ``across_m``, ``turned_rad`` and the noise of ``rng`` (None: no noise).
    """
    tips = lowest_tip_below_pin_m(world.profile.grapple.jaws)
    x, y, yaw, ground = _aim(world, driver, rng, across_m, logs or world.log_bodies.states())
    top = ground + LIFT_HEIGHT_M + tips if lift_to_m is None else lift_to_m
    driver.pick(x, y, yaw + turned_rad, ground + HOVER_M + tips, ground, top)


def over_stakes_m(world: World) -> float:
    """Height of the pin [m] at which a load clears the stakes."""
    bunk = world.profile.bunk
    return bunk.floor_z_m + bunk.stake_height_m + OVER_STAKES_M + lowest_tip_below_pin_m(world.profile.grapple.jaws)


def unload(world: World, driver: Driver, logs: Sequence[LogState]) -> None:
    """Lay the logs that hang in the grapple lengthwise into the middle of the bunk.

    Like an operator, it uses one view of how they hang: a thin log may lie askew in the closed grapple.
    """
    bunk = world.profile.bunk
    x, y, yaw = _middle(world, logs)
    pin = world.rigid_tip()
    turn = bunk.yaw_rad - yaw
    turn -= math.pi * round(turn / math.pi)
    c, s = math.cos(turn), math.sin(turn)
    off_x, off_y = c * (x - pin[0]) - s * (y - pin[1]), s * (x - pin[0]) + c * (y - pin[1])
    over_x, over_y, _ = from_bunk(bunk, (0.0, 0.0, 0.0))
    floor = bunk.floor_z_m + OVER_FLOOR_M
    driver.place(over_x - off_x, over_y - off_y, driver.log_yaw() + turn, floor, over_stakes_m(world))


def _middle(world: World, logs: Sequence[LogState]) -> tuple[float, float, float]:
    """Middle (x, y) [m] and direction [rad] of logs in the base frame."""
    centre = [sum(log.position_m[i] for log in logs) / len(logs) for i in range(3)]
    x, y, _ = to_base(world, centre)
    # An axis is defined modulo pi: average the doubled angles.
    doubled = [2.0 * yaw_in_base(world, log.axis) for log in logs]
    return x, y, math.atan2(sum(map(math.sin, doubled)), sum(map(math.cos, doubled))) / 2.0


def _aim(
    world: World, driver: Driver, rng: random.Random | None, across_m: float, logs: Sequence[LogState]
) -> tuple[float, float, float, float]:
    """Grasp target in the base frame with noise: x, y, direction of the logs, height of the ground.

    Raises:
        Unreachable: the crane reaches neither side of the logs.
    """
    x, y, yaw = _middle(world, logs)
    spot = [sum(log.position_m[i] for log in logs) / len(logs) for i in range(2)]
    ground = to_base(world, (*spot, world.terrain.height(*spot)))[2]
    noise, side = (0.0, 0.0, 0.0), across_m
    if rng is not None:
        noise = (rng.gauss(0.0, AIM_M), rng.gauss(0.0, AIM_M), rng.gauss(0.0, AIM_RAD))
        side *= rng.choice((-1.0, 1.0))
    tips = lowest_tip_below_pin_m(world.profile.grapple.jaws)
    for offset in (side, -side):
        at = (x - offset * math.sin(yaw) + noise[0], y + offset * math.cos(yaw) + noise[1])
        try:
            driver.extension_for(*at, ground + tips, ground + LIFT_HEIGHT_M + tips)
        except Unreachable:
            continue
        return (*at, yaw + noise[2], ground)
    raise Unreachable(
        f"the grasp target ({x:.2f}, {y:.2f}) m is out of reach; narrow the pick area of the profile",
        "experiment.target-out-of-reach",
    )
