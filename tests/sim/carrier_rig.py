"""The carrier alone in a physics client: the crane is a mass on its foot; speed motors drive steering and arms."""

from __future__ import annotations

import tempfile
from pathlib import Path
from types import SimpleNamespace

import msgspec

import sim.truth
from machine.geometry import carrier as geometry
from machine.loading.profile_file import load_profile
from sim.bullet.body import JointDef, LinkDef, urdf_text
from sim.bullet.client import new_client
from sim.ground.terrain import Terrain
from sim.mechanics.carrier import CARRIER_JOINTS, PARKED, Carrier, Drive, carrier_links
from sim.truth.body import CarrierTruth

STEP_S = 0.0025
GRAVITY = 9.81
PROFILE = load_profile("aoro_fc8")
FILE = Path(sim.truth.__file__).with_name("nominal_aoro_fc8.toml")
CRANE_KG, CRANE_ABOVE_M = 1285.0, 1.6
ARM_KP = 4.0


def carrier_truth(**changes: float) -> CarrierTruth:
    """The nominal carrier with some figures changed."""
    nominal = msgspec.convert(msgspec.toml.decode(FILE.read_bytes())["carrier"], CarrierTruth)
    return msgspec.structs.replace(nominal, **changes)


class Rig:
    """One carrier on one terrain; ``step`` advances 2.5 ms."""

    def __init__(
        self,
        terrain: Terrain | None = None,
        truth: CarrierTruth | None = None,
        height_m: float = 0.35,
        heading_rad: float = 0.0,
        at: tuple[float, float] = (0.0, 0.0),
    ) -> None:
        self.terrain = terrain or Terrain("flat")
        self.truth = truth or carrier_truth()
        self.client = p = new_client()
        p.setGravity(0.0, 0.0, -GRAVITY)
        p.setPhysicsEngineParameter(fixedTimeStep=STEP_S, numSolverIterations=40, numSubSteps=0)
        self.terrain.add_to(p, 1.0)
        links, joints = carrier_links(PROFILE, SimpleNamespace(carrier=self.truth))
        links.append(LinkDef("base", CRANE_KG, (0.0, 0.0, CRANE_ABOVE_M), (900.0, 900.0, 200.0)))
        joints.append(JointDef("base", "fixed", "rear", "base", origin_m=PROFILE.carrier.crane_base_m))
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "carrier.urdf"
            path.write_text(urdf_text("carrier", links, joints))
            p.setPhysicsEngineParameter(enableFileCaching=0)
            flags = p.URDF_USE_INERTIA_FROM_FILE | p.URDF_MAINTAIN_LINK_ORDER
            self.body = p.loadURDF(str(path), flags=flags)
        names = [p.getJointInfo(self.body, i)[1].decode() for i in range(p.getNumJoints(self.body))]
        self.index = {name: i for i, name in enumerate(names)}
        self.carrier = Carrier(p, self.body, self.index, PROFILE, SimpleNamespace(carrier=self.truth), self.terrain)
        self.mass_kg = sum(p.getDynamicsInfo(self.body, i)[0] for i in range(-1, len(names)))
        self.carrier.place(*at, heading_rad, height_m)
        self.goal = dict.fromkeys(geometry.ARMS, height_m)
        self.steer_rad = 0.0
        self.floating = False
        self.push: tuple[list[float], list[float]] | None = None  # force [N] on the crane's foot at a point, world

    def step(self, drive: Drive = PARKED) -> None:
        """One physics step; with ``floating`` the front arms carry equal loads, as with connected cylinders."""
        p, c = self.client, PROFILE.carrier
        q = {name: p.getJointState(self.body, self.index[name])[0] for name in CARRIER_JOINTS}
        rate = max(-0.25, min(0.25, 5.0 * (self.steer_rad - q["articulation"])))
        self._motor("articulation", rate, 2e5)
        even = (q["arm_fl"] - q["arm_fr"]) / 2 if self.floating else 0.0
        for name in geometry.ARMS:
            goal = geometry.arm_angle_from_height(c, self.goal[name])
            shift = {"arm_fl": even, "arm_fr": -even}.get(name, 0.0)
            speed = max(-0.15, min(0.15, ARM_KP * (goal - q[name] + shift)))
            if self.floating and name[4] == "f":
                self._motor(name, 0.0, 0.0)
                mean = (q["arm_fl"] + q["arm_fr"]) / 2
                rate = sum(p.getJointState(self.body, self.index[n])[1] for n in ("arm_fl", "arm_fr")) / 2
                p.setJointMotorControl2(
                    self.body, self.index[name], p.TORQUE_CONTROL, force=22000.0 + 4e5 * (goal - mean) - 3e4 * rate
                )
            else:
                self._motor(name, speed, 1e5)
        self.carrier.apply(drive)
        if self.push:
            p.applyExternalForce(self.body, self.index["base"], *self.push, p.WORLD_FRAME)
        p.stepSimulation()

    def run(self, seconds: float, drive: Drive = PARKED) -> None:
        """Steps for a time."""
        for _ in range(round(seconds / STEP_S)):
            self.step(drive)

    def _motor(self, name: str, speed: float, force: float) -> None:
        self.client.setJointMotorControl2(
            self.body, self.index[name], self.client.VELOCITY_CONTROL, targetVelocity=speed, force=force
        )

    def centre(self) -> tuple[float, float, float]:
        """Centre of mass in the world."""
        p, total = self.client, [0.0, 0.0, 0.0]
        for i in range(-1, p.getNumJoints(self.body)):
            at = p.getBasePositionAndOrientation(self.body)[0] if i < 0 else p.getLinkState(self.body, i)[0]
            total = [t + p.getDynamicsInfo(self.body, i)[0] * a for t, a in zip(total, at, strict=True)]
        x, y, z = (t / self.mass_kg for t in total)
        return x, y, z

    def close(self) -> None:
        """Release the client."""
        self.client.disconnect()
