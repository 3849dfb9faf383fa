"""Single runs of the plant: sag, stops, swings, the shared pump, driving, energy, and an hour of continuous work.

A run takes a Job (options: profile, truth, quick) and returns ``{"metrics": ..., "traces": ...}``; the plots show the
traces, sampled every `SAMPLE_S`.  The controller is not involved.  The closed forms of the same motions are tests of
``sim``.
"""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from itertools import chain, pairwise
from pathlib import Path
from typing import Any, Final, NamedTuple, TypeVar

import numpy as np
from msgspec.structs import replace

from experiments.common.pool import Job
from experiments.common.worlds import hang, home_at, profile_named, step_neutral, trial_world
from experiments.plant.grasps import DRIVEN, Driver, pick_logs
from machine.geometry.grapple import lowest_tip_below_pin_m, tip_below_pin_m
from machine.geometry.kinematics import Unreachable
from sim.bullet.client import GRAVITY_M_S2
from sim.hydraulics.circuit import Hydraulics
from sim.mechanics.carrier import PARKED, Drive
from sim.nodes.mach0 import spool_for
from sim.wood.log_shape import LogSpec
from sim.world import STEP_S, World

SAMPLE_STEPS: Final = 4
SAMPLE_S: Final = SAMPLE_STEPS * STEP_S
SAG_REACH_M: Final = 6.0
SAG_LOADS_KG: Final = (0.0, 50.0, 100.0, 150.0, 200.0, 250.0)
PIN_HEIGHT_M: Final = 1.2
SLEW_LOG_YAW_RAD: Final = 0.4
FALL_M: Final = 0.6
STEER_KP_1_S: Final = 2.5
TURN_M: Final = 16.0
PAGE_BYTES: Final = 4096
WARM_CYCLES: Final = 3  # cycles before memory and drift are compared
LAY_DOWN_M: Final = 0.06
Outcome = dict[str, Any]
_Value = TypeVar("_Value")


class Ringing(NamedTuple):
    """Frequency [Hz], damping ratio, first peak-to-peak value in the unit of the signal, number of half swings."""

    hz: float
    zeta: float
    peak_to_peak: float
    half_swings: int


