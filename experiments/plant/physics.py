"""The crane compared with closed-form solutions: sag, ringing, pressures, pendulum, pump sharing, cylinder spring.

Every function takes a Job (options: profile, truth, quick) and returns ``{"metrics": ..., "traces": ...}``; the plots
show the traces.  Sag and ringing are those of the true hanger pin; the controller is not involved.
"""

from __future__ import annotations

import math
from typing import Any, Final

import numpy as np
from msgspec.structs import replace

from experiments.common.pool import Job
from experiments.common.worlds import hang, home_at, mass_points, profile_named, step_neutral, trial_world
from experiments.plant.driver import Driver
from experiments.plant.signals import Ringing, ringing
from experiments.plant.trial import pick_logs
from sim.bullet.client import GRAVITY_M_S2
from sim.hydraulics.circuit import Hydraulics
from sim.wood.log_shape import LogSpec
from sim.world import STEP_S, World

SAG_REACH_M: Final = 6.0
SAG_LOADS_KG: Final = (0.0, 50.0, 100.0, 150.0, 200.0, 250.0)
PIN_HEIGHT_M: Final = 1.2
SLEW_LOG_YAW_RAD: Final = 0.4
STEPS_PER_SAMPLE: Final = 4  # physics steps between samples of a trace
BEYOND_LIFT: Final = ("boom", "stick", "telescope", "hanger", "fork", "rotator", "tong_left", "tong_right")
BEYOND_HANGER: Final = BEYOND_LIFT[3:]
BEYOND_FORK: Final = BEYOND_LIFT[4:]
Outcome = dict[str, Any]


def sag(job: Job) -> Outcome:
    """Hang 0 to 250 kg on the hook at 6 m with every spool closed: sag of the true tip and of the tip by encoders.

    The same run gives the holding pressure of the lift cylinder and the force required by statics.
    """
    o = job.options
    rows = []
    with trial_world(
        o["profile"], o["truth"], job.seed, home=home_at(o["profile"], SAG_REACH_M, PIN_HEIGHT_M)
    ) as world:
        load = 0.0
        for target in SAG_LOADS_KG:
            while load < target:
                load += 1.0
                hang(world, load)
                step_neutral(world, 10)
            step_neutral(world, round(3.0 / STEP_S))
            rows.append(_standing(world))
    first, last = rows[0], rows[-1]
    per_load = [
        {
            "load_kg": kg,
            "sag_m": (row["rigid_z"] - row["tip_z"]) - (first["rigid_z"] - first["tip_z"]),
            "encoder_drop_m": first["rigid_z"] - row["rigid_z"],
            "pressure_pa": row["pressure_pa"],
            "force_n": row["force_n"],
            "static_n": row["static_n"],
        }
        for kg, row in zip(SAG_LOADS_KG, rows, strict=True)
    ]
    error = max(abs(r["force_n"] / r["static_n"] - 1.0) for r in per_load)
    at_200 = next(r for r in per_load if r["load_kg"] == 200.0)
    return {
        "metrics": {
            "sag_250kg_6m_m": per_load[-1]["sag_m"],
            "sag_seen_by_encoders_m": per_load[-1]["encoder_drop_m"],
            "pressure_empty_pa": first["pressure_pa"],
            "pressure_200kg_pa": at_200["pressure_pa"],
            "pressure_rise_200kg": at_200["pressure_pa"] / first["pressure_pa"],
            "static_force_error": error,
            "chamber_min_pa": min(first["lowest_pa"], last["lowest_pa"]),
        },
        "traces": {"sag": per_load},
    }


def _standing(world: World) -> dict[str, float]:
    """Averages over one second at rest."""
    neutral = [0.0] * len(world.functions)
    lift = world.truth.functions["lift"].cylinder
    rows = []
    for _ in range(round(1.0 / STEP_S)):
        world.step(neutral)
        a, b = world.hydraulics.pressures_pa["lift"]
        lowest = min(min(pair) for pair in world.hydraulics.pressures_pa.values())
        rows.append((world.tip()[2], world.rigid_tip()[2], a, a * lift.area_a - b * lift.area_b, lowest))
    mean = [float(v) for v in np.mean(rows, axis=0)]
    arm = float(np.interp(world.q["lift"], lift.arm_at, lift.arm))
    return {
        "tip_z": mean[0],
        "rigid_z": mean[1],
        "pressure_pa": mean[2],
        "force_n": mean[3],
        "static_n": _lift_moment(world) / arm,
        "lowest_pa": min(r[4] for r in rows),
    }


