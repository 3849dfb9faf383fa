"""True position of the hanger pin compared with that of a calibrated profile, at poses that were not surveyed.

The plant rests at the poses with its oil locked, empty and with a load on its hook.  The encoder readings go through
the kinematics of the shipped and of the calibrated profile.  There the load is known, as from a load cell; the load by
the lift's pressures alone is compared with it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Final

from experiments.common.pool import Job
from experiments.common.worlds import hang, trial_world
from machine.geometry.kinematics import Unreachable, pin_position
from machine.geometry.sag import aim_free, true_pin
from machine.joints import Joint
from machine.profile import Profile, joint
from machine.sensing import hanging_load_kg, lift_moment_nm
from sim.world import GRAPPLE_LINKS, STEP_S, World

LOAD_KG: Final = 200.0
GOALS: Final = (
    (4.27, 1.86, 1.0),
    (4.27, -1.86, 1.0),
    (6.0, 1.86, 1.0),
    (6.0, -1.86, 1.0),
    (3.0, 0.8, 1.6),
    (4.4, -2.4, 2.8),
    (5.2, 0.0, 1.8),
    (6.3, -1.0, 2.4),
)
"""Positions ahead of and beside the crane at slew 0 [m]: the four of paper B, and others; some are out of reach for the
smaller crane, or among the stakes of a machine's bunk.
"""
NUDGE_SPOOL, NUDGE_S = 0.22, 0.4
HANG_S, REST_S, LOOK_S = 1.0, 4.0, 2.0


def tip_errors(job: Job, shipped: Profile, calibrated: Profile) -> dict[str, Any]:
    """Compute distances of the true pin [mm] and errors of the load [kg] at every goal within reach, by name."""
    errors: dict[str, list[float]] = {"before": [], "empty": [], "loaded": [], "loaded_before": [], "load_kg": []}
    turn = calibrated.kinematics.theta1_offset_rad
    for i, (ahead, aside, z) in enumerate(GOALS):
        x, y = ahead * math.cos(turn) - aside * math.sin(turn), ahead * math.sin(turn) + aside * math.cos(turn)
        try:
            q = aim_free(calibrated, x, y, z)
        except Unreachable:
            continue
        home = dict(zip(("slew", "lift", "tilt", "ext"), q, strict=True))
        with trial_world(job.options["profile"], job.options["truth"], job.seed, home=home) as world:
            # A cylinder's friction depends on where it came from: every second pose is reached from above.
            _run(world, NUDGE_S, NUDGE_SPOOL if i % 2 else -NUDGE_SPOOL)
            for kg, before, after in ((0.0, "before", "empty"), (LOAD_KG, "loaded_before", "loaded")):
                if kg:
                    _hang_slowly(world, kg)
                    _run(world, REST_S)
                if touches(world):
                    break
                shown, true, moment_nm = _look(world, shipped)
                corrected = _read_by(shown, shipped, calibrated)
                errors[before].append(1e3 * math.dist(pin_position(shipped.kinematics, shown), true))
                pin = true_pin(calibrated.sag, calibrated.kinematics, corrected, kg)
                errors[after].append(1e3 * math.dist(pin, true))
                errors["load_kg"].append(
                    hanging_load_kg(calibrated.sag, calibrated.kinematics, corrected, moment_nm) - kg
                )
    return errors


def touches(world: World) -> bool:
    """Tell whether the grapple stands on something, as a stake of the bunk: it then carries what the crane should."""
    body, links = world.crane.body, {world.crane.link[name] for name in GRAPPLE_LINKS}
    contacts = world.client.getContactPoints(bodyA=body)
    return any(c[3] in links or (c[2] == body and c[4] in links) for c in contacts)


def _run(world: World, seconds: float, lift_spool: float = 0.0) -> None:
    commands = [0.0] * len(world.functions)
    commands[world.functions.index("lift")] = lift_spool
    for _ in range(round(seconds / STEP_S)):
        world.step(commands)


def _hang_slowly(world: World, kg: float) -> None:
    """Hang a load on the hook without a shock."""
    parts = 20
    for i in range(parts):
        hang(world, kg * (i + 1) / parts)
        _run(world, HANG_S / parts)


def _look(world: World, profile: Profile) -> tuple[list[float], Sequence[float], float]:
    """Average over an interval: encoder readings through a profile, the true pin, and the moment by the pressures."""
    names = [j.name.lower() for j in Joint]
    steps = round(LOOK_S / STEP_S)
    q, tip, bar = [0.0] * len(names), [0.0] * 3, [0.0] * 2
    for _ in range(steps):
        _run(world, STEP_S)
        q = [a + world.q[n] / steps for a, n in zip(q, names, strict=True)]
        tip = [a + v / steps for a, v in zip(tip, world.tip(), strict=True)]
        bar = [a + p / steps / 1e5 for a, p in zip(bar, world.hydraulics.pressures_pa["lift"], strict=True)]
    for j, name in enumerate(names[:4]):
        e = world.truth.encoders[name]
        q[j] += e.offset + e.eccentricity * math.sin(q[j] + e.phase_rad)
    return q, tip, lift_moment_nm(profile, q[Joint.LIFT], *bar)


def _read_by(shown: Sequence[float], shipped: Profile, calibrated: Profile) -> list[float]:
    """Read the same encoder counts with the zeros of the calibrated profile."""
    out = list(shown)
    for j in Joint:
        a, b = joint(shipped, j).encoder, joint(calibrated, j).encoder
        if a is not None and b is not None:
            out[j] -= b.direction * (b.zero_counts - a.zero_counts) * b.unit_per_count
    return out
