"""Grasps of the plant experiment: an open-loop driver of the crane, and one trial with new logs and an aim with noise.

The driver moves smooth joint references with feed-forward and P control, spools out.  It replaces the controller and
has the same knowledge: the profile's kinematics, dead-bands and speeds, and the joint positions by encoders.  It does
not know the tip, the bending of the structure, the pendulum or the logs; the grasp target is given once, before the
motion.  Points and angles are in the crane's base frame.  The plant's ground truth decides the outcome of a trial.
"""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

from experiments.common.pool import Job
from experiments.common.worlds import to_base, trial_world, yaw_in_base
from machine.geometry.grapple import grapple_yaw, lowest_tip_below_pin_m, rotator_for_yaw, tip_below_pin_m
from machine.geometry.kinematics import Point, Unreachable, inverse, reachable_extensions, solve
from machine.joints import Joint
from machine.profile import joint_limits
from sim.evaluator import LIFTED_M, Evaluator
from sim.nodes.mach0 import spool_for
from sim.wood.bunk import from_bunk
from sim.wood.logs import LogState
from sim.world import STEP_S, World

ARM: Final = ("slew", "lift", "tilt", "ext")
DRIVEN: Final = (*ARM, "rot")
CLEARANCE_M: Final = 0.02  # tips over the ground; higher tips would pinch a thin log instead of reaching under it
GAIN_1_S: Final = 3.0
LINE_SPEED_M_S: Final = 0.6
RAISE_SPEED_M_S: Final = 0.35
REST_SHARE: Final = 0.004  # share of full speed below which the spool stays in its dead-band
CLOSE_LIMIT_S: Final = 8.0
GRIPPED_S: Final = 0.3
STILL_RAD_S: Final = 0.02
OPENING: Final = 0.6  # share of full spool at which the pin follows the tips
LOOK_AHEAD_RAD: Final = (0.0, 0.05, 0.10, 0.15)
RELEASED_RAD: Final = 0.45  # tips clear of the load, not yet at the stakes


