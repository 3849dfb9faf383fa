"""The carrier compared with closed-form solutions: turning radius, weight on the wheels, swing after braking.

Options as in ``physics``; the profile is one with a carrier.
"""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any, Final

import numpy as np

from experiments.common.pool import Job
from experiments.common.worlds import trial_world
from machine.geometry.carrier import turning_radius_m
from sim.bullet.client import GRAVITY_M_S2
from sim.mechanics.carrier import PARKED, Drive
from sim.world import STEP_S, World

STEPS_PER_SAMPLE: Final = 20
STEER_KP_1_S: Final = 2.5
SHARES: Final = (0.5, 1.0)  # of the articulation's limit
TURN_M: Final = 16.0


def _steer(world: World, target_rad: float) -> list[float]:
    """Spools that bring the articulation to an angle, all others closed."""
    carrier = world.profile.carrier
    assert carrier is not None
    valve = carrier.steer_valve
    speed = STEER_KP_1_S * (target_rad - world.q["articulation"])
    full = valve.full_speed_plus if speed > 0.0 else valve.full_speed_minus
    band = (valve.deadband_plus_pct if speed > 0.0 else valve.deadband_minus_pct) / 100.0
    share = min(1.0, abs(speed) / full)
    spool = 0.0 if share < 0.01 else math.copysign(band + (1.0 - band) * share, speed)
    return [spool if f == "steer" else 0.0 for f in world.functions]


def turning(job: Job) -> dict[str, Any]:
    """Drive at the cruising speed with the articulation held; fit a circle to the path of the front axle's middle.

    Closed form (docs/reference/machines.md section 7.1): R = (lf cos g + lr) / sin g, heading per metre 1 / R.
    """
    o = job.options
    metrics: dict[str, float] = {}
    traces = []
    errors = []
    with trial_world(o["profile"], o["truth"], job.seed) as world:
        spec, carrier = world.profile.carrier, world.carrier
        assert spec is not None and carrier is not None
        drive = Drive(spec.cruise_speed_m_s)
        for share in SHARES:
            target = share * spec.articulation_limit_rad
            for _ in range(round(5.0 / STEP_S)):
                world.step(_steer(world, target), drive)
            path, headings, angles = [], [], []
            length_m = TURN_M / 4 if o["quick"] else TURN_M
            for i in range(round(length_m / spec.cruise_speed_m_s / STEP_S)):
                world.step(_steer(world, target), drive)
                if i % STEPS_PER_SAMPLE == 0:
                    path.append(carrier.front_axle()[:2])
                    headings.append(carrier.heading_rad)
                    angles.append(world.q["articulation"])
            centre, radius = fit_circle(path)
            angle = sum(angles) / len(angles)
            theory = turning_radius_m(spec, angle)
            run = sum(math.dist(a, b) for a, b in pairwise(path))
            turned = sum(math.remainder(b - a, 2 * math.pi) for a, b in pairwise(headings))
            per_m = turned / run
            errors += [abs(radius / theory - 1.0), abs(abs(per_m) * theory - 1.0)]
            traces.append({"path": path[::4], "centre": centre, "radius": theory, "articulation_rad": angle})
            metrics |= {"turn_radius_m": radius, "turn_deg_m": math.degrees(abs(per_m)), "turn_speed_m_s": run / (
                (len(path) - 1) * STEPS_PER_SAMPLE * STEP_S
            )}  # fmt: skip
    metrics["turn_radius_error"] = max(errors)
    return {"metrics": metrics, "traces": {"turning": traces}}


def fit_circle(path: list[tuple[float, float]]) -> tuple[tuple[float, float], float]:
    """Centre and radius of the circle nearest to the points (linear least squares)."""
    xy = np.array(path)
    middle = xy.mean(axis=0)
    a = np.column_stack([2 * (xy - middle), np.ones(len(xy))])
    x, y, c = np.linalg.lstsq(a, ((xy - middle) ** 2).sum(axis=1), rcond=None)[0]
    return (float(x + middle[0]), float(y + middle[1])), math.sqrt(c + x * x + y * y)


def braking(job: Job) -> dict[str, Any]:
    """Rest, then drive straight and brake: weight on the wheels, stopping distance, swing of the empty grapple."""
    o = job.options
    with trial_world(o["profile"], o["truth"], job.seed) as world:
        spec, carrier = world.profile.carrier, world.carrier
        assert spec is not None and carrier is not None
        p, body, neutral = world.client, world.crane.body, [0.0] * len(world.functions)
        for _ in range(round(4.0 / STEP_S)):
            world.step(neutral, PARKED)
        mass = sum(p.getDynamicsInfo(body, i)[0] for i in range(-1, p.getNumJoints(body)))
        loads = sum(world.wheel_loads_n())
        start = carrier.front_axle()
        for _ in range(round((2.0 if o["quick"] else 10.0) / STEP_S)):
            world.step(neutral, PARKED)
        crept = math.dist(start, carrier.front_axle())
        hang, speeds = [], []
        stop = 6.0
        for i in range(round(14.0 / STEP_S)):
            rolling = i * STEP_S < stop
            world.step(neutral, Drive(spec.cruise_speed_m_s) if rolling else PARKED)
            if i % STEPS_PER_SAMPLE == 0:
                pin, grapple = world.link_poses()["hanger"][0], world.link_poses()["rotator"][0]
                hang.append(math.atan2(math.dist(pin[:2], grapple[:2]), pin[2] - grapple[2]))
                speeds.append(carrier.speed_m_s)
        at = round(stop / STEP_S / STEPS_PER_SAMPLE)
    return {
        "metrics": {
            "weight_error": abs(loads / (mass * GRAVITY_M_S2) - 1.0),
            "parked_creep_m": crept,
            "cruise_speed_error": abs(speeds[at - 1] / spec.cruise_speed_m_s - 1.0),
            "brake_swing_rad": max(hang[at:]),
            "cruise_swing_rad": max(hang[at - round(1.0 / STEP_S / STEPS_PER_SAMPLE) : at]),
        },
        "traces": {"braking": {"hang_rad": hang, "speed_m_s": speeds, "step_s": STEP_S * STEPS_PER_SAMPLE}},
    }
