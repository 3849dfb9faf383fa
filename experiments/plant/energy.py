"""Energy balance: the undisturbed machine, falling logs, pump against lifted load; and logs at rest."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any, Final

import numpy as np

from experiments.common.pool import Job
from experiments.common.worlds import home_at, step_neutral, trial_world
from experiments.plant.driver import Driver
from experiments.plant.trial import pick_logs
from sim.bullet.client import GRAVITY_M_S2
from sim.world import STEP_S, World

STEPS_PER_SAMPLE: Final = 4
WINDOW_S: Final = 2.0  # longer than the slowest swing
RAISE_RAD: Final = 0.2
FALL_M: Final = 0.6
NOISE_J: Final = 0.05  # windows with less kinetic energy are at rest


def left_alone(job: Job) -> dict[str, Any]:
    """Slew, lift and extend at full spool, then close all spools: the peaks of the kinetic energy must decrease."""
    o = job.options
    with trial_world(o["profile"], o["truth"], job.seed, home=home_at(o["profile"], 4.5, 0.6, 0.5)) as world:
        spools = [{"slew": 1.0, "lift": 1.0, "ext": 1.0}.get(f, 0.0) for f in world.functions]
        for _ in range(round(1.5 / STEP_S)):
            world.step(spools)
        step_neutral(world, round(0.4 / STEP_S))
        kinetic = []
        for _ in range(round((8.0 if o["quick"] else 20.0) / STEP_S / STEPS_PER_SAMPLE)):
            step_neutral(world, STEPS_PER_SAMPLE)
            kinetic.append(machine_kinetic_j(world))
    n = round(WINDOW_S / STEP_S / STEPS_PER_SAMPLE)
    peaks = [max(kinetic[i : i + n]) for i in range(0, len(kinetic) - n + 1, n)]
    growth = max((b / a for a, b in pairwise(peaks) if b > NOISE_J), default=0.0)
    return {
        "metrics": {"kinetic_growth": growth, "kinetic_after_stop_j": peaks[0], "kinetic_last_j": peaks[-1]},
        "traces": {"kinetic_j": [float(f"{k:.4g}") for k in kinetic], "kinetic_step_s": STEP_S * STEPS_PER_SAMPLE},
    }


def machine_kinetic_j(world: World) -> float:
    """Kinetic energy [J] of all links of the machine."""
    p, body = world.client, world.crane.body
    total = 0.0
    count = p.getNumJoints(body)
    states = p.getLinkStates(body, list(range(count)), computeLinkVelocity=1)
    for i, s in enumerate(states):
        d = p.getDynamicsInfo(body, i)
        total += _kinetic(d[0], d[2], s[1], s[6], s[7], p)
    d, (linear, angular) = p.getDynamicsInfo(body, -1), p.getBaseVelocity(body)
    return total + _kinetic(d[0], d[2], p.getBasePositionAndOrientation(body)[1], linear, angular, p)


def _kinetic(mass: float, principal: Any, turn: Any, linear: Any, angular: Any, p: Any) -> float:
    v, w = np.array(linear), np.array(p.getMatrixFromQuaternion(turn)).reshape(3, 3).T @ np.array(angular)
    return 0.5 * (mass * float(v @ v) + float(np.dot(principal, w * w)))


def falling(job: Job) -> dict[str, Any]:
    """Drop a pile of logs: the sum of kinetic and potential energy may only decrease."""
    o = job.options
    with trial_world(o["profile"], o["truth"], job.seed, "pile", 4) as world:
        p = world.client
        world.log_bodies.wake()
        for log in world.log_bodies.body_ids:
            (x, y, z), turn = p.getBasePositionAndOrientation(log)
            p.resetBasePositionAndOrientation(log, (x, y, z + FALL_M), turn)
        lowest = _logs_energy(world) - FALL_M * GRAVITY_M_S2 * sum(world.log_bodies.masses)
        energy = [_logs_energy(world) - lowest]
        for _ in range(round(3.0 / STEP_S)):
            step_neutral(world, 1)
            energy.append(_logs_energy(world) - lowest)
    least = np.minimum.accumulate(energy)
    created = float(np.max(np.array(energy) - least))
    return {
        "metrics": {"falling_energy_created": created / energy[0], "falling_energy_left": energy[-1] / energy[0]},
        "traces": {"falling_j": [float(f"{e:.5g}") for e in energy[::2]], "falling_step_s": 2 * STEP_S},
    }


def _logs_energy(world: World) -> float:
    p = world.client
    total = 0.0
    for log in world.log_bodies.body_ids:
        d, (position, turn) = p.getDynamicsInfo(log, -1), p.getBasePositionAndOrientation(log)
        linear, angular = p.getBaseVelocity(log)
        total += _kinetic(d[0], d[2], turn, linear, angular, p) + d[0] * GRAVITY_M_S2 * position[2]
    return total


def lifting(job: Job) -> dict[str, Any]:
    """Raise a grasped log with the boom: pump energy against the potential energy gained by machine and log.

    Energy balance of the oil: pump = work on the joints + losses + energy stored in the chambers.
    """
    o = job.options
    with trial_world(o["profile"], o["truth"], job.seed, "single", 1) as world:
        driver = Driver(world)
        pick_logs(world, driver)
        driver.rest(2.0)
        oil = world.hydraulics
        before, pump, stored = _potential_j(world), oil.energy_j, oil.stored_j
        work, lost = oil.energy_out_j, oil.loss_j
        driver.move({"lift": driver.reference["lift"] + RAISE_RAD})
        driver.rest(2.0)
        gained, given = _potential_j(world) - before, oil.energy_j - pump
        spent = oil.energy_out_j - work + oil.loss_j - lost + oil.stored_j - stored
    return {
        "metrics": {
            "pump_energy_j": given,
            "potential_gain_j": gained,
            "lift_efficiency": gained / given,
            "oil_energy_balance": abs(spent / given - 1.0),
        }
    }


def _potential_j(world: World) -> float:
    p, body = world.client, world.crane.body
    total = 0.0
    for i, s in enumerate(p.getLinkStates(body, list(range(p.getNumJoints(body))), computeForwardKinematics=1)):
        total += p.getDynamicsInfo(body, i)[0] * GRAVITY_M_S2 * s[0][2]
    for log in world.log_bodies.body_ids:
        total += p.getDynamicsInfo(log, -1)[0] * GRAVITY_M_S2 * p.getBasePositionAndOrientation(log)[0][2]
    return total


def resting(job: Job) -> dict[str, Any]:
    """Undisturbed logs for one minute: woken, when they may fall asleep again, and then kept awake."""
    o = job.options
    metrics, traces = {}, {}
    with trial_world(o["profile"], o["truth"], job.seed, o["scene"], o["logs"]) as world:
        p, bodies = world.client, world.log_bodies
        bodies.wake()
        for name in ("", "awake_"):
            if name:
                for log in bodies.body_ids:
                    p.changeDynamics(log, -1, activationState=p.ACTIVATION_STATE_DISABLE_SLEEPING)
            start, trace = [log.position_m for log in bodies.states()], []
            for _ in range(round((6.0 if o["quick"] else 60.0) / STEP_S / STEPS_PER_SAMPLE)):
                step_neutral(world, STEPS_PER_SAMPLE)
                trace.append(max(log.speed_m_s for log in bodies.states()))
            metrics[f"{name}fastest_m_s"] = max(trace)
            metrics[f"{name}moved_m"] = max(
                math.dist(a, log.position_m) for a, log in zip(start, bodies.states(), strict=True)
            )
            traces[f"{name}speed_m_s"] = [float(f"{v:.4g}") for v in trace[::25]]
    return {"metrics": metrics, "traces": {**traces, "step_s": 25 * STEPS_PER_SAMPLE * STEP_S}}