def ringing(values: Sequence[float], step_s: float, floor: float, rest: float | None = None) -> Ringing:
    """Evaluate the oscillation of ``values`` about ``rest`` (default: the mean of the last quarter).

    Half swings smaller than ``floor`` and all later ones are ignored.  Fewer than three half swings: all NaN.
    """
    tail = values[3 * len(values) // 4 :]
    middle = sum(tail) / len(tail) if rest is None else rest
    y = [v - middle for v in values]
    crossings = [i + a / (a - b) for i, (a, b) in enumerate(pairwise(y)) if (a < 0.0) != (b < 0.0)]
    peaks: list[float] = []
    for start, end in pairwise(crossings):
        peak = max(abs(v) for v in y[math.ceil(start) : math.floor(end) + 1])
        if peak < floor:
            break
        peaks.append(peak)
    n = len(peaks)
    if n < 3:
        return Ringing(math.nan, math.nan, math.nan, n)
    half_s = (crossings[n] - crossings[0]) / n * step_s
    decrement = -float(np.polyfit(range(n), np.log(peaks), 1)[0])  # per half swing: pi zeta / sqrt(1 - zeta^2)
    return Ringing(0.5 / half_s, decrement / math.hypot(math.pi, decrement), peaks[0] + peaks[1], n)


def _world(
    job: Job, scene: str | Sequence[LogSpec] = (), logs: int = 1, home: dict[str, float] | None = None
) -> AbstractContextManager[World]:
    return trial_world(job.options["profile"], job.options["truth"], job.seed, scene, logs, home)


def record(
    world: World, seconds: float, read: Callable[[], _Value], spools: Mapping[str, float] | None = None
) -> list[_Value]:
    """Record what ``read`` returns every `SAMPLE_S` while these spools are open and all others closed."""
    commands = [(spools or {}).get(f, 0.0) for f in world.functions]
    rows = []
    for i in range(round(seconds / STEP_S)):
        world.step(commands)
        if i % SAMPLE_STEPS == 0:
            rows.append(read())
    return rows


def sag(job: Job) -> Outcome:
    """Hang 0 to 250 kg on the hook at 6 m with every spool closed: true tip, tip by encoders, lift cylinder."""
    rows, load = [], 0.0
    with _world(job, home=home_at(job.options["profile"], SAG_REACH_M, PIN_HEIGHT_M)) as world:

        def read() -> tuple[float, float, float]:
            return world.tip()[2], world.rigid_tip()[2], world.hydraulics.pressures_pa["lift"][0]

        for target in SAG_LOADS_KG:
            while load < target:
                load += 1.0
                hang(world, load)
                step_neutral(world, 10)
            step_neutral(world, round(3.0 / STEP_S))
            rows.append([float(v) for v in np.mean(record(world, 1.0, read), axis=0)])
    tip_z, rigid_z, empty_pa = rows[0]
    per_load = [
        {
            "load_kg": kg,
            "sag_m": (rigid - tip) - (rigid_z - tip_z),
            "encoder_drop_m": rigid_z - rigid,
            "pressure_pa": pa,
        }
        for kg, (tip, rigid, pa) in zip(SAG_LOADS_KG, rows, strict=True)
    ]
    at_200_pa = rows[SAG_LOADS_KG.index(200.0)][2]
    metrics = {
        "sag_250kg_6m_m": per_load[-1]["sag_m"],
        "sag_seen_by_encoders_m": per_load[-1]["encoder_drop_m"],
        "pressure_empty_pa": empty_pa,
        "pressure_200kg_pa": at_200_pa,
        "pressure_rise_200kg": at_200_pa / empty_pa,
    }
    return {"metrics": metrics, "traces": {"sag": per_load}}


def boom_stop(job: Job) -> Outcome:
    """Raise the boom at 60 % of full spool, close the spool at once, and record the ringing of the tip."""
    metrics: dict[str, float] = {}
    traces: dict[str, Any] = {}
    for name, kg in (("empty", 0.0), ("250kg", 250.0)):
        with _world(job, home=home_at(job.options["profile"], 5.5, 0.4)) as world:
            hang(world, kg)
            step_neutral(world, round(3.0 / STEP_S))
            heights = record(world, 1.5, lambda: world.tip()[2], {"lift": 0.6})
            heights += record(world, 7.5, lambda: world.tip()[2])
        ring = ringing(heights[round(1.8 / SAMPLE_S) :], SAMPLE_S, floor=5e-4)
        metrics |= {f"ring_hz_{name}": ring.hz, f"ring_zeta_{name}": ring.zeta, f"ring_pp_m_{name}": ring.peak_to_peak}
        traces[name] = [round(h, 6) for h in heights]
    metrics |= {"ring_hz": metrics["ring_hz_empty"], "ring_zeta": metrics["ring_zeta_empty"]}
    return {"metrics": metrics, "traces": {"boom_stop": traces}}


def pendulum(job: Job) -> Outcome:
    """Let the empty grapple swing freely about either hinge."""
    traces = {}
    for hinge in ("hanger", "fork"):
        with _world(job, home=home_at(job.options["profile"], 4.0, PIN_HEIGHT_M)) as world:
            step_neutral(world, round(1.0 / STEP_S))
            traces[hinge] = [round(a, 6) for a in released(world, hinge)]
    swings = {name: ringing(angles, SAMPLE_S, floor=2e-3) for name, angles in traces.items()}
    metrics = {f"{name}_period_s": 1.0 / swing.hz for name, swing in swings.items()}
    metrics |= {f"{name}_zeta": swing.zeta for name, swing in swings.items()}
    return {"metrics": metrics, "traces": {"pendulum": traces}}


def released(world: World, hinge: str) -> list[float]:
    """Record the angle from rest [rad] of a hinge of the hanging grapple after its release at 0.12 rad."""
    rest = world.q[hinge]
    world.client.resetJointState(world.crane.body, world.crane.index[hinge], rest + 0.12, 0.0)
    return record(world, 12.0, lambda: world.q[hinge] - rest)


def slew_stop(job: Job) -> Outcome:
    """Grasp a thick log, slew and stop: the swing across the reach.

    The log is thick enough to be clamped; a thin one lies loose in the closed grapple and swings by itself.
    """
    x, y = profile_named(job.options["profile"]).workspace.pick_center_m
    with _world(job, (LogSpec(x, y, SLEW_LOG_YAW_RAD, 2.5, 0.30, 600.0),)) as world:
        driver = Driver(world)
        pick_logs(world, driver)
        driver.wait(3.0)
        angles, swing = stopped(world)
    metrics = {
        "slew_pendulum_hz": swing.hz,
        "slew_pendulum_rad": swing.peak_to_peak / 2.0,
        "slew_pendulum_zeta": swing.zeta,
    }
    return {"metrics": metrics, "traces": {"slew_stop": [round(a, 6) for a in angles]}}


def stopped(world: World) -> tuple[list[float], Ringing]:
    """Record the angle of the fork's hinge [rad] while the crane slews with a load and after its stop at 1.5 s; the
    swing then.
    """
    grip = {"grapple": -0.2}
    angles = record(world, 1.5, lambda: world.q["fork"], {"slew": 0.45, **grip})
    angles += record(world, 11.5, lambda: world.q["fork"], grip)
    return angles, ringing(angles[round(2.2 / SAMPLE_S) :], SAMPLE_S, floor=4e-3)


def sharing(job: Job) -> Outcome:
    """Open every spool fully, each function alone, then all of them together, which share the pump."""
    home = home_at(job.options["profile"], 4.5, 0.4, 0.5)
    joints = profile_named(job.options["profile"]).joints
    # Away from the nearer end stop, so that no function reaches it.
    directions = {n: 1.0 if 2.0 * q < joints[n].lower + joints[n].upper else -1.0 for n, q in home.items()}

    def speeds(spools: dict[str, float]) -> tuple[dict[str, float], float]:
        with _world(job, home=home) as world:
            record(world, 0.8, lambda: None, spools)
            start = dict(world.q)
            limited = record(world, 0.8, lambda: world.hydraulics.flow_limited, spools)
            return {f: (world.q[f] - start[f]) / 0.8 for f in spools}, sum(limited) / len(limited)

    alone = {name: speeds({name: direction})[0][name] for name, direction in directions.items()}
    together, limited = speeds(directions)
    shares = {name: together[name] / alone[name] for name in directions}
    metrics = {f"alone_{n}": abs(v) for n, v in alone.items()} | {f"shared_{n}": v for n, v in shares.items()}
    metrics |= {"shared_mean": sum(shares.values()) / len(shares), "shared_limited": limited}
    return {"metrics": metrics, "traces": {"sharing": {"alone": alone, "together": together}}}


def cylinder(job: Job) -> Outcome:
    """Let the lift cylinder ring, its spool shut, without friction and orifices, against 4000 kg m^2 and 8 kNm.

    Trace: angle from rest [rad] at every physics step.
    """
    inertia_kg_m2, load_nm, q0 = 4000.0, 8000.0, 0.4
    with _world(job) as world:
        truth, i = world.truth, world.functions.index("lift")
        at = [world.jaw_angle_rad if f == "grapple" else world.q[f] for f in world.functions]
    lift = truth.functions["lift"]
    bare = replace(lift.cylinder, coulomb=0.0, stiction=0.0, viscous=0.0, relaxation_1_s=0.0)
    functions = {**truth.functions, "lift": replace(lift, cylinder=bare)}
    oil, closed, moving = Hydraulics(replace(truth, functions=functions), STEP_S), [0.0] * len(at), [0.0] * len(at)
    at[i], moving[i] = q0, 0.02
    oil.hold([load_nm if n == i else 0.0 for n in range(len(at))], at)
    trace = []
    for _ in range(round(3.0 / STEP_S)):
        moving[i] += STEP_S * (oil.step(closed, at, moving)[i] - load_nm) / inertia_kg_m2
        at[i] += STEP_S * moving[i]
        trace.append(at[i] - q0)
    return {"metrics": {"cylinder_hz": ringing(trace, STEP_S, floor=2e-5).hz}, "traces": {"cylinder": trace}}


def turning(job: Job) -> Outcome:
    """Drive at the cruising speed with the articulation held at half and at its limit: path of the front axle."""
    metrics: dict[str, float] = {}
    traces = []
    with _world(job) as world:
        spec, carrier = world.profile.carrier, world.carrier
        assert spec is not None and carrier is not None
        drive = Drive(spec.cruise_speed_m_s)
        length_m = TURN_M / 4 if job.options["quick"] else TURN_M
        for target in (0.5 * spec.articulation_limit_rad, spec.articulation_limit_rad):
            path, headings = [], []
            for i in range(round((5.0 + length_m / spec.cruise_speed_m_s) / STEP_S)):
                world.step(_steer(world, target), drive)
                if i * STEP_S >= 5.0 and i % (5 * SAMPLE_STEPS) == 0:
                    path.append(carrier.front_axle()[:2])
                    headings.append(carrier.heading_rad)
            run_m = sum(math.dist(a, b) for a, b in pairwise(path))
            turned = sum(math.remainder(b - a, 2 * math.pi) for a, b in pairwise(headings))
            metrics = {"turn_radius_m": run_m / turned, "turn_deg_m": math.degrees(turned) / run_m}
            traces.append({"path": path, "articulation_rad": world.q["articulation"], "radius_m": run_m / turned})
    return {"metrics": metrics, "traces": {"turning": traces}}


def _steer(world: World, target_rad: float) -> list[float]:
    """Compute the spools that bring the articulation to an angle, all others closed."""
    carrier = world.profile.carrier
    assert carrier is not None
    spool = spool_for(carrier.steer_valve, STEER_KP_1_S * (target_rad - world.q["articulation"]))
    return [spool if f == "steer" else 0.0 for f in world.functions]


def braking(job: Job) -> Outcome:
    """Drive straight for six seconds and brake: swing of the empty grapple."""
    hang_rad, speed_m_s = [], []
    with _world(job) as world:
        spec, carrier = world.profile.carrier, world.carrier
        assert spec is not None and carrier is not None
        neutral = [0.0] * len(world.functions)
        step_neutral(world, round(4.0 / STEP_S))
        for i in range(round(14.0 / STEP_S)):
            world.step(neutral, Drive(spec.cruise_speed_m_s) if i * STEP_S < 6.0 else PARKED)
            if i % SAMPLE_STEPS == 0:
                pin, grapple = world.link_poses()["hanger"][0], world.link_poses()["rotator"][0]
                hang_rad.append(math.atan2(math.dist(pin[:2], grapple[:2]), pin[2] - grapple[2]))
                speed_m_s.append(carrier.speed_m_s)
    at = round(6.0 / SAMPLE_S)
    metrics = {
        "brake_swing_rad": max(hang_rad[at:]),
        "cruise_swing_rad": max(hang_rad[at - round(1.0 / SAMPLE_S) : at]),
    }
    return {"metrics": metrics, "traces": {"braking": {"hang_rad": hang_rad, "speed_m_s": speed_m_s}}}


def left_alone(job: Job) -> Outcome:
    """Slew, lift and extend at full spool, then close all spools: kinetic energy of the machine [J]."""
    with _world(job, home=home_at(job.options["profile"], 4.5, 0.6, 0.5)) as world:
        record(world, 1.5, lambda: None, {"slew": 1.0, "lift": 1.0, "ext": 1.0})
        step_neutral(world, round(0.4 / STEP_S))
        joules = record(world, 8.0 if job.options["quick"] else 20.0, lambda: machine_energy_j(world)[0])
    return {"metrics": {}, "traces": {"kinetic_j": [float(f"{k:.4g}") for k in joules]}}


def falling(job: Job) -> Outcome:
    """Drop a pile of logs: their kinetic plus potential energy [J] above where they lay, at every physics step."""
    with _world(job, "pile", 4) as world:
        p = world.client
        lowest = sum(logs_energy_j(world))
        world.log_bodies.wake()
        for log in world.log_bodies.body_ids:
            (x, y, z), turn = p.getBasePositionAndOrientation(log)
            p.resetBasePositionAndOrientation(log, (x, y, z + FALL_M), turn)
        joules = []
        for _ in range(round(3.0 / STEP_S)):
            joules.append(sum(logs_energy_j(world)) - lowest)
            step_neutral(world, 1)
    return {"metrics": {}, "traces": {"falling_j": [float(f"{e:.5g}") for e in joules]}}


def machine_energy_j(world: World) -> tuple[float, float]:
    """Compute the kinetic and potential energy of all links of the machine."""
    p, body = world.client, world.crane.body
    links = range(p.getNumJoints(body))
    states = p.getLinkStates(body, list(links), computeLinkVelocity=1, computeForwardKinematics=1)
    bodies = [(p.getDynamicsInfo(body, i), s[0], s[1], s[6], s[7]) for i, s in zip(links, states, strict=True)]
    base = (p.getDynamicsInfo(body, -1), *p.getBasePositionAndOrientation(body), *p.getBaseVelocity(body))
    return _energy_j(p, [*bodies, base])


def logs_energy_j(world: World) -> tuple[float, float]:
    """Compute the kinetic and potential energy of all logs."""
    p, logs = world.client, world.log_bodies.body_ids
    return _energy_j(
        p, [(p.getDynamicsInfo(i, -1), *p.getBasePositionAndOrientation(i), *p.getBaseVelocity(i)) for i in logs]
    )


def _energy_j(p: Any, bodies: Sequence[tuple[Any, ...]]) -> tuple[float, float]:
    """Compute kinetic and potential energy of bodies: dynamics, position, orientation, linear and angular velocity."""
    kinetic = potential = 0.0
    for (mass, _, principal, *_), position, turn, linear, angular in bodies:
        w = np.array(p.getMatrixFromQuaternion(turn)).reshape(3, 3).T @ np.array(angular)
        kinetic += 0.5 * (mass * float(np.dot(linear, linear)) + float(np.dot(principal, w * w)))
        potential += mass * GRAVITY_M_S2 * position[2]
    return kinetic, potential


def shift(job: Job) -> Outcome:
    """Take a log, lay it down elsewhere in the pick area, return home, repeat.  Further option: seconds (simulated)."""
    rng = random.Random(f"endurance {job.seed}")
    rows: list[dict[str, float]] = []
    with _world(job, "single", 1) as world:
        driver = Driver(world)
        home = {name: world.q[name] for name in DRIVEN}
        while driver.steps * STEP_S < job.options["seconds"]:
            before = world.log_bodies.states()[0].position_m
            pick_logs(world, driver, rng)
            _lay_down(world, driver, rng)
            driver.move(home)
            driver.wait(3.0)
            after = world.log_bodies.states()[0].position_m
            resident = int(Path("/proc/self/statm").read_text().split()[1]) * PAGE_BYTES
            rows.append(
                {
                    "time_s": driver.steps * STEP_S,
                    "moved": float(math.dist(before, after) > 0.1),
                    "finite": float(all(map(math.isfinite, values_of(world)))),
                    "resident_mb": resident / 1e6,
                    "tip_z_m": world.tip()[2],
                    "encoder_z_m": world.rigid_tip()[2],
                }
            )
    warm = rows[min(WARM_CYCLES, len(rows) - 1) :]
    metrics = {
        "endurance_s": rows[-1]["time_s"],
        "endurance_cycles": float(len(rows)),
        "endurance_moved": sum(r["moved"] for r in rows) / len(rows),
        "endurance_not_finite": float(sum(not r["finite"] for r in rows)),
        "endurance_memory_mb": warm[-1]["resident_mb"] - warm[0]["resident_mb"],
        "endurance_tip_drift_m": max(abs(r["tip_z_m"] - warm[0]["tip_z_m"]) for r in warm),
    }
    return {"metrics": metrics, "traces": {"endurance": [{k: float(f"{v:.7g}") for k, v in r.items()} for r in rows]}}


def _lay_down(world: World, driver: Driver, rng: random.Random) -> None:
    """Lay the load down at a random place of the pick area in a random direction."""
    space, jaws = world.profile.workspace, world.profile.grapple.jaws
    floor = space.ground_z_m + LAY_DOWN_M
    low, high = floor + tip_below_pin_m(jaws, world.jaw_angle_rad), floor + lowest_tip_below_pin_m(jaws) + 0.8
    while True:
        x, y = (c + rng.uniform(-1.0, 1.0) * space.pick_half_size_m for c in space.pick_center_m)
        try:
            driver.extension_for(x, y, low, high)
        except Unreachable:
            continue
        driver.place(x, y, rng.uniform(-math.pi / 2, math.pi / 2), floor, high)
        return


def values_of(world: World) -> Iterator[float]:
    """Read every joint position and speed, chamber pressure and pose of a log."""
    poses = (world.client.getBasePositionAndOrientation(log) for log in world.log_bodies.body_ids)
    pressures = world.hydraulics.pressures_pa.values()
    return chain(world.q.values(), world.qd.values(), *pressures, *(v for pose in poses for v in pose))