def _lift_moment(world: World) -> float:
    """Moment of gravity about the boom pin [Nm], from the masses as they hang."""
    px, py, _ = world.link_poses()["boom"][0]
    cx, cy, _ = world.base_pose()[0]
    tip = world.link_poses()["hanger"][0]
    reach = math.hypot(tip[0] - cx, tip[1] - cy)
    ux, uy = (tip[0] - cx) / reach, (tip[1] - cy) / reach
    points = mass_points(world, BEYOND_LIFT)
    return sum(m * GRAVITY_M_S2 * ((x - px) * ux + (y - py) * uy) for m, (x, y, _) in points)


def boom_stop(job: Job) -> Outcome:
    """Raise the boom at 60 % of full spool, close the spool at once, and record the ringing of the tip."""
    o = job.options
    metrics: dict[str, float] = {}
    traces: dict[str, Any] = {}
    for name, kg in (("empty", 0.0), ("250kg", 250.0)):
        with trial_world(o["profile"], o["truth"], job.seed, home=home_at(o["profile"], 5.5, 0.4)) as world:
            hang(world, kg)
            step_neutral(world, round(3.0 / STEP_S))
            spools = [0.6 if f == "lift" else 0.0 for f in world.functions]
            heights = []
            for i in range(round(9.0 / STEP_S)):
                world.step(spools if i * STEP_S < 1.5 else [0.0] * len(spools))
                if i % STEPS_PER_SAMPLE == 0:
                    heights.append(world.tip()[2])
        after = heights[round(1.8 / STEP_S / STEPS_PER_SAMPLE) :]
        ring = ringing(after, STEP_S * STEPS_PER_SAMPLE, floor=5e-4)
        metrics |= {f"ring_hz_{name}": ring.hz, f"ring_zeta_{name}": ring.zeta, f"ring_pp_m_{name}": ring.peak_to_peak}
        traces[name] = [round(h, 6) for h in heights]
    metrics |= {"ring_hz": metrics["ring_hz_empty"], "ring_zeta": metrics["ring_zeta_empty"]}
    return {"metrics": metrics, "traces": {"boom_stop": traces, "boom_stop_step_s": STEP_S * STEPS_PER_SAMPLE}}


def pendulum(job: Job) -> Outcome:
    """Let the empty grapple swing freely about either hinge; compare with the compound pendulum.

    Period 2 pi sqrt(I / (m g d)) and damping ratio c / (2 I w) about the hinge, from the truth's masses.
    """
    o = job.options
    metrics: dict[str, float] = {}
    traces: dict[str, Any] = {}
    for hinge, links in (("hanger", BEYOND_HANGER), ("fork", BEYOND_FORK)):
        with trial_world(o["profile"], o["truth"], job.seed, home=home_at(o["profile"], 4.0, PIN_HEIGHT_M)) as world:
            step_neutral(world, round(1.0 / STEP_S))
            rest = world.q[hinge]
            theory_hz, inertia = compound(world, hinge, links)
            world.client.resetJointState(world.crane.body, world.crane.index[hinge], rest + 0.12, 0.0)
            angles = []
            for i in range(round(12.0 / STEP_S)):
                world.step([0.0] * len(world.functions))
                if i % STEPS_PER_SAMPLE == 0:
                    angles.append(world.q[hinge])
            swing = ringing(angles, STEP_S * STEPS_PER_SAMPLE, floor=2e-3)
            c = getattr(world.truth.structure, f"{hinge}_damping_nm_s_rad")
            zeta = c / (2.0 * inertia * 2.0 * math.pi * theory_hz)
        metrics |= _against(hinge, swing, theory_hz, zeta)
        traces[hinge] = {
            "angle_rad": [round(a - rest, 6) for a in angles], "hz": theory_hz, "zeta": zeta, "rest": 0.0
        }  # fmt: skip
    metrics["pendulum_period_error"] = max(metrics["hanger_period_error"], metrics["fork_period_error"])
    metrics["pendulum_damping_error"] = max(metrics["hanger_damping_error"], metrics["fork_damping_error"])
    return {"metrics": metrics, "traces": {"pendulum": traces, "pendulum_step_s": STEP_S * STEPS_PER_SAMPLE}}


