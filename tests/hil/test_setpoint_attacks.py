"""In the plant, no joint exceeds its speed limit by more than 5 % over 500 ms, whatever setpoints a planner sends."""

from __future__ import annotations

import numpy as np
import pytest

from can_dbc.messages.crane import CraneSetpoint, GrappleCommand, Knot, StateReport
from can_dbc.messages.datagrams import encode
from controller.config import Settings, load
from controller.tick import Outputs
from hil.harness.lockstep import Lockstep, Observer
from machine.joints import JOINTS
from machine.profile import joint
from machine.status.modes import Mode
from sim.plant import Plant
from tests.controller.setpoint_attacks import Attacker
from tests.hil.stand_ins import in_lockstep

MS = 1_000_000
SECONDS = 4.0
WINDOW_TICKS = 100


class AttackingPlanner:
    """Sends a setpoint of the attack every ``every_ms``."""

    def __init__(self, settings: Settings, kind: str, joints: tuple[int, ...], every_ms: int) -> None:
        self.settings, self.attacker = settings, Attacker(settings.profile, joints)
        self.kind, self.every_ns = kind, every_ms * MS
        self.system: Lockstep | None = None
        self.begun_ns = self.due_ns = self.sequence = 0

    def step(self, now_ns: int, report: StateReport | None, logs: object) -> bytes | None:
        assert self.system is not None
        controller = self.system._controller
        if controller.supervisor.mode not in (Mode.ARMED, Mode.ACTIVE) or now_ns < self.due_ns:
            return None
        self.begun_ns = self.begun_ns or now_ns
        self.due_ns, self.sequence = now_ns + self.every_ns, self.sequence + 1
        # A joint without an encoder has no reference.
        reference, velocity = (
            [0.0 if value != value else value for value in values]
            for values in (controller.reference_position, controller.crane.governor.velocity)
        )
        knots = self.attacker.knots(self.kind, reference, velocity, (now_ns - self.begun_ns) * 1e-9)
        packed = tuple(Knot(round(ms * MS), tuple(p), tuple(v)) for ms, p, v in knots)
        head = (self.sequence, self.settings.profile_hash, now_ns, 200 * MS, GrappleCommand.NEUTRAL, False)
        return encode(CraneSetpoint(*head, packed))


@pytest.mark.parametrize(
    ("machine", "kind", "joints", "every_ms"),
    [
        ("palms_471", "field", (0,), 20),
        pytest.param("aoro_fc8", "field", (0, 1), 10, marks=pytest.mark.long),
        pytest.param("aoro_fc8", "lag, then go", (2,), 10, marks=pytest.mark.long),
        pytest.param("palms_471", "lag, then go", (0,), 10, marks=pytest.mark.long),
        pytest.param("palms_471", "field", (1,), 10, marks=pytest.mark.long),
        pytest.param("palms_471", "lag, then go", (2,), 10, marks=pytest.mark.long),
        pytest.param("palms_471", "lag, then go", (3,), 10, marks=pytest.mark.long),
        pytest.param("palms_471", "rest ahead", (3,), 5, marks=pytest.mark.long),
        pytest.param("palms_471", "field", (4,), 20, marks=pytest.mark.long),
        pytest.param("palms_471", "field", (0, 1, 2, 3), 40, marks=pytest.mark.long),
    ],
)
def test_no_joint_is_driven_beyond_its_speed_limit(
    machine: str, kind: str, joints: tuple[int, ...], every_ms: int
) -> None:
    share = shares_of_the_speed_limit(machine, "nominal", 1, kind, joints, every_ms)
    assert share.max() <= 1.05, share
    assert share[list(joints)].max() >= 0.3, "the attack moves the crane"


@pytest.mark.long
@pytest.mark.parametrize(
    ("machine", "seed", "kind", "axis"),
    [("palms_471", 2, "field", 0), ("palms_471", 2, "lag, then go", 2), ("aoro_fc8", 6, "field", 0)],
)
def test_nor_is_an_individual_that_is_not_calibrated(machine: str, seed: int, kind: str, axis: int) -> None:
    """The worst of twelve individuals: the figure in ``docs/reference/safety.md``."""
    share = shares_of_the_speed_limit(machine, "sampled", seed, kind, (axis,), 10)
    assert 0.9 < share.max() <= 1.05, share


def shares_of_the_speed_limit(
    machine: str, truth: str, seed: int, kind: str, joints: tuple[int, ...], every_ms: int
) -> np.ndarray:
    """The largest speed of each joint over any 500 ms, as a share of its limit."""
    settings = load(machine)
    plant = Plant(settings.profile, seed=seed, truth=truth, logs=0)
    planner = AttackingPlanner(settings, kind, joints, every_ms)
    positions: list[tuple[float, ...]] = []

    def look(outputs: Outputs, now_ns: int) -> None:
        if planner.begun_ns:
            positions.append(plant.joint_positions())

    planner.system = system = in_lockstep(machine, plant, planner, observer=Observer(on_outputs=[look]), max_stops=8)
    try:
        while not planner.begun_ns or system.now_ns < planner.begun_ns + SECONDS * 1e9:
            system.advance()
    finally:
        plant.close()
    q = np.array(positions)
    speed = np.array([joint(settings.profile, j).speed_limit for j in JOINTS])
    return np.abs(q[WINDOW_TICKS:] - q[:-WINDOW_TICKS]).max(axis=0) / (0.5 * speed)
