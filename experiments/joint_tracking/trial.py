"""One trial: a machine with a law makes a motion or meets a disturbance; metrics of joints and tip.

The tip is the hanger pin by kinematics of the true joint positions, without the deflection of the column, as in paper
B's accuracy test.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from itertools import product
from typing import Any, Final

import numpy as np

from experiments.common.pool import Job
from experiments.common.worlds import hang
from experiments.joint_tracking import motions
from experiments.joint_tracking.individuals import CORNERS, Machine, cornered, kind_of, widened, with_valves
from experiments.joint_tracking.motions import START_S, duration_s, legs
from experiments.joint_tracking.testbed import NAMES, JointTestbed, Trace
from machine.geometry.kinematics import pin_position
from sim.world import World

ARM: Final = ("slew", "lift", "tilt", "ext")
NEAR_M: Final = 0.015
"""The tip has settled when it stays this near to its goal."""
REST_S: Final = 9.0
QUIET_S: Final = 2.0
"""The valves should be closed this long after a motion, or from when the tip stays near its goal, if later."""
END_S: Final = 0.5
WOBBLE_S: Final = 1.5
"""Window of the moving average; the error without it is the oscillation of the tip."""
RIPPLE_S: Final = 0.2
RINGING_S: Final = 1.0
"""Window of the moving average for ringing after a stop."""
DIVERGED_M: Final = 0.3
"""A tip has diverged if it oscillates by more, or rests this far off and no nearer than at the end of the motion."""
CYCLE: Final = {
    "palms_471": {"slew": 0.9, "lift": -0.25, "tilt": 0.45, "ext": 0.45, "rot": 0.8},
    "aoro_fc8": {"slew": 1.1, "lift": -0.30, "tilt": 0.55, "ext": 0.80, "rot": 0.8},
}
LIFT_RAD: Final = 0.12
"""Rise of the boom in the first half of a crane cycle: the quasi-parabola of paper B."""
LOAD_KG: Final = {"palms_471": 100.0, "aoro_fc8": 200.0}
PICK_KG_S: Final = 400.0
"""Rate at which the load comes on the hook: a log leaves the ground within a quarter to half a second."""
DIP, DIP_S = 0.25, 1.0
"""In the middle of a motion the supply delivers this share of its pressure for this time."""
CHANGES: Final = {"slow": (0.7, 1.0), "fast": (1.3, 1.0), "cold": (0.85, 1.3), "load": (1.0, 1.0), "supply": (1.0, 1.0)}
"""Factors on gain and dead time of every valve; a load and a supply that droops come and go in the motions."""
LOADED: Final = (0.3, 0.8)
"""Share of a motion from which a load hangs on the hook, or the supply droops, and until when."""
DROOP: Final = 0.4
"""Share of the supply pressure that is left."""
STOPPED: Final = ("lift", "slew")
STOP_SHARE: Final = 0.8
STOP_S: Final = 4.0
RINGS_S: Final = (0.25, 2.5)
"""Interval after a stop in which its ringing counts."""


def perform(job: Job) -> dict[str, Any]:
    """Run one trial; options: profile (a shipped one or a file), truth, law, calibrated, and ``trace`` to keep the
    curves.
    """
    return KINDS[job.kind](job)


def cycle(
    job: Job,
    machine: Callable[[Job, World], Any] | None = None,
    later: Callable[[Any], Any] | None = None,
    on_leg: Callable[[World, float], None] | None = None,
) -> dict[str, Any]:
    """Move there and back with all joints together, quasi-parabolic, within the pump's flow.

    ``later`` changes the machine after its calibration; ``on_leg`` gets the time since the start of each of the two
    motions over its duration, before every tick.
    """
    with Machine(job, machine, later) as testbed:
        if load_kg := job.options.get("load_kg", 0.0):
            hang(testbed.world, load_kg)
        start, distances = testbed.positions(), CYCLE[kind_of(job)]
        out = duration_s(testbed.profile, distances, job.options.get("share", 0.45))
        rise = {"lift": LIFT_RAD}
        back = {name: -distance for name, distance in distances.items()}
        there_s = START_S + out
        moves = [
            (START_S, out, distances),
            (START_S, 0.5 * out, rise),
            (START_S + 0.5 * out, 0.5 * out, {"lift": -LIFT_RAD}),
            (there_s + REST_S, out, back),
        ]
        legs_of = ((START_S, there_s), (there_s + REST_S, there_s + REST_S + out))
        full_pa = testbed.world.hydraulics.relief_pa

        def disturb(time_s: float) -> None:
            begin_s = max((begin_s for begin_s, _ in legs_of if begin_s <= time_s), default=math.inf)
            if on_leg is not None:
                on_leg(testbed.world, (time_s - begin_s) / out)
            elif job.kind == "dip":
                low = 0.0 <= time_s - (begin_s + 0.5 * out) < DIP_S
                testbed.world.hydraulics.relief_pa = (DIP if low else 1.0) * full_pa

        trace = testbed.run(legs(start, moves), there_s + REST_S + out + REST_S, disturb)
        return _tip_metrics(testbed, trace, legs_of, job)


def pump(job: Job) -> dict[str, Any]:
    """Run the cycle at full speed, which needs more flow than the pump delivers."""
    return cycle(_with(job, share=1.0))


def wide(job: Job) -> dict[str, Any]:
    """Run the cycle on a machine whose dead times and gains deviate twice as much as the truth's spread allows."""
    return cycle(job, widened)