def _against(name: str, seen: Ringing, hz: float, zeta: float) -> dict[str, float]:
    damped = hz * math.sqrt(1.0 - zeta * zeta)
    return {
        f"{name}_period_s": 1.0 / seen.hz,
        f"{name}_period_error": abs(damped / seen.hz - 1.0),
        f"{name}_damping_error": abs(seen.zeta / zeta - 1.0),
    }


def compound(world: World, hinge: str, links: tuple[str, ...], logs: tuple[int, ...] = ()) -> tuple[float, float]:
    """Natural frequency [Hz] and inertia [kg m^2] about a hinge of the parts below it in their present position."""
    p, body = world.client, world.crane.body
    state = p.getLinkState(body, world.crane.link[hinge], computeForwardKinematics=1)
    axis = np.array(p.getMatrixFromQuaternion(state[5])).reshape(3, 3) @ np.array(
        p.getJointInfo(body, world.crane.index[hinge])[13]
    )
    pivot = np.array(state[4])
    parts = []
    for name in links:
        index = world.crane.link[name]
        s, d = p.getLinkState(body, index, computeForwardKinematics=1), p.getDynamicsInfo(body, index)
        parts.append((d[0], d[2], s[0], s[1]))
    for log in logs:
        d, (position, turn) = p.getDynamicsInfo(log, -1), p.getBasePositionAndOrientation(log)
        parts.append((d[0], d[2], position, turn))
    inertia = moment = 0.0
    for mass, principal, com, turn in parts:
        r = np.array(com) - pivot
        local = np.array(p.getMatrixFromQuaternion(turn)).reshape(3, 3).T @ axis
        inertia += float(np.dot(local * local, principal) + mass * (r @ r - (r @ axis) ** 2))
        moment -= mass * GRAVITY_M_S2 * r[2]
    return math.sqrt(moment / inertia) / (2.0 * math.pi), inertia


def slew_stop(job: Job) -> Outcome:
    """Grasp a thick log, slew and stop: swing period across the reach against the compound pendulum with the log.

    The log is thick enough to be clamped; a thin one lies loose in the closed grapple and swings by itself.
    """
    o = job.options
    x, y = profile_named(o["profile"]).workspace.pick_center_m
    with trial_world(o["profile"], o["truth"], job.seed, (LogSpec(x, y, SLEW_LOG_YAW_RAD, 2.5, 0.30, 600.0),)) as world:
        driver = Driver(world)
        pick_logs(world, driver)
        driver.wait(3.0)
        held = tuple(b for b, t in zip(world.log_bodies.body_ids, world.touched(), strict=True) if t)
        theory_hz, _ = compound(world, "fork", BEYOND_FORK, held)
        spools = [0.45 if f == "slew" else -0.2 if f == "grapple" else 0.0 for f in world.functions]
        angles = []
        for i in range(round(13.0 / STEP_S)):
            if i * STEP_S >= 1.5:
                spools[world.functions.index("slew")] = 0.0
            world.step(spools)
            if i % STEPS_PER_SAMPLE == 0:
                angles.append(world.q["fork"])
        swing = ringing(angles[round(2.2 / STEP_S / STEPS_PER_SAMPLE) :], STEP_S * STEPS_PER_SAMPLE, floor=4e-3)
    return {
        "metrics": {
            "slew_pendulum_hz": swing.hz,
            "slew_pendulum_period_error": abs(theory_hz / swing.hz - 1.0),
            "slew_pendulum_rad": swing.peak_to_peak / 2.0,
            "slew_pendulum_zeta": swing.zeta,
        },
        "traces": {
            "slew_stop": [round(a, 6) for a in angles],
            "slew_stop_step_s": STEP_S * STEPS_PER_SAMPLE,
            "slew_stop_hz": theory_hz,
        },
    }


