"""A simple crane driver for plant tests: smooth references and a P law on the plant's true joints, spools out.

It is not the controller: it reads the plant directly and compensates the profile's dead-bands.  ``Driver.pick`` and
``place`` take a log from the ground to the bunk.  Positions are of the hanger pin in the crane's base frame.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import pairwise

from machine.geometry.kinematics import Unreachable, inverse, solve
from machine.profile import joint_limits
from sim.wood.bunk import from_bunk
from sim.world import STEP_S, World

ACTIVE = ("slew", "lift", "tilt", "ext")
SPEED = {"slew": 0.40, "lift": 0.17, "tilt": 0.30, "ext": 0.25, "rot": 1.0}
KP = {"slew": 1.5, "lift": 3.0, "tilt": 3.0, "ext": 3.0, "rot": 3.0}
CLEARANCE_M = 0.03
Pin = tuple[float, float, float]


class Driver:
    """Moves one World; every method steps the physics until its motion is over."""

    def __init__(self, world: World, each_step: Callable[[], None] | None = None) -> None:
        self.w = world
        self.ref = {j: world.q[j] for j in SPEED}
        self.commands = dict.fromkeys(world.functions, 0.0)
        self.each_step = each_step
        self._limits = joint_limits(world.profile)

    def inverse(self, pin: Pin) -> dict[str, float]:
        """Joint positions that put the hanger pin at ``pin``, the telescope where it is when that reaches."""
        ext = self.ref["ext"]
        try:
            q = (*inverse(self.w.profile.kinematics, self._limits, *pin, ext), ext)
        except Unreachable:
            q = solve(self.w.profile, *pin, preference=ext)
        return dict(zip(ACTIVE, q, strict=True))

    def tick(self, rates: dict[str, float]) -> None:
        """One physics step towards the reference, with feed-forward ``rates``."""
        w = self.w
        for joint, target in self.ref.items():
            v = rates.get(joint, 0.0) + KP[joint] * (target - w.q[joint])
            t = w.profile.joints[joint].valve
            full = t.full_speed_plus if v > 0 else t.full_speed_minus
            band = (t.deadband_plus_pct if v > 0 else t.deadband_minus_pct) / 100
            u = band + (1 - band) * min(1.0, abs(v) / full)
            self.commands[joint] = 0.0 if abs(v) < 0.004 * full else math.copysign(u, v)
        w.step(list(self.commands.values()))
        if self.each_step:
            self.each_step()

    def wait(self, seconds: float) -> None:
        """Hold the reference."""
        for _ in range(round(seconds / STEP_S)):
            self.tick({})

    def move(self, goal: dict[str, float]) -> None:
        """All joints to ``goal`` on one smooth profile (peak speed 15/8 of the mean)."""
        start = dict(self.ref)
        delta = {j: goal[j] - start[j] for j in goal}
        duration = max(0.3, *(15 / 8 * abs(d) / SPEED[j] for j, d in delta.items()))
        n = math.ceil(duration / STEP_S)
        for i in range(1, n + 1):
            t = i / n
            s, v = t**3 * (10 - 15 * t + 6 * t * t), 30 * t * t * (1 - t) ** 2 / duration
            self.ref.update({j: start[j] + s * d for j, d in delta.items()})
            self.tick({j: v * d for j, d in delta.items()})

    def line(self, start: Pin, end: Pin, speed: float = 0.6) -> None:
        """The pin along a straight line."""
        duration = max(0.3, 15 / 8 * math.dist(start, end) / speed)
        n = math.ceil(duration / STEP_S)
        for i in range(1, n + 1):
            t = i / n
            s = t**3 * (10 - 15 * t + 6 * t * t)
            x, y, z = (a + s * (b - a) for a, b in zip(start, end, strict=True))
            self._follow((x, y, z))

    def _follow(self, pin: Pin) -> None:
        goal = self.inverse(pin)
        rates = {j: (goal[j] - self.ref[j]) / STEP_S for j in ACTIVE}
        self.ref.update(goal)
        self.tick(rates)

    def tip_below_pin(self, angle: float) -> float:
        """Jaw tips below the hanger pin [m] at a jaw angle, from the profile's table."""
        table = self.w.profile.grapple.jaws
        pairs = list(zip(table.angle_rad, table.tip_below_pin_m, strict=True))
        for (a0, z0), (a1, z1) in pairwise(pairs):
            if angle <= a1:
                return z0 + (z1 - z0) * (angle - a0) / (a1 - a0)
        return pairs[-1][1]

    def rotator_for(self, yaw: float, slew: float) -> float:
        """Rotator angle that grips a log whose axis points to ``yaw`` in the base frame."""
        turn = yaw - math.pi / 2 - slew - self.w.profile.kinematics.theta1_offset_rad + math.pi / 2
        return (turn + math.pi / 2) % math.pi - math.pi / 2

    def pick(self, x: float, y: float, yaw: float, *, ground_z_m: float | None = None, raising: bool = True) -> None:
        """Grasp at (x, y) with the log's axis at ``yaw`` and lift; the grapple is open before."""
        ground = self.w.profile.workspace.ground_z_m if ground_z_m is None else ground_z_m
        over, up = ground + 2.3, ground + 3.1
        above = self.inverse((x, y, over))
        self.move({**above, "rot": self.rotator_for(yaw, above["slew"])})
        self.wait(0.8)
        low = ground + CLEARANCE_M + self.tip_below_pin(0.0)
        self.line((x, y, over), (x, y, low))
        self.wait(0.5)
        self.commands["grapple"] = -0.7
        z, still = low, 0
        for _ in range(round(8.0 / STEP_S)):
            angle = self.w.jaw_angle_rad
            if raising:
                deepest = max(self.tip_below_pin(angle + a) for a in (0.0, 0.05, 0.1, 0.15))
                wanted = ground + CLEARANCE_M + deepest
                z = max(z, min(wanted, z + 0.35 * STEP_S))
            self._follow((x, y, z))
            moving = abs(self.w.qd["tong_left"]) + abs(self.w.qd["tong_right"]) > 0.02
            still = 0 if moving or angle < 0.2 else still + 1
            if still > 0.3 / STEP_S:
                break
        self.commands["grapple"] = -0.2
        self.line((x, y, z), (x, y, up))
        self.wait(1.0)

    def place(self) -> None:
        """Carry to the middle of the bunk, lower, open, go up."""
        b = self.w.profile.bunk
        x, y, _ = from_bunk(b, (0.0, 0.0, 0.0))
        high, low = b.floor_z_m + 2.9, b.floor_z_m + 1.35
        above = self.inverse((x, y, high))
        self.move({**above, "rot": self.rotator_for(b.yaw_rad, above["slew"])})
        self.wait(1.0)
        self.line((x, y, high), (x, y, low))
        self.wait(0.5)
        self.commands["grapple"] = 1.0
        for _ in range(round(6.0 / STEP_S)):
            self.tick({})
            if self.w.jaw_angle_rad < 0.45:
                break
        self.commands["grapple"] = 0.0
        self.wait(0.5)
        self.line((x, y, low), (x, y, high))
        self.wait(1.0)