def corner(job: Job) -> dict[str, Any]:
    """Run the cycle on a machine in a corner of twice the spread; the option ``corner`` is an index of `CORNERS`."""
    loaded = CORNERS[job.options["corner"]][2]
    return cycle(_with(job, load_kg=LOAD_KG[kind_of(job)] if loaded else 0.0), cornered)


def matched(job: Job) -> dict[str, Any]:
    """Run the cycle of a calibrated machine that has changed since; the option ``change`` is one of `CHANGES`."""
    load_kg, relief_pa = LOAD_KG[kind_of(job)], [0.0]

    def load(world: World, share: float) -> None:
        hang(world, load_kg if LOADED[0] <= share < LOADED[1] else 0.0)

    def droop(world: World, share: float) -> None:
        relief_pa[0] = relief_pa[0] or world.hydraulics.relief_pa
        world.hydraulics.relief_pa = (DROOP if LOADED[0] <= share < LOADED[1] else 1.0) * relief_pa[0]

    match job.options["change"]:
        case "load":
            return cycle(job, on_leg=load)
        case "supply":
            return cycle(job, on_leg=droop)
        case change:
            gain, delay = CHANGES[change]
            return cycle(job, later=lambda truth: with_valves(truth, gain, delay))


def steps(job: Job) -> dict[str, Any]:
    """Step every joint alone in both directions: overshoot and settling."""
    with Machine(job) as testbed:
        overshoot, settling, rest_errors, chatter = [], [], [], []
        for name in ARM:
            for side in (1, -1):
                start = testbed.positions()
                reference, begin_s = motions.step(testbed.profile, start, name, side)
                trace = testbed.run(reference, begin_s + REST_S)
                j = NAMES.index(name)
                q = np.array([x[j] for x in trace.position])
                goal = trace.reference[-1][j]
                step_size, after = goal - start[j], np.array(trace.time_s) >= begin_s
                error = np.abs(q[after] - goal)
                late = np.nonzero(error > 0.1 * abs(step_size))[0]
                overshoot.append(float(max(0.0, (side * (q[after] - goal)).max()) / abs(step_size)))
                settling.append(float(np.array(trace.time_s)[after][late[-1]]) - begin_s if late.size else 0.0)
                rest_errors.append(float(error[-100:].mean()))
                chatter.append(_chatter_pct_s(trace, after))
        return {"overshoot": overshoot, "settling_s": settling, "left": rest_errors, "chatter_pct_s": chatter}


def ramps(job: Job) -> dict[str, Any]:
    """Move every joint alone at constant speed in both directions: tracking error."""
    with Machine(job) as testbed:
        rms, ripple, chatter = [], [], []
        for name in ARM:
            for side in (1, -1):
                reference, over_s = motions.ramp(testbed.profile, testbed.positions(), name, side)
                trace = testbed.run(reference, over_s + REST_S)
                j, moving = NAMES.index(name), np.array(trace.time_s) < over_s
                error = (np.array(trace.position) - np.array(trace.reference))[moving, j]
                rms.append(float(np.sqrt((error**2).mean())))
                ripple.append(_ripple_bar(trace, moving))
                chatter.append(_chatter_pct_s(trace, moving))
        return {"rms": rms, "ripple_bar": ripple, "chatter_pct_s": chatter}


