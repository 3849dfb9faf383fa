"""A world without physics: every function moves exactly as its valve's map in the profile says, and the carrier rolls.

It serves as a calibration rig: the same nodes on the same buses for a few multiplications per step.  The hydraulics
show fixed pressures.  The grapple opens and closes with its times of the profile.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping, Sequence
from typing import Final

from machine.geometry.carrier import (
    ARMS,
    arm_angle_from_height,
    heading_rate_rad_s,
    height_from_arm_angle,
    pivot_height_m,
)
from machine.joints import JOINTS
from machine.profile import Carrier, CarrierValve, Profile, Valve
from sim.emulation import EmulatedMachine
from sim.geometry import Quaternion, Vector, rpy_quaternion
from sim.nodes.valve import CYCLE_NS, FUNCTIONS
from sim.truth.load import Truth, load_truth

# -- A carrier that rolls without slip on a level plane: the kinematic world's replacement for the physical carrier.
#
# Its speed follows the vehicle node with limited acceleration, its heading follows the articulation, and its height
# the arms.  Frames and names as in `sim.mechanics.carrier`; SI units.


ACCELERATION_M_S2: Final = 0.8
BRAKE_M_S2: Final = 3.0


class RollingCarrier:
    """``x_m``, ``y_m`` and ``heading_rad`` are of the front axle; ``q`` holds the articulation and the arms."""

    def __init__(self, carrier: Carrier, q: Mapping[str, float], qd: Mapping[str, float]) -> None:
        self._c, self._q, self._qd = carrier, q, qd
        self.x_m, self.y_m, self.heading_rad, self.speed_m_s = carrier.front_axle_m, 0.0, 0.0, 0.0

    def step(self, speed_m_s: float, brake: bool, step_s: float) -> None:
        """Take one step towards the requested speed of the front axle."""
        change = (BRAKE_M_S2 if brake else ACCELERATION_M_S2) * step_s
        target_speed_m_s = 0.0 if brake else speed_m_s
        self.speed_m_s += max(-change, min(change, target_speed_m_s - self.speed_m_s))
        rate = heading_rate_rad_s(self._c, self.speed_m_s, self._q["articulation"], self._qd["articulation"])
        self.heading_rad += rate * step_s
        self.x_m += self.speed_m_s * math.cos(self.heading_rad) * step_s
        self.y_m += self.speed_m_s * math.sin(self.heading_rad) * step_s

    @property
    def wheel_speeds_rad_s(self) -> tuple[float, ...]:
        """Equal for all wheels."""
        return (self.speed_m_s / self._c.wheel_radius_m,) * len(ARMS)

    @property
    def articulation_rad(self) -> float:
        """Angle of the front against the rear, + left."""
        return self._q["articulation"]

    @property
    def arm_heights_m(self) -> tuple[float, ...]:
        """How far each arm raises the frame."""
        return tuple(height_from_arm_angle(self._c, self._q[arm]) for arm in ARMS)

    def front_axle(self) -> Vector:
        """Return the middle of the front axle, between the hubs."""
        return self.x_m, self.y_m, self._c.wheel_radius_m

    def attitude(self, half: str) -> Vector:
        """Return roll, pitch and heading of ``rear`` or ``front``."""
        return 0.0, 0.0, self.heading_rad - (self.articulation_rad if half == "rear" else 0.0)

    def pose(self, half: str) -> tuple[Vector, Quaternion]:
        """Return the frame of ``rear`` or ``front`` in the world: both lie on the articulation's axis."""
        ahead = self._c.front_axle_m
        up = pivot_height_m(self._c, sum(self.arm_heights_m) / len(ARMS))
        x, y = self.x_m - ahead * math.cos(self.heading_rad), self.y_m - ahead * math.sin(self.heading_rad)
        return (x, y, up), rpy_quaternion(*self.attitude(half))


# -- A world without physics


REST_PA = 1.0e6
PUMP_PA = 18.0e6
START_SHARE = 0.5
"""Share of its range at which every joint starts; the boom is raised and bent there."""


class _FixedPressures:
    """Hydraulics with fixed pressures; ``spools`` by function, -1..1."""

    supply_pa = PUMP_PA
    energy_j = 0.0
    flow_limited = False

    def __init__(self) -> None:
        self.spools = dict.fromkeys(FUNCTIONS, 0.0)
        self.pressures_pa = dict.fromkeys(FUNCTIONS, (REST_PA, REST_PA))