class Driver:
    """Moves one World; every method advances the physics until its motion is over."""

    def __init__(self, world: World, each_step: Callable[[], None] | None = None) -> None:
        self.world = world
        self.reference = {name: world.q[name] for name in DRIVEN}
        self.grapple = 0.0
        self.steps = 0
        self._each_step = each_step
        self._kin, self._limits = world.profile.kinematics, joint_limits(world.profile)

    def tick(self, rates: Mapping[str, float]) -> None:
        """Run one physics step towards the reference, with feed-forward ``rates`` [unit/s]."""
        spools = {"grapple": self.grapple}
        for name, target in self.reference.items():
            valve = self.world.profile.joints[name].valve
            speed = rates.get(name, 0.0) + GAIN_1_S * (target - self.world.q[name])
            full = valve.full_speed_plus if speed > 0.0 else valve.full_speed_minus
            spools[name] = spool_for(valve, speed, REST_SHARE * full)
        self.world.step([spools.get(name, 0.0) for name in self.world.functions])
        self.steps += 1
        if self._each_step:
            self._each_step()

    def wait(self, seconds: float) -> None:
        """Hold the reference for a time."""
        for _ in range(round(seconds / STEP_S)):
            self.tick({})

    def move(self, goal: Mapping[str, float]) -> None:
        """Move all joints to ``goal`` on one minimum-jerk profile whose peak speeds are the profile's limits."""
        start = dict(self.reference)
        delta = {name: value - start[name] for name, value in goal.items()}
        peaks = (15 / 8 * abs(d) / self.world.profile.joints[name].speed_limit for name, d in delta.items())
        steps = math.ceil(max(0.3, *peaks) / STEP_S)
        for i in range(1, steps + 1):
            share, rate = _minimum_jerk(i / steps, steps * STEP_S)
            self.reference.update({name: start[name] + share * d for name, d in delta.items()})
            self.tick({name: rate * d for name, d in delta.items()})

    def line(self, start: Point, end: Point, ext_m: float) -> None:
        """Move the hanger pin along a straight line with the telescope fixed."""
        steps = math.ceil(max(0.3, 15 / 8 * math.dist(start, end) / LINE_SPEED_M_S) / STEP_S)
        for i in range(1, steps + 1):
            share, _ = _minimum_jerk(i / steps, steps * STEP_S)
            x, y, z = (a + share * (b - a) for a, b in zip(start, end, strict=True))
            self._follow((x, y, z), ext_m)

    def pose(self, pin: Point, ext_m: float) -> dict[str, float]:
        """Compute the joint positions that put the pin there."""
        return dict(zip(ARM, (*inverse(self._kin, self._limits, *pin, ext_m), ext_m), strict=True))

    def extension_for(self, x: float, y: float, low_m: float, high_m: float) -> float:
        """Find a telescope position [m] that reaches the whole vertical line.

        Raises:
            Unreachable: there is none.
        """
        spans = [reachable_extensions(self.world.profile, x, y, z) for z in (low_m, (low_m + high_m) / 2, high_m)]
        common = [(max(a[0], b[0], c[0]), min(a[1], b[1], c[1])) for a in spans[0] for b in spans[1] for c in spans[2]]
        least, most = max(common, key=lambda span: span[1] - span[0], default=(0.0, -1.0))
        if least > most:
            raise Unreachable(
                f"no telescope position reaches ({x:.2f}, {y:.2f}) m from {low_m:.2f} to {high_m:.2f} m",
                "experiment.no-telescope-position",
            )
        margin = 0.1 * (most - least)
        wish = solve(self.world.profile, x, y, (low_m + high_m) / 2)[Joint.EXT]
        return min(max(wish, least + margin), most - margin)

    def log_yaw(self) -> float:
        """Compute the direction [rad] of a log that the grapple holds squarely at the present reference."""
        q = [self.reference[name] for name in DRIVEN]
        return grapple_yaw(self.world.profile, q) - math.pi / 2

    def rotator(self, slew: float, log_yaw: float) -> float:
        """Compute the rotator position that closes the grapple across a log."""
        return rotator_for_yaw(self.world.profile, slew, log_yaw + math.pi / 2, self.reference["rot"])

    def pick(self, x: float, y: float, log_yaw: float, hover_m: float, ground_m: float, lift_to_m: float) -> float:
        """Grasp at (x, y) across a log of this yaw, raise; heights [m] of the pin and the ground there.

        The grapple is open before.  Returns the telescope position of the motion.
        """
        jaws = self.world.profile.grapple.jaws
        floor = ground_m + CLEARANCE_M
        low = floor + tip_below_pin_m(jaws, 0.0)
        top = max(hover_m, lift_to_m, floor + lowest_tip_below_pin_m(jaws))
        ext = self.extension_for(x, y, low, top)
        above = self.pose((x, y, hover_m), ext)
        self.move({**above, "rot": self.rotator(above["slew"], log_yaw)})
        self.wait(0.8)
        self.line((x, y, hover_m), (x, y, low), ext)
        self.wait(0.5)
        z = self._close_while_raising(x, y, low, floor, ext)
        self.grapple = -0.2
        self.line((x, y, z), (x, y, lift_to_m), ext)
        self.wait(1.0)
        return ext

    def place(self, x: float, y: float, log_yaw: float, floor_m: float, carry_m: float) -> None:
        """Carry to (x, y), turn the load to ``log_yaw``, set it down, open and go up again.

        The tips stay ``floor_m`` above the base: closed tips are lowered to this height, and while they open and sweep
        lower the pin rises, so that the load is laid down and not dropped.
        """
        jaws = self.world.profile.grapple.jaws
        low = floor_m + tip_below_pin_m(jaws, self.world.jaw_angle_rad)
        ext = self.extension_for(x, y, low, carry_m)
        above = self.pose((x, y, carry_m), ext)
        self.move({**above, "rot": self.rotator(above["slew"], log_yaw)})
        self.wait(1.0)
        self.line((x, y, carry_m), (x, y, low), ext)
        self.wait(0.5)
        z = self._open_while_raising(x, y, low, floor_m, ext)
        self.wait(0.5)
        self.line((x, y, z), (x, y, carry_m), ext)

    def _open_while_raising(self, x: float, y: float, z: float, floor: float, ext: float) -> float:
        self.grapple = OPENING
        z = self._sweep(x, y, z, floor, ext, -1.0, lambda: self.world.jaw_angle_rad < RELEASED_RAD)
        self.grapple = 0.0
        return z

    def _close_while_raising(self, x: float, y: float, z: float, floor: float, ext: float) -> float:
        """Close until the jaws stop on a load."""
        still_s = 0.0

        def gripped() -> bool:
            nonlocal still_s
            qd = self.world.qd
            moving = abs(qd["tong_left"]) + abs(qd["tong_right"]) > STILL_RAD_S or self.world.jaw_angle_rad < 0.2
            still_s = 0.0 if moving else still_s + STEP_S
            return still_s > GRIPPED_S

        self.grapple = -0.7
        return self._sweep(x, y, z, floor, ext, 1.0, gripped)

    def _sweep(
        self, x: float, y: float, z: float, floor: float, ext: float, sign: float, done: Callable[[], bool]
    ) -> float:
        """Let the jaws move until ``done``; where their tips sweep lower the pin rises.  Returns its height [m]."""
        jaws = self.world.profile.grapple.jaws
        for _ in range(round(CLOSE_LIMIT_S / STEP_S)):
            angle = self.world.jaw_angle_rad
            required_z = floor + max(tip_below_pin_m(jaws, angle + sign * ahead) for ahead in LOOK_AHEAD_RAD)
            z = max(z, min(required_z, z + RAISE_SPEED_M_S * STEP_S))
            self._follow((x, y, z), ext)
            if done():
                break
        return z

    def _follow(self, pin: Point, ext_m: float) -> None:
        goal = self.pose(pin, ext_m)
        rates = {name: (goal[name] - self.reference[name]) / STEP_S for name in ARM}
        self.reference.update(goal)
        self.tick(rates)


