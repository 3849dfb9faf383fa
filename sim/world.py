"""Machine, hydraulics, ground and logs in one physics client: spool commands in, motion out, 2.5 ms per step, no bus.

A grasp is frictional contact; no constraint ever connects grapple and log.  The torque of its cylinder or motor
drives every function.  Equal inputs give bit-identical results on one machine and build.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Final

import msgspec

from machine.profile import Profile
from sim.bullet.body import Body, JointDef, Pose, fixed_boxes, magnitude
from sim.bullet.client import GRAVITY_M_S2, new_client
from sim.geometry import IDENTITY, Vector
from sim.ground.terrain import Terrain
from sim.hydraulics.circuit import Hydraulics
from sim.mechanics.carrier import PARKED, Carrier, Drive, carrier_links
from sim.mechanics.crane import CRANE_LINKS, FLEX_JOINTS, PASSIVE_JOINTS, Column, crane_links, rigid_pin
from sim.truth.load import Truth, load_truth
from sim.wood.bunk import bunk_shapes
from sim.wood.log_shape import LogSpec
from sim.wood.logs import LogBodies, reach_m
from sim.wood.stowage import Stowage

STEP_NS: Final = 2_500_000
STEP_S: Final = STEP_NS * 1e-9
SOLVER_ITERATIONS: Final = 40
SETTLE_STEP_COUNT: Final = 240
CARRIER_SETTLE_STEP_COUNT: Final = 960
HAND_OVER_STEP_COUNT: Final = 80
SETTLE_DAMPING_S: Final = 0.06  # of the column, until everything is at rest
HOLDING_TORQUE: Final = 1e7  # [Nm, N] of the motors that hold the joints until everything is at rest
CONTACT_UPDATE_STEPS: Final = 4  # contacts are read every so many steps
JAW_LINKS: Final = ("tong_left", "tong_right")
GRAPPLE_LINKS: Final = (*JAW_LINKS, "rotator", "telescope", "stick")
JOINTS_OF_FUNCTION: Final = {"grapple": JAW_LINKS, "steer": ("articulation",)}


def home_pose(profile: Profile, truth: str = "nominal") -> dict[str, float]:
    """Return the joint positions in which the crane of a machine starts [rad, m].

    Raises:
        PlantError: there is no such truth for the machine.
    """
    return msgspec.structs.asdict(load_truth(truth, 0, profile.name).home)


class World:
    """The machine and its environment.  ``q`` and ``qd`` map joint names to position and velocity.

    Raises:
        PlantError: logs overlap or do not come to rest.
    """

    def __init__(
        self,
        profile: Profile,
        truth: Truth,
        seed: int,
        scene: Sequence[LogSpec],
        terrain: str = "flat",
        home: Mapping[str, float] | None = None,
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
        mobile = profile.carrier is not None
        ground = (terrain, seed, 0.0 if mobile else profile.workspace.ground_z_m, reach_m(scene))
        self.terrain = Terrain(*ground)
        self.terrain.add_to(p, truth.contact.ground_friction)
        self.crane = self._build()
        self.carrier = Carrier(p, self.crane.body, self.crane.index, profile, truth, self.terrain) if mobile else None
        self.hydraulics = Hydraulics(truth, STEP_S)
        self.functions: tuple[str, ...] = self.hydraulics.names
        self._grapple = self.functions.index("grapple")
        driven = [j for name in self.functions for j in JOINTS_OF_FUNCTION.get(name, (name,))]
        self._driven = tuple(driven)
        self._motors = [self.crane.index[j] for j in driven if j not in JAW_LINKS]
        self._motors += [self.crane.index[j] for j in (*JAW_LINKS, *FLEX_JOINTS)]
        self._hanger = self.crane.names.index("hanger")
        self._home = msgspec.structs.asdict(truth.home)
        self.column = self._level()
        self._settle(self._home | dict(home or {}))
        # The logs come to rest in a physics client of their own, which needs its own ground.
        self.log_bodies = LogBodies(p, profile, truth, scene, Terrain(*ground), self.base_pose())
        self._log_of = {body: i for i, body in enumerate(self.log_bodies.body_ids)}
        self._jaw_links = {self.crane.link[n] for n in JAW_LINKS}
        self._above = {self.crane.link[n] for n in CRANE_LINKS[1:]}  # the crane above its base
        self.max_penetration_m = 0.0
        self.grip_n = [0.0] * len(self.log_bodies.body_ids)
        self._touched = [False] * len(self.log_bodies.body_ids)
        self._steps = 0
        laden = mobile and any(log.in_bunk for log in scene)
        self._wait(CARRIER_SETTLE_STEP_COUNT if laden else HAND_OVER_STEP_COUNT)
        self._hand_over()
        self.stowage = (
            Stowage(p, self.crane, profile, GRAPPLE_LINKS, self.log_bodies, CONTACT_UPDATE_STEPS * STEP_S)
            if mobile
            else None
        )
        self._update_contacts()

    def _build(self) -> Body:
        profile, truth = self.profile, self.truth
        links, joints = crane_links(profile, truth)
        self._chain = joints
        bunk = tuple(bunk_shapes(profile))
        if profile.carrier is None:
            body = Body(self.client, links, joints, fixed=True)
            fixed_boxes(self.client, bunk, truth.contact.bunk_friction)
        else:
            c = profile.carrier
            under, wheels = carrier_links(profile, truth)
            under = [replace(u, shapes=(*u.shapes, *bunk)) if u.name == "rear" else u for u in under]
            foot = JointDef("foot", "fixed", "rear", "base", c.crane_base_m, (0.0, 0.0, c.crane_yaw_rad))
            body = Body(
                self.client,
                [*under, *links],
                [*wheels, foot, *joints],
                fixed=False,
                collides_with_itself=True,
            )
            body.collide_only(GRAPPLE_LINKS, ("rear", "front"))
            body.set_friction(["rear"], truth.contact.bunk_friction)
        for joint in PASSIVE_JOINTS:
            body.set_damping(joint, getattr(truth.structure, f"{joint}_damping_nm_s_rad"))
        body.set_friction((*JAW_LINKS, "rotator"), truth.contact.tong_friction)
        body.add_force_sensor("hanger")
        return body

    def _moments(self) -> tuple[float, float]:
        """Compute the moments of the weight about the column's hinges now [Nm]."""
        above = CRANE_LINKS[CRANE_LINKS.index("mast") :]
        crane = self.crane
        return (
            crane.gravity_moment("flex_pitch", (1.0, 0.0, 0.0), above, GRAVITY_M_S2),
            crane.gravity_moment("flex_roll", (0.0, 1.0, 0.0), above, GRAVITY_M_S2),
        )

    def _place(self, pose: Mapping[str, float]) -> None:
        """Put the crane at rest in a pose, jaws open, the grapple hanging plumb."""
        crane = {**dict.fromkeys((*FLEX_JOINTS, *PASSIVE_JOINTS, *JAW_LINKS), 0.0), **pose}
        hang = -(crane["lift"] + crane["tilt"] + crane["flex_pitch"])
        self.crane.place(crane | {"hanger": pose.get("hanger", hang)})

    def _level(self) -> Column:
        """Zero the encoders: at the home pose with an empty grapple the column stands plumb."""
        self._place(self._home)
        return Column(self.truth.structure, self._moments())

    def _settle(self, home: Mapping[str, float]) -> None:
        """Hold the joints with motors until the machine is at rest."""
        if self.carrier is not None:
            assert self.profile.carrier is not None
            self.carrier.place(0.0, 0.0, 0.0, self.profile.carrier.arm_transport_m)
        self._place(home)
        self._place({**home, **dict(zip(FLEX_JOINTS, self.column.balance(self._moments()), strict=True))})
        self._read()
        self.crane.hold(self._driven, HOLDING_TORQUE)
        self._wait(SETTLE_STEP_COUNT if self.carrier is None else CARRIER_SETTLE_STEP_COUNT)

    def _wait(self, steps: int) -> None:
        flex = [self.crane.index[j] for j in FLEX_JOINTS]
        for _ in range(steps):
            self.crane.apply(flex, self._column_torques(SETTLE_DAMPING_S))
            if self.carrier is not None:
                self.carrier.apply(PARKED)
            self.client.stepSimulation()
            self._read()

    def _hand_over(self) -> None:
        """Hand the load over from the motors to the hydraulics."""
        crane = self.crane
        carried = dict(zip(crane.names, (s[3] for s in crane.states()), strict=True))
        crane.hold(self._driven, 0.0)
        torques = [sum(carried[j] for j in JOINTS_OF_FUNCTION.get(name, (name,))) for name in self.functions]
        self.hydraulics.hold(torques, self._positions(self.q))

    def _read(self) -> None:
        states = self.crane.states()
        names = self.crane.names
        self.q = dict(zip(names, [s[0] for s in states], strict=True))
        self.qd = dict(zip(names, [s[1] for s in states], strict=True))
        self.hanging_n = magnitude(states[self._hanger][2])

    def _positions(self, q: Mapping[str, float]) -> list[float]:
        """Put joint positions (or velocities) in the order of ``functions``; the grapple's is the mean of its jaws."""
        out = [q[j] for j in self._driven]
        at = self._grapple
        out[at : at + 2] = [(out[at] + out[at + 1]) / 2]
        return out

    def _column_torques(self, extra_s: float = 0.0) -> list[float]:
        q, qd = self.q, self.qd
        return self.column.torques([q[j] for j in FLEX_JOINTS], [qd[j] for j in FLEX_JOINTS], extra_s)

    def step(self, commands: Sequence[float], drive: Drive = PARKED) -> None:
        """Advance by STEP_NS.

        ``commands`` are -1..1 of full spool in ``functions`` order (grapple: + opens); ``drive`` is the carrier's.
        """
        q, qd, s = self.q, self.qd, self.truth.structure
        torques = self.hydraulics.step(commands, self._positions(q), self._positions(qd))
        half = torques.pop(self._grapple) / 2
        # A rod couples the jaws; it is stiff, not rigid.
        rod = s.tong_sync_nm_rad * (q["tong_left"] - q["tong_right"])
        rod += s.tong_sync_nm_s_rad * (qd["tong_left"] - qd["tong_right"])
        self.crane.apply(self._motors, [*torques, half - rod, half + rod, *self._column_torques()])
        if self.carrier is not None:
            self.carrier.apply(drive)
        self.client.stepSimulation()
        self._read()
        self._steps += 1
        if self._steps % CONTACT_UPDATE_STEPS == 0:
            self._update_contacts()

    def _update_contacts(self) -> None:
        """Record which logs the crane touches."""
        n = len(self._log_of)
        touched, grip = [False] * n, [0.0] * n
        jaws, above = self._jaw_links, self._above
        for c in self.client.getContactPoints(bodyA=self.crane.body):
            log = self._log_of.get(c[2])
            if log is None:
                continue
            if c[3] in above:
                touched[log] = True
            if c[3] in jaws:
                grip[log] += c[9]
                if -c[8] > self.max_penetration_m:
                    self.max_penetration_m = -c[8]
        self._touched, self.grip_n = touched, grip
        if self.stowage is not None:
            self.stowage.watch()

    def touched(self) -> list[bool]:
        """Tell for each log whether the crane touches it; at most CONTACT_UPDATE_STEPS steps old."""
        return self._touched

    @property
    def jaw_angle_rad(self) -> float:
        """Mean angle of the jaws [rad], 0 open."""
        return (self.q["tong_left"] + self.q["tong_right"]) / 2

    @property
    def opening(self) -> float:
        """Grapple opening, 1 = fully open."""
        return max(0.0, min(1.0, 1.0 - self.jaw_angle_rad / self.profile.grapple.jaws.angle_rad[-1]))

    def link_poses(self) -> dict[str, Pose]:
        """Return the frames of all links in the world."""
        return self.crane.poses()

    def base_pose(self) -> Pose:
        """Return the crane's base frame in the world."""
        return self.crane.pose("base")

    def tip(self) -> Vector:
        """Return the true position of the hanger pin in the crane's base frame [m]."""
        pin, _ = self.crane.pose("hanger")
        if self.carrier is None:
            return pin
        inward = self.client.invertTransform(*self.base_pose())
        tip: Vector = self.client.multiplyTransforms(*inward, pin, IDENTITY)[0]
        return tip

    def rigid_tip(self) -> Vector:
        """Find the hanger pin in the crane's base frame with a rigid column: the reading of perfect encoders [m]."""
        return rigid_pin(self._chain, self.q)

    def load_kg(self) -> float:
        """Read a load cell at the hanger pin, less the empty grapple."""
        links = self.truth.links
        grapple = sum(links[n].mass_kg for n in ("hanger", "fork", "rotator")) + 2 * links["tong"].mass_kg
        return max(0.0, self.hanging_n / GRAVITY_M_S2 - grapple)

    def lean_rad(self) -> tuple[float, float]:
        """Measure the lean of the part above the rotator, which does not turn, from the vertical [rad].

        Outward of its pin in the crane's plane, and to the left.
        """
        _, turn = self.crane.pose("fork")
        x, y, z = self.client.getMatrixFromQuaternion(turn)[6:]  # the vertical, as that part has it
        return math.atan2(y, z), math.atan2(-x, z)

    def wheel_loads_n(self) -> tuple[float, ...]:
        """Return the wheel loads fl fr rl rr [N]; none on a fixed machine."""
        return () if self.carrier is None else tuple(self.carrier.wheel_loads_n)

    def close(self) -> None:
        """Release the physics client."""
        if self.client.isConnected():
            self.client.disconnect()


def open_world(
    profile: Profile,
    *,
    truth: str = "nominal",
    seed: int = 0,
    scene: Sequence[LogSpec] = (),
    terrain: str = "flat",
    home: Mapping[str, float] | None = None,
) -> World:
    """Open a World with a truth given by name (nominal, sampled, wide_valves or a TOML file)."""
    return World(profile, load_truth(truth, seed, profile.name), seed, scene, terrain, home)