class _ValveModel:
    """Dead time, dead-band and gain of one valve."""

    def __init__(self, valve: Valve | CarrierValve, sign: int, step_ns: int) -> None:
        self._dead = (valve.deadband_minus_pct / 100.0, valve.deadband_plus_pct / 100.0)
        self._full = (-valve.full_speed_minus, valve.full_speed_plus)
        self._sign = sign
        self._line = deque([0.0] * max(1, round(valve.delay_s * 1e9 / step_ns)))

    def speed(self, command: float) -> float:
        """Compute the speed of the joint in this step; ``command`` is -1..1 of the spool."""
        self._line.append(command * self._sign)
        spool = self._line.popleft()
        dead = self._dead[spool > 0.0]
        return self._full[spool > 0.0] * max(0.0, abs(spool) - dead) / (1.0 - dead)


class KinematicWorld:
    """Joints that integrate their valves' speeds (`sim.emulation.SensedWorld`)."""

    def __init__(self, profile: Profile, truth: Truth, step_ns: int) -> None:
        self.profile, self.truth = profile, truth
        self.hydraulics = _FixedPressures()
        self.carrier: RollingCarrier | None = None
        self.opening = 1.0
        self._step_s = step_ns * 1e-9
        joints = {j.name.lower(): profile.joints[j.name.lower()] for j in JOINTS}
        self._functions = {name: _ValveModel(spec.valve, spec.valve.sign, step_ns) for name, spec in joints.items()}
        self._range = {name: (spec.lower, spec.upper) for name, spec in joints.items()}
        self.q = {name: low + START_SHARE * (high - low) for name, (low, high) in self._range.items()}
        self._range |= {name: (-math.inf, math.inf) for name in joints if truth.functions[name].cylinder.endless}
        if profile.carrier is not None:
            c = profile.carrier
            self._functions["articulation"] = _ValveModel(c.steer_valve, 1, step_ns)
            self._range["articulation"] = (-c.articulation_limit_rad, c.articulation_limit_rad)
            self.q["articulation"] = 0.0
            self._arms = [_ValveModel(c.arm_valve, 1, step_ns) for _ in ARMS]
            self.q |= dict.fromkeys(ARMS, arm_angle_from_height(c, c.arm_transport_m))
        self.qd = dict.fromkeys(self.q, 0.0)
        if profile.carrier is not None:
            self.carrier = RollingCarrier(profile.carrier, self.q, self.qd)

    def load_kg(self) -> float:
        return 0.0

    def lean_rad(self) -> tuple[float, float]:
        return 0.0, 0.0

    def step(self, commands: Sequence[float], speed_m_s: float = 0.0, brake: bool = True) -> None:
        """Advance by one step.

        ``commands`` are -1..1: `FUNCTIONS`, then on a carrier steering and `ARMS`.  ``speed_m_s`` and ``brake`` are the
        request to its drive.
        """
        by_name = dict(zip(FUNCTIONS, commands, strict=False))
        self.hydraulics.spools = by_name
        if self.carrier is not None:
            by_name = by_name | {"articulation": commands[len(FUNCTIONS)]}
            self._raise(commands[len(FUNCTIONS) + 1 :])
        for name, function in self._functions.items():
            self._turn(name, function.speed(by_name[name]))
        if self.carrier is not None:
            self.carrier.step(speed_m_s, brake, self._step_s)
        times = (self.profile.grapple.close_time_s, self.profile.grapple.open_time_s)
        grapple = by_name["grapple"]
        self.opening = min(1.0, max(0.0, self.opening + grapple * self._step_s / times[grapple > 0.0]))

    def _turn(self, name: str, speed: float) -> None:
        low, high = self._range[name]
        after = min(high, max(low, self.q[name] + speed * self._step_s))
        self.qd[name], self.q[name] = speed if low < after < high else 0.0, after

    def _raise(self, commands: Sequence[float]) -> None:
        c = self.profile.carrier
        assert c is not None
        for arm, function, command in zip(ARMS, self._arms, commands, strict=True):
            height_m = height_from_arm_angle(c, self.q[arm]) + function.speed(command) * self._step_s
            after = arm_angle_from_height(c, min(c.arm_travel_m, max(0.0, height_m)))
            self.qd[arm], self.q[arm] = (after - self.q[arm]) / self._step_s, after


class KinematicMachine(EmulatedMachine):
    """All nodes of a machine around a `KinematicWorld`."""

    def __init__(
        self, profile: Profile, seed: int, truth: str = "nominal", *, step_ns: int, cycle_ns: int = CYCLE_NS
    ) -> None:
        facts = load_truth(truth, seed, profile.name)
        self.world = KinematicWorld(profile, facts, step_ns)
        super().__init__(profile, facts, seed, self.world, step_ns, cycle_ns)

    def _move(self, now_ns: int) -> None:
        spools, vehicle = self._spools(now_ns), self.vehicle_node
        drive = () if vehicle is None else (vehicle.drive_m_s, vehicle.brake)
        self.world.step(spools, *drive)

    def joint_positions(self) -> tuple[float, ...]:
        """Return the positions in ``Joint`` order [rad, m]; the rotator's is not wrapped to one turn."""
        return tuple(self.world.q[j.name.lower()] for j in JOINTS)