def _minimum_jerk(t: float, duration_s: float) -> tuple[float, float]:
    """Compute the progress and its rate [1/s] at the share ``t`` of the time."""
    return t**3 * (10 - 15 * t + 6 * t * t), 30 * t * t * (1 - t) ** 2 / duration_s


AIM_M: Final = 0.04
AIM_RAD: Final = math.radians(4.0)
HOVER_M: Final = 0.5  # tips over the ground before the descent
LIFT_HEIGHT_M: Final = 1.0  # tips over the ground after the lift: higher than the criterion for a lifted log
WEIGH_S: Final = 0.5
UNLOADED_S: Final = 20  # a crooked log may rock this long
OVER_STAKES_M: Final = 0.15
OVER_FLOOR_M: Final = 0.05


def grasp(job: Job) -> dict[str, Any]:
    """Grasp a scene's logs; options: profile, truth, scene, logs, across_m, turned_rad, unload.

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
    """Compute the height of the pin [m] at which a load clears the stakes."""
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
    """Compute the middle (x, y) [m] and direction [rad] of logs in the base frame."""
    centre = [sum(log.position_m[i] for log in logs) / len(logs) for i in range(3)]
    x, y, _ = to_base(world, centre)
    # An axis is defined modulo pi: average the doubled angles.
    doubled = [2.0 * yaw_in_base(world, log.axis) for log in logs]
    return x, y, math.atan2(sum(map(math.sin, doubled)), sum(map(math.cos, doubled))) / 2.0


def _aim(
    world: World, driver: Driver, rng: random.Random | None, across_m: float, logs: Sequence[LogState]
) -> tuple[float, float, float, float]:
    """Compute the grasp target in the base frame with noise: x, y, direction of the logs, height of the ground.

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
