"""One hour of continuous work, and the same trial in two processes.

``shift``: the crane takes a log, lays it down elsewhere in the pick area and returns home, repeatedly.  Metrics: values
that are not finite, growth of memory, drift of the tip at home, share of cycles that moved the log.  ``fingerprint``: a
hash over everything that moves in one grasp.
"""

from __future__ import annotations

import hashlib
import math
import random
import struct
from pathlib import Path
from typing import Any, Final

from experiments.common.pool import Job
from experiments.common.worlds import trial_world
from experiments.plant.driver import DRIVEN, Driver
from experiments.plant.trial import pick_logs
from machine.geometry.grapple import lowest_tip_below_pin_m, tip_below_pin_m
from machine.geometry.kinematics import Unreachable
from sim.world import STEP_S, World

PAGE_BYTES: Final = 4096
WARM_CYCLES: Final = 3  # cycles before memory and drift are compared
LAY_DOWN_M: Final = 0.06


def shift(job: Job) -> dict[str, Any]:
    """Options: profile, truth, seconds (simulated)."""
    o = job.options
    rng = random.Random(f"endurance {job.seed}")
    with trial_world(o["profile"], o["truth"], job.seed, "single", 1) as world:
        steps = 0

        def count() -> None:
            nonlocal steps
            steps += 1

        driver = Driver(world, count)
        home = {name: world.q[name] for name in DRIVEN}
        rows: list[dict[str, float]] = []
        while steps * STEP_S < o["seconds"]:
            before = world.log_bodies.states()[0].position_m
            pick_logs(world, driver, rng)
            _lay_down(world, driver, rng)
            driver.move(home)
            driver.wait(3.0)
            after = world.log_bodies.states()[0].position_m
            rows.append(
                {
                    "time_s": steps * STEP_S,
                    "moved": float(math.dist(before, after) > 0.1),
                    "finite": float(_finite(world)),
                    "resident_mb": _resident_mb(),
                    "tip_z_m": world.tip()[2],
                    "encoder_z_m": world.rigid_tip()[2],
                    "log_z_m": after[2],
                    "pressure_pa": world.hydraulics.pressures_pa["lift"][0],
                }
            )
    first, last = rows[min(WARM_CYCLES, len(rows) - 1)], rows[-1]
    tips = [r["tip_z_m"] for r in rows]
    return {
        "metrics": {
            "endurance_s": last["time_s"],
            "endurance_cycles": float(len(rows)),
            "endurance_moved": sum(r["moved"] for r in rows) / len(rows),
            "endurance_not_finite": float(sum(not r["finite"] for r in rows)),
            "endurance_memory_mb": last["resident_mb"] - first["resident_mb"],
            "endurance_tip_drift_m": max(abs(z - first["tip_z_m"]) for z in tips[min(WARM_CYCLES, len(rows) - 1) :]),
        },
        "traces": {"endurance": [{k: float(f"{v:.7g}") for k, v in r.items()} for r in rows]},
    }


def _lay_down(world: World, driver: Driver, rng: random.Random) -> None:
    """Lay the load down at a random place of the pick area in a random direction."""
    space, jaws = world.profile.workspace, world.profile.grapple.jaws
    tips = lowest_tip_below_pin_m(jaws)
    while True:
        x, y = (c + rng.uniform(-1.0, 1.0) * space.pick_half_size_m for c in space.pick_center_m)
        floor = space.ground_z_m + LAY_DOWN_M
        low, high = floor + tip_below_pin_m(jaws, world.jaw_angle_rad), floor + tips + 0.8
        try:
            driver.extension_for(x, y, low, high)
        except Unreachable:
            continue
        driver.place(x, y, rng.uniform(-math.pi / 2, math.pi / 2), floor, high)
        return


def _finite(world: World) -> bool:
    """Whether every joint, speed, pressure and log position is finite."""
    values = [*world.q.values(), *world.qd.values(), world.hydraulics.energy_j]
    values += [v for pair in world.hydraulics.pressures_pa.values() for v in pair]
    values += [v for log in world.log_bodies.states() for v in (*log.position_m, log.speed_m_s)]
    return all(map(math.isfinite, values))


def _resident_mb() -> float:
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * PAGE_BYTES / 1e6


def fingerprint(job: Job) -> str:
    """Options: profile, truth, scene, logs.  SHA-256 over all joints, speeds, pressures and logs, every step."""
    o = job.options
    digest = hashlib.sha256()
    with trial_world(o["profile"], o["truth"], job.seed, o["scene"], o["logs"]) as world:
        p = world.client

        def note() -> None:
            values = [*world.q.values(), *world.qd.values()]
            values += [v for pair in world.hydraulics.pressures_pa.values() for v in pair]
            for log in world.log_bodies.body_ids:
                position, turn = p.getBasePositionAndOrientation(log)
                values += [*position, *turn]
            digest.update(struct.pack(f"<{len(values)}d", *values))

        pick_logs(world, Driver(world, note))
    return digest.hexdigest()
