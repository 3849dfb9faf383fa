"""Logs as bodies: they are still at the start, taper and bow have an effect, a bunk holds them, a touch wakes them."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

import pytest

from experiments.common.worlds import trial_world
from experiments.plant.runs import record
from machine.loading.profile_file import load_profile
from sim.bullet.client import BulletClient, new_client
from sim.errors import PlantError
from sim.geometry import IDENTITY
from sim.ground.terrain import Terrain
from sim.scenes.arrangements import arrangement
from sim.truth.load import load_truth
from sim.wood.bunk import bunk_link, bunk_shapes, from_bunk, to_bunk
from sim.wood.log_shape import LogSpec, mass_of
from sim.wood.logs import LogBodies
from tests.codes import coded

MACHINES = ("palms_471", "aoro_fc8")
PROFILES = {name: load_profile(name) for name in MACHINES}
TRUTHS = {name: load_truth("nominal", 0, name) for name in MACHINES}
STEP_S = 0.0025


class Stand:
    """Logs on ground of their own, without a machine; the bunk stands at ``base``."""

    def __init__(self, scene: tuple[LogSpec, ...], machine: str = "palms_471", kind: str = "flat") -> None:
        profile, truth = PROFILES[machine], TRUTHS[machine]
        ground = (kind, 0, profile.workspace.ground_z_m if profile.carrier is None else 0.0)
        self.base = ((0.0, 0.0, 0.0), IDENTITY) if profile.carrier is None else ((0.0, 0.0, 1.4), IDENTITY)
        self.client: BulletClient = new_client()
        self.client.setGravity(0.0, 0.0, -9.81)
        self.client.setPhysicsEngineParameter(
            fixedTimeStep=STEP_S, numSolverIterations=40, enableConeFriction=1, deterministicOverlappingPairs=1
        )
        self.terrain = Terrain(*ground)
        self.terrain.add_to(self.client, truth.contact.ground_friction)
        if profile.carrier is None:
            self._boxes(profile, truth)
        self.log_bodies = LogBodies(self.client, profile, truth, scene, Terrain(*ground), self.base)

    def _boxes(self, profile, truth) -> None:
        p = self.client
        for s in bunk_shapes(profile):
            shape = p.createCollisionShape(p.GEOM_BOX, halfExtents=[x / 2 for x in s.size_m])
            box = p.createMultiBody(0.0, shape, basePosition=s.position_m, baseOrientation=s.quaternion)
            p.changeDynamics(box, -1, lateralFriction=truth.contact.bunk_friction)

    def awake(self) -> None:
        """Let no log sleep, whatever it does."""
        for log in self.log_bodies.body_ids:
            self.client.changeDynamics(log, -1, activationState=self.client.ACTIVATION_STATE_DISABLE_SLEEPING)

    def fastest(self, seconds: float) -> float:
        top = 0.0
        for i in range(round(seconds / STEP_S)):
            self.client.stepSimulation()
            if i % 20 == 0:
                top = max(top, max(log.speed_m_s for log in self.log_bodies.states()))
        return top


@pytest.fixture
def stand_of() -> Iterator[Callable[..., Stand]]:
    """Makes stands."""
    made: list[Stand] = []

    def make(*arguments: object) -> Stand:
        made.append(Stand(*arguments))
        return made[-1]

    yield make
    for stand in made:
        stand.client.disconnect()


def of(kind: str, seed: int, logs: int, machine: str = "palms_471") -> tuple[LogSpec, ...]:
    return arrangement(kind, PROFILES[machine], TRUTHS[machine].wood, seed, logs)


@pytest.mark.parametrize(
    ("kind", "logs", "machine"),
    [("separate", 3, "palms_471"), ("crossed", 3, "palms_471"), ("pile", 6, "palms_471"), ("pile", 5, "aoro_fc8")],
)
def test_logs_are_still_at_the_start_and_overlap_nothing(stand_of, kind, logs, machine):
    for seed in range(2):
        stand = stand_of(of(kind, seed, logs, machine), machine)
        stand.client.performCollisionDetection()
        assert all(c[8] > -0.003 for log in stand.log_bodies.body_ids for c in stand.client.getContactPoints(log))
        before = [log.position_m for log in stand.log_bodies.states()]
        assert stand.fastest(1.0) < 5e-3
        after = [log.position_m for log in stand.log_bodies.states()]
        assert max(math.dist(a, b) for a, b in zip(before, after, strict=True)) < 2e-3


def test_a_pile_is_stable_without_sleep(stand_of):
    stand = stand_of(of("pile", 0, 6))
    stand.awake()
    assert stand.fastest(3.0) < 5e-3


@pytest.mark.long
@pytest.mark.parametrize(("kind", "logs"), [("separate", 3), ("bunk", 20)])
def test_logs_rest_for_a_minute(stand_of, kind, logs):
    stand = stand_of(of(kind, 1, logs))
    assert stand.fastest(60.0) < 5e-3


@pytest.mark.long
@pytest.mark.parametrize(("kind", "logs"), [("pile", 6), ("bunk", 8)])
def test_woken_logs_beside_a_crane_rest_for_a_minute_and_kept_awake_for_another(kind, logs):
    with trial_world("palms_471", "nominal", 300_000, kind, logs) as w:
        p, bodies = w.client, w.log_bodies
        bodies.wake()
        for awake in (False, True):
            for log in bodies.body_ids if awake else ():
                p.changeDynamics(log, -1, activationState=p.ACTIVATION_STATE_DISABLE_SLEEPING)
            before = [log.position_m for log in bodies.states()]
            speeds = record(w, 60.0, lambda: max(log.speed_m_s for log in bodies.states()))
            assert max(speeds) < 5e-3
            assert max(math.dist(a, log.position_m) for a, log in zip(before, bodies.states(), strict=True)) < 5e-3


def test_the_same_scene_comes_to_rest_in_the_same_place_to_the_bit(stand_of):
    one, two = (stand_of(of("pile", 4, 5)).log_bodies.states() for _ in range(2))
    assert one == two


def test_a_tapered_log_rests_with_its_axis_falling_to_the_thin_end_and_a_bowed_one_on_its_side(stand_of):
    stand = stand_of((LogSpec(-2.0, 4.0, 0.3, 2.6, 0.2, 600.0, 0.012, 0.02, z_m=0.004, roll_rad=0.4),))
    (log,) = stand.log_bodies.states()
    assert log.axis[2] == pytest.approx(-0.006, rel=0.25)
    p = stand.client
    turn = p.getMatrixFromQuaternion(log.quaternion)
    assert abs(turn[6]) < 0.15  # the side it bows to lies level
    butt, top = log.ends_m
    middle = [(a + b) / 2 for a, b in zip(butt, top, strict=True)]
    assert math.dist(middle, log.position_m) == pytest.approx(log.sweep_m, rel=1e-6)
    assert math.dist(butt, top) == pytest.approx(2.6) and log.sweep_m == pytest.approx(0.052)


def test_bullet_moves_the_real_wood(stand_of):
    spec = LogSpec(-2.0, 4.0, 0.3, 2.6, 0.2, 600.0, 0.012, 0.03, z_m=0.004, roll_rad=1.57)
    stand = stand_of((spec,))
    p, wood = stand.client, mass_of(spec)
    mass, _, inertia, *_ = p.getDynamicsInfo(stand.log_bodies.body_ids[0], -1)
    assert mass == wood.mass_kg == stand.log_bodies.masses[0] and inertia == pytest.approx(wood.inertia_kg_m2)
    (log,) = stand.log_bodies.states()
    com = p.multiplyTransforms(log.position_m, log.quaternion, wood.com_m, IDENTITY)[0]
    assert com == pytest.approx(p.getBasePositionAndOrientation(stand.log_bodies.body_ids[0])[0], abs=1e-6)


@pytest.mark.parametrize("diameter", [0.1, 0.3])
def test_a_rolling_log_comes_to_a_stop(stand_of, diameter):
    stand = stand_of((LogSpec(-2.0, 4.0, 0.0, 2.6, diameter, 600.0, z_m=0.004),))
    stand.log_bodies.wake()
    v = 0.3
    stand.client.resetBaseVelocity(stand.log_bodies.body_ids[0], [0.0, v, 0.0], [-2 * v / diameter, 0.0, 0.0])
    start = stand.log_bodies.states()[0].position_m
    stand.fastest(3.0)
    log = stand.log_bodies.states()[0]
    assert log.speed_m_s < 5e-3 and 0.02 < math.dist(start, log.position_m) < 0.6


def test_a_touch_wakes_sleeping_logs_and_sleeping_ground_carries_them_like_awake_ground(stand_of):
    """To the bit: while both sleep Bullet computes no contacts; when a log is touched they are unchanged."""
    ways = []
    for awake in (False, True):
        stand = stand_of(of("pile", 1, 2))
        p = stand.client
        if awake:
            state = p.ACTIVATION_STATE_DISABLE_SLEEPING | p.ACTIVATION_STATE_WAKE_UP
            p.changeDynamics(stand.terrain.body, -1, activationState=state)
        assert stand.fastest(0.1) == 0.0
        x, y, z = stand.log_bodies.states()[0].position_m
        shape = p.createCollisionShape(p.GEOM_BOX, halfExtents=[0.1, 0.1, 0.1])
        p.createMultiBody(80.0, shape, basePosition=[x, y + 0.05, z + 0.6])
        assert stand.fastest(0.6) > 0.05
        ways.append([p.getBasePositionAndOrientation(log) for log in stand.log_bodies.body_ids])
    assert ways[0] == ways[1]


@pytest.mark.long
@pytest.mark.parametrize("machine", MACHINES)
def test_a_full_bunk_holds_its_logs(stand_of, machine):
    stand = stand_of(of("bunk", 1, 20, machine), machine)
    b = PROFILES[machine].bunk
    p = stand.client
    inward = p.invertTransform(*stand.base)
    for log in stand.log_bodies.states():
        x, y, z = to_bunk(b, p.multiplyTransforms(*inward, log.position_m, IDENTITY)[0])
        assert abs(x) < b.length_m / 2 and abs(y) < b.width_m / 2
        assert b.floor_z_m + log.diameter_m / 2 - 0.02 < z < b.floor_z_m + b.stake_height_m


@pytest.mark.long
@pytest.mark.parametrize("kind", ["rough", "slope"])
def test_logs_lie_on_uneven_ground(stand_of, kind):
    stand = stand_of(of("row", 0, 3, "aoro_fc8"), "aoro_fc8", kind)
    for log in stand.log_bodies.states():
        air = [x[2] - log.diameter_m / 2 - stand.terrain.height(x[0], x[1]) for x in (log.position_m, *log.ends_m)]
        assert min(air) < 0.03 and max(air) < 0.3 and min(air) > -0.05
    assert stand.fastest(0.5) < 5e-3


def test_overlapping_logs_are_refused():
    a = LogSpec(-2.0, 4.0, 0.0, 2.6, 0.2, 600.0, z_m=0.004)
    with pytest.raises(PlantError, check=coded("logs.overlap")):
        Stand((a, LogSpec(-2.0, 4.1, 0.1, 2.6, 0.2, 600.0, z_m=0.004)))
    x, y = PROFILES["palms_471"].bunk.center_m
    with pytest.raises(PlantError, check=coded("logs.overlap")):
        Stand((LogSpec(x, y, 0.0, 2.6, 0.2, 600.0, z_m=0.1),))


def test_the_bunk_is_at_the_profiles_place_on_both_machines():
    for machine in MACHINES:
        profile = PROFILES[machine]
        b, c = profile.bunk, profile.carrier
        floor = bunk_shapes(profile)[0]
        assert floor.link == bunk_link(profile) == ("base" if c is None else "rear")
        top = floor.position_m[2] + floor.size_m[2] / 2
        assert top == pytest.approx(b.floor_z_m + (0.0 if c is None else c.crane_base_m[2]))
        assert to_bunk(b, from_bunk(b, (0.3, -0.2, 0.1))) == pytest.approx((0.3, -0.2, 0.1))
    assert bunk_shapes(PROFILES["aoro_fc8"])[0].position_m[0] == pytest.approx(-2.8)  # behind the rear axle
