"""A crude crane driver for plant tests: smooth references and a P law on the plant's true joints, spools out.

It is not the controller: it reads the plant directly and knows the plant's dead-bands.  ``Driver.pick`` and
``place`` take a log from the ground to the bunk.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import pairwise

from sim.crane import ACTIVE
from sim.logs import from_bunk
from sim.world import STEP_S, Spools, World

SPEED = {"slew": 0.40, "lift": 0.17, "tilt": 0.30, "ext": 0.25, "rot": 1.0}
KP = {"slew": 1.5, "lift": 3.0, "tilt": 3.0, "ext": 3.0, "rot": 3.0}
CLEARANCE_M = 0.02
Pin = tuple[float, float, float]


class Driver:
    """Moves one World; every method steps the physics until its motion is over."""

    def __init__(self, world: World, each_step: Callable[[], None] | None = None) -> None:
        self.w = world
        self.ref = {j: world.q[j] for j in SPEED}
        self.spools = Spools()
        self.each_step = each_step

    def inverse(self, pin: Pin) -> dict[str, float]:
        """Joint positions that put the hanger pin at ``pin``, the telescope kept in mid-range."""
        k = self.w.profile.kinematics
        x, y, z = pin
        reach, height = math.hypot(x, y) - k.a1_m, z - k.d1_m
        d = math.hypot(reach, height)
        ext = max(0.2, min(1.75, d - 4.6))
        forearm = math.hypot(k.a3_m, k.d4_m + ext)
        elbow = math.acos((k.a2_m**2 + forearm**2 - d * d) / (2 * k.a2_m * forearm))
        shoulder = math.acos((k.a2_m**2 + d * d - forearm**2) / (2 * k.a2_m * d))
        lift = math.atan2(height, reach) + shoulder - k.theta2_offset_rad
        bend = math.atan2(k.a3_m, k.d4_m + ext)  # the forearm line lies above the telescope's own axis
        tilt = elbow - math.pi - bend + math.pi / 2 - k.theta3_offset_rad
        return {"slew": math.atan2(-x, y), "lift": lift, "tilt": tilt, "ext": ext}

    def tick(self, rates: dict[str, float]) -> None:
        """One physics step towards the reference, with feed-forward ``rates``."""
        w, s = self.w, self.spools
        for joint, target in self.ref.items():
            v = rates.get(joint, 0.0) + KP[joint] * (target - w.q[joint])
            t = w.truth.valves[joint]
            full, band = (t.full_speed_plus, t.deadband_plus) if v > 0 else (t.full_speed_minus, t.deadband_minus)
            u = min(1.0, abs(v) / full)
            setattr(s, joint, 0.0 if abs(v) < 0.004 * full else math.copysign(band + (1 - band) * u, v))
        w.step(s)
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
        """Tong tips below the hanger pin [m] at a tong angle, from the profile's table."""
        table = self.w.profile.grapple.tongs
        pairs = list(zip(table.angle_rad, table.tip_below_pin_m, strict=True))
        for (a0, z0), (a1, z1) in pairwise(pairs):
            if angle <= a1:
                return z0 + (z1 - z0) * (angle - a0) / (a1 - a0)
        return pairs[-1][1]

    def pick(self, x: float, y: float, yaw: float, *, raising: bool = True) -> None:
        """Grasp at (x, y) with the log's axis at ``yaw`` and lift; the grapple is open before."""
        ground = self.w.profile.workspace.ground_z_m
        above = self.inverse((x, y, 0.9))
        rot = (yaw - math.pi / 2 - above["slew"] + math.pi / 2) % math.pi - math.pi / 2
        self.move({**above, "rot": rot})
        self.wait(0.8)
        low = ground + CLEARANCE_M + self.tip_below_pin(0.0)
        self.line((x, y, 0.9), (x, y, low))
        self.wait(0.5)
        self.spools.grapple = -0.7
        z, still = low, 0
        for _ in range(round(8.0 / STEP_S)):
            angle = self.w.tong_angle
            if raising:
                deepest = max(self.tip_below_pin(angle + a) for a in (0.0, 0.05, 0.1, 0.15))
                wanted = ground + CLEARANCE_M + deepest
                z = max(z, min(wanted, z + 0.35 * STEP_S))
            self._follow((x, y, z))
            moving = abs(self.w.qd["tong_left"]) + abs(self.w.qd["tong_right"]) > 0.02
            still = 0 if moving or angle < 0.2 else still + 1
            if still > 0.3 / STEP_S:
                break
        self.spools.grapple = -0.2
        self.line((x, y, z), (x, y, 1.7))
        self.wait(1.0)

    def place(self) -> None:
        """Carry to the middle of the bunk, lower, open, go up."""
        b = self.w.profile.bunk
        x, y, _ = from_bunk(b, (0.0, 0.0, 0.0))
        above = self.inverse((x, y, 1.9))
        rot = (b.yaw_rad - math.pi / 2 - above["slew"] + math.pi / 2) % math.pi - math.pi / 2
        self.move({**above, "rot": rot})
        self.wait(1.0)
        low = b.floor_z_m + 1.30
        self.line((x, y, 1.9), (x, y, low))
        self.wait(0.5)
        self.spools.grapple = 1.0
        for _ in range(round(6.0 / STEP_S)):
            self.tick({})
            if self.w.tong_angle < 0.45:
                break
        self.spools.grapple = 0.0
        self.wait(0.5)
        self.line((x, y, low), (x, y, 1.7))
        self.wait(1.0)