def sharing(job: Job) -> Outcome:
    """Full spool on each function alone, then on all of them together, which share the pump."""
    o = job.options
    home = home_at(o["profile"], 4.5, 0.4, 0.5)
    joints = profile_named(o["profile"]).joints
    # Away from the nearer end stop, so that no function reaches it.
    directions = {n: 1.0 if 2.0 * q < joints[n].lower + joints[n].upper else -1.0 for n, q in home.items()}

    def speeds(spools: dict[str, float]) -> tuple[dict[str, float], float]:
        with trial_world(o["profile"], o["truth"], job.seed, home=home) as world:
            commands = [spools.get(f, 0.0) for f in world.functions]
            start: dict[str, float] = {}
            limited = 0
            n = round(1.6 / STEP_S)
            for i in range(n):
                world.step(commands)
                if i == n // 2:
                    start = dict(world.q)
                limited += i > n // 2 and world.hydraulics.flow_limited
            seconds = (n - 1 - n // 2) * STEP_S
            return {f: (world.q[f] - start[f]) / seconds for f in spools}, limited / (n - 1 - n // 2)

    alone, limits = {}, {}
    for name, direction in directions.items():
        speed, limits[name] = speeds({name: direction})
        alone[name] = speed[name]
    together, limits["together"] = speeds(directions)
    shares = {name: together[name] / alone[name] for name in directions}
    return {
        "metrics": {
            **{f"alone_{n}": abs(v) for n, v in alone.items()},
            **{f"shared_{n}": v for n, v in shares.items()},
            "shared_mean": sum(shares.values()) / len(shares),
            "shared_limited": limits["together"],
        },
        "traces": {"sharing": {"alone": alone, "together": together}},
    }


def cylinder_spring(job: Job) -> Outcome:
    """The lift cylinder alone, spool shut, against an inertia on its joint: frequency of the oil spring.

    Friction and damping orifices are removed, so that only the oil remains.
    Closed form: w^2 = beta r^2 (AA^2 / VA + AB^2 / VB) / I.
    """
    o = job.options
    inertia, load_nm, q0 = 4000.0, 8000.0, 0.4
    with trial_world(o["profile"], o["truth"], job.seed) as world:
        truth = world.truth
        at = [world.jaw_angle_rad if f == "grapple" else world.q[f] for f in world.functions]
    i = world.functions.index("lift")
    lift = truth.functions["lift"]
    bare = replace(lift.cylinder, coulomb=0.0, stiction=0.0, viscous=0.0, relaxation_1_s=0.0)
    functions = {**truth.functions, "lift": replace(lift, cylinder=bare)}
    hydraulics = Hydraulics(replace(truth, functions=functions), STEP_S)
    at[i] = q0
    hydraulics.hold([load_nm if n == i else 0.0 for n in range(len(at))], at)
    c, oil = bare, truth.supply
    arm = float(np.interp(q0, c.arm_at, c.arm))
    grid = np.linspace(c.arm_at[0], c.arm_at[-1], 2001)
    arms = np.interp(grid, c.arm_at, c.arm)
    steps = (arms[1:] + arms[:-1]) / 2.0 * np.diff(grid)
    travel = float(steps[grid[1:] <= q0].sum())
    volume_a = c.dead_volume_m3 + c.area_a * travel
    volume_b = c.dead_volume_m3 + c.area_b * (float(steps.sum()) - travel)
    spring = oil.bulk_modulus_pa * arm**2 * (c.area_a**2 / volume_a + c.area_b**2 / volume_b)
    theory_hz = math.sqrt(spring / inertia) / (2.0 * math.pi)
    position, speed = q0, 0.02
    moving = [0.0] * len(at)
    trace = []
    for _ in range(round(3.0 / STEP_S)):
        at[i], moving[i] = position, speed
        torque = hydraulics.step([0.0] * len(at), at, moving)[i]
        speed += STEP_S * (torque - load_nm) / inertia
        position += STEP_S * speed
        trace.append(position - q0)
    ring = ringing(trace, STEP_S, floor=2e-5)
    return {
        "metrics": {
            "cylinder_hz": ring.hz,
            "cylinder_hz_error": abs(ring.hz / theory_hz - 1.0),
            "cylinder_zeta": ring.zeta,
        },
        "traces": {"cylinder": [float(f"{v:.4g}") for v in trace[:400]], "cylinder_hz": theory_hz},
    }