def pick_up(job: Job) -> dict[str, Any]:
    """Pick up a load while the boom rises; it stays on the hook."""
    load_kg = LOAD_KG[kind_of(job)]
    with Machine(job) as testbed:
        start = testbed.positions()
        ways = {"lift": 0.2, "ext": 0.1}
        out, begin_s = duration_s(testbed.profile, ways, 0.45), 1.0

        def load(time_s: float) -> None:
            hang(testbed.world, min(max(0.0, (time_s - begin_s - START_S) * PICK_KG_S), load_kg))

        trace = testbed.run(legs(start, [(begin_s, out, ways)]), begin_s + out + REST_S, load)
        return _tip_metrics(testbed, trace, ((begin_s, begin_s + out),), job)


def stop(job: Job) -> dict[str, Any]:
    """Measure the ringing of the pin after a stop of boom and slew from high speed with full deceleration, with and
    without pressure feedback.

    Lateral ringing for the slew, vertical ringing for the boom.
    """
    outcome: dict[str, Any] = {}
    for name, loaded, damped in product(STOPPED, (False, True), (True, False)):
        key = f"{name}_{'loaded' if loaded else 'empty'}_{'damped' if damped else 'plain'}"
        with Machine(_with(job, damped=damped)) as testbed:
            if loaded:
                hang(testbed.world, LOAD_KG[kind_of(job)])
            start = testbed.positions()
            testbed.run(lambda _, at=start: (at, [0.0] * len(at)), 1.0)  # type: ignore[misc]
            both = [_stop(testbed, name, side) for side in (1, -1)]
        outcome[f"{key}_ring_m"] = [ring_m for ring_m, _, _ in both]
        outcome[f"{key}_ripple_bar"] = [ripple_bar for _, ripple_bar, _ in both]
        if job.options.get("trace") and loaded:
            outcome.setdefault("trace", {})[key] = both[0][2]
    return outcome


def _stop(testbed: JointTestbed, name: str, side: int) -> tuple[float, float, list[Any]]:
    """Measure pin ringing [m] and pressure ripple [bar] after a stop, and the curve: time after the stop, ringing."""
    spec, pins = testbed.profile.joints[name], []
    ends_s = 1.5 * STOP_SHARE * spec.speed_limit / spec.acceleration_limit
    reference, over_s = motions.ramp(testbed.profile, testbed.positions(), name, side, STOP_SHARE, ends_s)
    trace = testbed.run(reference, over_s + STOP_S, lambda _: pins.append(testbed.world.crane.pose("hanger")[0]))
    t, pin = np.array(trace.time_s), np.array(pins)
    outward = pin[-1, :2] / np.linalg.norm(pin[-1, :2])
    deflection_m = pin[:, 2] if name == "lift" else pin[:, :2] @ np.array((-outward[1], outward[0]))
    ringing_rows = (t >= over_s + RINGS_S[0]) & (t < over_s + RINGS_S[1])
    fast = deflection_m - _slow(deflection_m, RINGING_S, t[1])
    ripple_bar = _ripple_bar(trace, ringing_rows, (NAMES.index(name),), RINGING_S)
    return float(np.sqrt((fast[ringing_rows] ** 2).mean())), ripple_bar, [(t - over_s).tolist(), fast.tolist()]


KINDS: Final[Mapping[str, Callable[[Job], dict[str, Any]]]] = {
    "cycle": cycle,
    "pump": pump,
    "dip": cycle,
    "wide": wide,
    "corner": corner,
    "matched": matched,
    "steps": steps,
    "ramps": ramps,
    "pick_up": pick_up,
    "stop": stop,
}


def _with(job: Job, **options: Any) -> Job:
    return Job(job.name, job.kind, job.seed, {**job.options, **options})


