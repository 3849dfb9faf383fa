"""Crane, hydraulics and yard in one physics client: spool commands in, motion out, 2.5 ms a step, no bus.

A grasp is frictional contact; no constraint is ever made between grapple and log.  Bit-identical for equal inputs on
one machine and build.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from machine.profile import Profile
from sim.crane import ACTIVE, JOINTS, TONG_CLOSED_RAD, Crane, Vector
from sim.hydraulics import Hydraulics, ValveSpool
from sim.logs import Yard
from sim.physics import new_client
from sim.scene import random_scene
from sim.truth import Truth

STEP_NS: Final = 2_500_000
STEP_S: Final = STEP_NS * 1e-9
SOLVER_ITERATIONS: Final = 40
HOME: Final = {"slew": 0.0, "lift": 0.75, "tilt": -1.6, "ext": 0.30, "rot": 0.0}
SETTLE_STEPS: Final = 200
PRESSURE_LAG_S: Final = 0.03  # oil and hoses between tong torque and its transducer
GRAVITY_M_S2: Final = 9.81


@dataclass(slots=True)
class Spools:
    """Valve commands, -1..1 of full spool; ``grapple`` + opens."""

    slew: float = 0.0
    lift: float = 0.0
    tilt: float = 0.0
    ext: float = 0.0
    rot: float = 0.0
    grapple: float = 0.0


class World:
    """The machine and its surroundings.  ``q`` and ``qd`` map joint names to position and velocity."""

    def __init__(
        self, profile: Profile, truth: Truth, seed: int, logs: int, home: dict[str, float] | None = None
    ) -> None:
        self.profile, self.truth = profile, truth
        self.client = p = new_client()
        p.setGravity(0.0, 0.0, -GRAVITY_M_S2)
        p.setPhysicsEngineParameter(
            fixedTimeStep=STEP_S,
            numSolverIterations=SOLVER_ITERATIONS,
            numSubSteps=0,
            enableConeFriction=1,
            deterministicOverlappingPairs=1,
        )
        self.yard = Yard(p, profile, truth.contact, random_scene(profile, truth.contact, seed, logs))
        self.crane = Crane(p, profile, truth)
        self.hydraulics = Hydraulics(truth, STEP_S)
        self._rot = ValveSpool(truth.valves["rot"], STEP_S)
        self._grapple = ValveSpool(truth.valves["grapple"], STEP_S)
        # Spools of slew, lift, tilt, ext, rot, grapple.
        self.spools = (*(a.spool for a in self.hydraulics.actuators), self._rot, self._grapple)
        self.grapple_torque = 0.0
        self.hanging_n = 0.0
        self.max_penetration_m = 0.0
        self._settle(HOME if home is None else home)

    def _settle(self, home: dict[str, float]) -> None:
        """Hold the joints by motors until all is at rest, then hand the load to the cylinders."""
        self.crane.place(home)
        for _ in range(SETTLE_STEPS):
            for joint in (*ACTIVE, "rot", "tong_left", "tong_right"):
                self.crane.drive(joint, 0.0, 1e6)
            self.client.stepSimulation()
        self._read()
        for actuator, joint in zip(self.hydraulics.actuators, ACTIVE, strict=True):
            actuator.hold(self.crane.motor_torque(joint), self.q[joint])
            self.crane.drive(joint, 0.0, 0.0)

    def _read(self) -> None:
        q, qd = self.crane.states()
        self.q, self.qd = dict(zip(JOINTS, q, strict=True)), dict(zip(JOINTS, qd, strict=True))

    def step(self, spools: Spools) -> None:
        """Advance by STEP_NS."""
        crane, q, qd = self.crane, self.q, self.qd
        commands = [spools.slew, spools.lift, spools.tilt, spools.ext]
        torques = self.hydraulics.step(commands, [q[j] for j in ACTIVE], [qd[j] for j in ACTIVE])
        crane.apply_torques(torques)
        valves, motors = self.truth.valves, self.truth.motors
        opening = self._rot.advance(self._rot.delayed(spools.rot), STEP_S)
        speed = opening * (valves["rot"].full_speed_plus if opening > 0.0 else valves["rot"].full_speed_minus)
        crane.drive("rot", speed, motors.rotator_torque_nm)
        opening = self._grapple.advance(self._grapple.delayed(spools.grapple), STEP_S)
        rate = valves["grapple"].full_speed_plus if opening > 0.0 else valves["grapple"].full_speed_minus
        close, apart = -opening * rate, motors.tong_sync_1_s * (q["tong_left"] - q["tong_right"]) / 2
        crane.drive("tong_left", close - apart, motors.tong_torque_nm)
        crane.drive("tong_right", close + apart, motors.tong_torque_nm)
        self.client.stepSimulation()
        self._read()
        torque = (crane.motor_torque("tong_left") + crane.motor_torque("tong_right")) / 2
        self.grapple_torque += STEP_S / PRESSURE_LAG_S * (torque - self.grapple_torque)
        self.hanging_n = crane.hanging_force()
        self._watch_contacts()

    def _watch_contacts(self) -> None:
        p, tongs = self.client, (self.crane.link["tong_left"], self.crane.link["tong_right"])
        for log in self.yard.logs:
            for c in p.getContactPoints(self.crane.body, log):
                if c[3] in tongs:
                    self.max_penetration_m = max(self.max_penetration_m, -c[8])

    @property
    def tong_angle(self) -> float:
        """Mean tong angle [rad], 0 open."""
        return (self.q["tong_left"] + self.q["tong_right"]) / 2

    @property
    def opening(self) -> float:
        """Grapple opening, 1 = fully open."""
        return max(0.0, min(1.0, 1.0 - self.tong_angle / TONG_CLOSED_RAD))

    @property
    def grapple_pressures_pa(self) -> tuple[float, float]:
        """Closing and opening side of the grapple, from the tong motors' torque."""
        m = self.truth.motors
        share = self.grapple_torque / m.tong_torque_nm * m.tong_pressure_pa
        tank = self.truth.supply.tank_pa
        return max(tank, share), max(tank, -share)

    def tip(self) -> Vector:
        """True position of the hanger pin in the base frame."""
        return self.crane.link_poses()["hanger"][0]

    def load_kg(self) -> float:
        """What a load cell at the hanger pin shows beyond the empty grapple."""
        hanging = sum(self.truth.links[n].mass_kg for n in ("hanger", "fork", "rotator"))
        return max(0.0, self.hanging_n / GRAVITY_M_S2 - hanging - 2 * self.truth.links["tong"].mass_kg)

    def touched(self) -> list[bool]:
        """For each log, whether the crane touches it."""
        return [bool(self.client.getContactPoints(self.crane.body, log)) for log in self.yard.logs]

    def close(self) -> None:
        """Release the physics client."""
        if self.client.isConnected():
            self.client.disconnect()
