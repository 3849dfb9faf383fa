"""The plant: the physics world and the emulated CAN nodes behind one pure step, in place of the machine on the bus.

``Plant.step(now_ns, received)`` (of `sim.emulation.EmulatedMachine`) advances physics on a 2.5 ms grid.  It uses no
clock and no socket; equal inputs and seed give equal bytes.  ``PlantError``: the truth or the scene cannot be used.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from machine.joints import JOINTS
from machine.profile import Profile
from sim.emulation import COMMANDED, EmulatedMachine
from sim.errors import PlantError
from sim.evaluator import Evaluation, Evaluator
from sim.geometry import Quaternion, Shape, Vector
from sim.mechanics.carrier import PARKED, Drive, carrier_links
from sim.mechanics.crane import crane_shapes
from sim.mechanics.hand_levers import DRIVE, HandLevers
from sim.nodes.mach0 import ArmState
from sim.nodes.valve import ValveState
from sim.scenes.arrangements import arrangement, random_scene
from sim.truth.load import Truth, load_truth
from sim.wood.bunk import bunk_shapes
from sim.wood.log_shape import LogSpec
from sim.wood.logs import LogState
from sim.world import STEP_NS, World


@dataclass(frozen=True, slots=True)
class VehicleState:
    """Ground truth of the carrier.  Pose of the rear half and heading of the front half in the world (0 east, + left);
    roll (+ right side down) and pitch (+ nose up) of the rear half; heights and loads in the order fl, fr, rl, rr.
    """

    position_m: Vector
    quaternion: Quaternion
    heading_rad: float
    roll_rad: float
    pitch_rad: float
    speed_m_s: float
    articulation_rad: float
    arm_heights_m: tuple[float, ...]
    wheel_loads_n: tuple[float, ...]


class Plant(EmulatedMachine):
    """The whole machine: the nodes, and the physics in ``world``.  Public names give test harnesses the ground truth.

    ``scene`` is the name of an arrangement of ``logs`` logs, or the logs themselves; by default they lie at random.
    ``home``: joint positions [rad, m] at the start that differ from the truth's.
    """

    def __init__(
        self,
        profile: Profile,
        seed: int = 0,
        truth: str = "nominal",
        logs: int = 1,
        *,
        scene: str | Sequence[LogSpec] | None = None,
        terrain: str = "flat",
        home: Mapping[str, float] | None = None,
    ) -> None:
        facts = load_truth(truth, seed, profile.name)
        self.world = World(profile, facts, seed, _scene(profile, facts, seed, logs, scene), terrain, home)
        self._evaluator = Evaluator(self.world)
        self._floats = (False, False)
        # Commands arrive in the order of the nodes; the world has an order of its own.
        self._by_function = [COMMANDED.index(name) for name in self.world.functions]
        self._levers = HandLevers(self.world.functions, self.world.carrier is not None)
        super().__init__(profile, facts, seed, self.world, STEP_NS)

    def _move(self, now_ns: int) -> None:
        self.world.step(*self._decide(now_ns))
        self._evaluator.watch()

    def _decide(self, now_ns: int) -> tuple[list[float], Drive]:
        """Return the commands of the nodes and hand levers to the valves and the drive in this step."""
        commands = self._spools(now_ns)
        drive = PARKED
        if self.vehicle_node is not None and self.arms is not None:
            self._float((self.arms.float_front, self.arms.float_rear))
            drive = Drive(self.vehicle_node.drive_m_s, self.vehicle_node.brake)
        held = self._levers.held(now_ns)
        if held and self.estop.relay_on and not self._commanded():
            if DRIVE in held and self.profile.carrier is not None:
                drive = Drive(held.pop(DRIVE) * self.profile.carrier.cruise_speed_m_s)
            for name, position in held.items():
                commands[COMMANDED.index(name)] = position
        return [commands[i] for i in self._by_function], drive

    def _float(self, wanted: tuple[bool, bool]) -> None:
        """Open or close the float valves of both axles; the two are never open together, not even within a step."""
        if wanted != self._floats:
            self._floats, valves = wanted, self.world.hydraulics
            valves.float_front = valves.float_rear = False
            valves.float_front, valves.float_rear = wanted

    def _commanded(self) -> bool:
        """Tell whether a controller moves the machine over the bus."""
        carried = self.vehicle_node is not None and self.vehicle_node.active
        raised = self.arms is not None and self.arms.state is ArmState.ACTIVE
        return self.valve.valve_state is ValveState.ACTIVE or carried or raised

    def lever(self, name: str, value: float) -> None:
        """Hold a hand lever (``world.functions``, and ``drive``) at -1..1 for 0.3 s.

        Raises:
            PlantError: there is no such lever or position, or a controller moves the machine.
        """
        if self._commanded():
            raise PlantError(
                "lever.controller-active",
                "a controller moves the machine over the bus; disarm it before you pull a lever",
            )
        self._levers.pull(name, value, self._time_ns or 0)

    def levers(self) -> tuple[str, ...]:
        """Return the names of the hand levers."""
        return self._levers.names

    def logs(self) -> list[LogState]:
        """Return the ground truth of all logs, in the world frame."""
        return self.world.log_bodies.states()

    def joint_positions(self) -> tuple[float, ...]:
        """Return the true joint positions in ``Joint`` order [rad, m]."""
        return tuple(self.world.q[j.name.lower()] for j in JOINTS)

    def jaw_angle_rad(self) -> float:
        """Return the true mean angle of the jaws [rad], 0 open."""
        return self.world.jaw_angle_rad

    def link_poses(self) -> dict[str, tuple[Vector, Quaternion]]:
        """Return the link frames in the world frame: position [m] and quaternion (x, y, z, w)."""
        return self.world.link_poses()

    def base_pose(self) -> tuple[Vector, Quaternion]:
        """Return the crane's base frame in the world frame; identity for a machine on a fixed base."""
        return self.world.base_pose()

    def shapes(self) -> list[Shape]:
        """Return the boxes to draw, in the frames of their links (crane, bunk, carrier)."""
        under = carrier_links(self.profile, self.world.truth)[0] if self.world.carrier is not None else []
        crane = crane_shapes(self.profile, self.world.truth.steel)
        return [*(s for link in under for s in link.shapes), *crane, *bunk_shapes(self.profile)]

    def vehicle(self) -> VehicleState | None:
        """Return the ground truth of the carrier; None on a machine without one."""
        c = self.world.carrier
        if c is None:
            return None
        position, turn = c.pose("rear")
        return VehicleState(
            position,
            turn,
            c.heading_rad,
            c.roll_rad,
            -c.pitch_rad,
            c.speed_m_s,
            c.articulation_rad,
            tuple(c.arm_heights_m),
            tuple(self.world.wheel_loads_n()),
        )

    def tip(self) -> Vector:
        """Return the true position of the hanger pin in the crane's base frame [m]."""
        return self.world.tip()

    def evaluate(self) -> Evaluation:
        """Return the evaluation of the run up to now."""
        return self._evaluator.evaluate()

    def close(self) -> None:
        """Release the physics client."""
        self.world.close()


def _scene(
    profile: Profile, facts: Truth, seed: int, logs: int, scene: str | Sequence[LogSpec] | None
) -> Sequence[LogSpec]:
    if scene is None or scene == "random":
        return random_scene(profile, facts.wood, seed, logs)
    return arrangement(scene, profile, facts.wood, seed, logs) if isinstance(scene, str) else scene