def _tip_metrics(
    testbed: JointTestbed, trace: Trace, moved: tuple[tuple[float, float], ...], job: Job
) -> dict[str, Any]:
    """Compute the errors of the tip and metrics of the valves over the motions between the given times."""
    kinematics, t = testbed.profile.kinematics, np.array(trace.time_s)
    tip = np.array([pin_position(kinematics, q) for q in trace.position])
    goal = np.array([pin_position(kinematics, q) for q in trace.reference])
    error = np.linalg.norm(tip - goal, axis=1)
    fast = np.linalg.norm(tip - goal - _slow(tip - goal, WOBBLE_S, t[1]), axis=1)
    moving, rest, quiet, settle = np.zeros(len(t), bool), [], np.zeros(len(t), bool), []
    lost, unsettled = False, 0
    behind_s = float(t[-1] - sum(trace.rate[1:]) * t[1])
    for i, (begin_s, end_s) in enumerate(moved):
        final = i == len(moved) - 1
        last_s = float(t[-1]) if final else moved[i + 1][0]
        over_s = end_s + behind_s if final else end_s
        moving |= (t >= begin_s) & (t < over_s)
        after = (t >= over_s) & (t < last_s)
        rest.append(float(error[after][-round(END_S / t[1]) :].mean()))
        lost = lost or not rest[-1] <= max(DIVERGED_M, float(error[after][0]))
        late = np.nonzero(error[after] > NEAR_M)[0]
        settle.append(float(t[after][late[-1]] - over_s) if late.size else 0.0)
        if settle[-1] < last_s - over_s - END_S:
            quiet |= after & (t >= over_s + max(QUIET_S, settle[-1]))
        else:
            unsettled += 1
    spools = np.array(trace.spool_pct)[:, : len(ARM)]
    wobble_m = float(fast.max())
    figures = {
        "tip_rms_m": float(np.sqrt((error[moving] ** 2).mean())),
        "tip_peak_m": float(error[moving].max()),
        "rest_m": rest,
        "settle_s": settle,
        "shut_share": float((spools[quiet] == 0.0).mean()) if quiet.any() else math.nan,
        "unsettled_share": unsettled / len(moved),
        "chatter_pct_s": _chatter_pct_s(trace, moving),
        "ripple_bar": _ripple_bar(trace, moving | quiet),
        "energy_j": trace.energy_j[-1],
        "behind_s": behind_s,
        "limited_share": float(np.mean(np.array(trace.limited)[moving])),
        "wobble_m": wobble_m,
        "alarms": len({(name, reason) for _, name, reason in trace.alarms}),
        "diverged": lost or not wobble_m <= DIVERGED_M,
    }
    if job.options.get("trace"):
        every = slice(None, None, 10)
        figures["trace"] = {
            "time_s": t[every].tolist(),
            "error_m": error[every].tolist(),
            "spool_pct": [s[0] for s in trace.spool_pct[every]],
        }
    return figures


def _slow(values: Any, over_s: float, period_s: float) -> Any:
    """Compute the moving average over a centred window, along the first axis."""
    n = round(0.5 * over_s / period_s)
    padded = np.concatenate((np.repeat(values[:1], n + 1, axis=0), values, np.repeat(values[-1:], n, axis=0)))
    summed = np.cumsum(padded, axis=0)
    return (summed[2 * n + 1 :] - summed[: -2 * n - 1]) / (2 * n + 1)


def _chatter_pct_s(trace: Trace, when: Any) -> float:
    """Compute the travel of all spools of the arm per second [%/s]."""
    spools = np.array(trace.spool_pct)[when, : len(ARM)]
    return float(np.abs(np.diff(spools, axis=0)).sum() / (when.sum() * trace.time_s[1]))


def _ripple_bar(trace: Trace, when: Any, joints: Sequence[int] = range(len(ARM)), over_s: float = RIPPLE_S) -> float:
    """Compute the RMS [bar] of the load pressures without their moving average; mean of the joints."""
    pressures = np.array(trace.load_bar)[:, list(joints)]
    pressures = pressures[:, np.isfinite(pressures).all(axis=0)]
    fast = (pressures - _slow(pressures, over_s, trace.time_s[1]))[when]
    return float(np.sqrt((fast**2).mean(axis=0)).mean())
